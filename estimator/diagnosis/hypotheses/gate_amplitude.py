"""Gate of the largest amplitudes: a law of displacement fitted to the smaller motion has to predict the largest.

Windows of the record are ranked by their rms displacement. Parameters fitted to the lower windows predict the upper
ones. Only laws of displacement are judged. Where the motion is large the force has put energy in, so the mean of F v is
above its average there, and every damping law would be judged wrongly. The mean of F g(x) is not touched by the choice
of windows: x is even and v odd under time reversal, and the reversed path of a linear rotor is driven by F - 2 c v.

A law fitted to the lower windows has an uncertainty. It loses by it in the upper windows even if the law is right:
about tr(I_up I_low^-1) / 2 nats. The law is refused only if it makes the upper windows worse by more than that permits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from estimator.arrays import Array
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.likelihood.motion.located_law import LocatedLaw
from estimator.likelihood.path.path_fit import Gram, PathFit, fit_increments, log_likelihood
from estimator.likelihood.path.subproblem import coupled_places
from estimator.likelihood.path.working_point import WorkingPoint, point_on_part
from estimator.likelihood.response.regressor_set import (
    Regressor,
    linear_regressors,
    regressor_response,
    regressors,
    with_second_order,
)
from estimator.model.effect import Effect
from estimator.parallel import map_processes


@dataclass(frozen=True, slots=True)
class Extrapolation:
    """How a law predicts the upper windows.

    gain : nats on the upper windows by parameters fitted to the lower ones. allowed : loss that chance explains, nats.
    """

    gain: float
    allowed: float

    @property
    def refused(self) -> bool:
        """Whether the law makes the upper windows worse by more than chance."""
        return self.gain < -self.allowed


def upper_part(point: WorkingPoint, i: int) -> NDArray[np.bool_]:
    """(n,) samples of place i in the windows of largest rms displacement."""
    data = point.data
    level = np.mean(data.x[i].reshape(-1, THRESHOLDS.window_samples) ** 2, axis=1)
    return np.asarray(
        np.repeat(level > np.quantile(level, 1.0 - THRESHOLDS.upper_share), THRESHOLDS.window_samples), dtype=np.bool_
    )


def is_displacement_law(effect: Effect | None) -> bool:
    """Whether an effect is a law of displacement at a bearing cap: the gate judges no other law."""
    return effect is not None and effect.kind == "force" and effect.state == "displacement"


def extrapolated(point: WorkingPoint, placed: tuple[LocatedLaw, ...]) -> Extrapolation | None:
    """How laws with given searched parameters predict the largest amplitudes; None where the smaller give no fit."""
    point = point_on_part(point, THRESHOLDS.judged_seconds)
    total, allowed = 0.0, THRESHOLDS.amplitude_margin_nats
    for found in map_processes([partial(_one, point, one) for one in placed]):
        if found is None:
            return None
        total, allowed = total + found[0], allowed + found[1]
    return Extrapolation(total, allowed)


def _one(point: WorkingPoint, placed: LocatedLaw) -> tuple[float, float] | None:
    linear = np.array([q.linear for q in placed.effect.parameters])
    placed = placed.with_values(np.where(linear, 1.0, placed.p))
    used = tuple(q.linear and placed.p[k] != 0.0 for k, q in enumerate(placed.effect.parameters))
    at = coupled_places(point, placed.at)
    trial = replace(placed, free=used)
    extra = with_second_order(regressors(trial, point.data, point.lin, linear_only=True), trial, point.fluctuations)
    uses = [u for u in point.placed if set(u.at) & set(at)]
    base = [t for i in at for t in linear_regressors(point.data, i, point.lin[i], point.placed)]
    base += [t for u in uses for t in with_second_order(regressors(u, point.data, point.lin), u, point.fluctuations)]
    masks = [upper_part(point, i) for i in at]
    parts = []
    for upper in (False, True):
        parts.append(_gram(point, at, [*base, *extra], [m == upper for m in masks], uses, placed, used))
    names = tuple(t.name for t in base)
    (low, n_low), (high, n_high) = parts
    jacobian, here = point.jacobian.of_places(np.array(at)), np.array([0])

    def fitted(gram: Gram, blocks: float) -> PathFit:
        return fit_increments(gram, jacobian, here, np.array([blocks]), steps=8)

    def nats(gram: Gram, found: PathFit) -> float:
        return log_likelihood(gram, jacobian, found.delta, found.S, here, np.array([n_high]))

    full, plain = fitted(low, n_low), fitted(low.keep(names), n_low)
    gain = nats(high, full) - nats(high.keep(names), plain)
    q = len(extra)
    cov_low, cov_high = full.covariance[-q:, -q:], fitted(high, n_high).covariance[-q:, -q:]
    try:
        loss = float(np.trace(np.linalg.solve(cov_high, cov_low)))
    except np.linalg.LinAlgError:
        return None
    return gain, 0.5 * loss * float(chdtri(q, THRESHOLDS.amplitude_max_p_value)) / q


def _gram(
    point: WorkingPoint, at: tuple[int, ...], all_terms: list[Regressor], masks: list[NDArray[np.bool_]],
    uses: list[LocatedLaw], placed: LocatedLaw, used: tuple[bool, ...],
) -> tuple[Gram, float]:  # fmt: skip
    """Gram matrices of force and regressors over the marked samples, with their tangents, and the number of blocks."""
    data = point.data
    k = len(all_terms)
    G = np.zeros((len(at), 1, 1 + k, 1 + k))
    n = np.zeros((len(at), 1))
    tangents: dict[str, Array] = {}
    for row, (i, mask) in enumerate(zip(at, masks, strict=True)):
        own = [j for j, t in enumerate(all_terms) if i in t.series]
        spectra = [point.spectra[i], *(point.whitening.spectrum(i, all_terms[j].series[i], all_terms[j].scale)
                                       for j in own)]  # fmt: skip
        Z = np.stack([_in_band(point, z)[mask] for z in spectra])
        rows = np.array([0] + [1 + j for j in own])
        G[row, 0][rows[:, None], rows] = Z @ Z.T
        n[row, 0] = mask.mean() * point.gram.n[i].sum()
        seen = data.at(mask)
        made = [t for u in uses if i in u.at for t in regressors(replace(u, at=(i,)), seen, point.lin)]
        if i in placed.at:
            made += regressors(replace(placed, at=(i,), free=used), seen, point.lin, linear_only=True)
        for t in made:
            tangents[t.name] = tangents.get(t.name, 0.0) + t.tangent
    index = np.array(at)
    responses = [
        regressor_response(replace(t, tangent=tangents.get(t.name, t.tangent)), point.whitening.s) for t in all_terms
    ]
    names, scales = tuple(t.name for t in all_terms), np.array([t.scale for t in all_terms])
    blocks = float(np.mean([m.mean() for m in masks])) * data.blocks
    stacked = point.jacobian.tangents(point.whitening.tangents_to_measured(np.stack(responses)), index)
    gram = Gram(G=G, n=n, log_weight=np.zeros_like(n), tangents=stacked, scales=scales, names=names)
    return gram, blocks


def _in_band(point: WorkingPoint, spectrum: NDArray[np.float32]) -> Array:
    """(n,) the series of a weighted spectrum; the sum of its squares is that of the spectrum."""
    from scipy.fft import irfft

    block = point.data.block
    Z = np.zeros((point.data.blocks, block // 2 + 1), np.complex64)
    Z[:, point.data.bins] = spectrum.view(np.complex64)
    return np.asarray(irfft(Z, block, axis=1).ravel() * np.sqrt(block / 2.0), dtype=np.float64)
