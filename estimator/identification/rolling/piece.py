"""A piece of a stream as a motion record, its sums at the anchor of a rolling fit, and the spectrum by these sums.

The power of the residual force in cells of frequency shows sensor noise other than that of the anchor, and a spectrum
that no force and no noise of the model explains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Series
from estimator.likelihood.fitting.noise_level import MIN_NOISE_RATIO, grid_minimum
from estimator.likelihood.motion.denoise import DenoisingFilter
from estimator.likelihood.motion.force_balance import force_channels
from estimator.likelihood.motion.located_law import law_along_record
from estimator.likelihood.motion.motion_record import MotionRecord
from estimator.likelihood.motion.prepare import bring_in_background, inertia_and_shaft
from estimator.likelihood.response.regressor_set import linear_regressors, regressors
from estimator.model.rig import Model
from estimator.signals.band_limit import BandLimitedMotion

from .anchor import Anchor
from .memory import Memory, Piece
from .thresholds import LIMITS


def joined_motion(parts: Sequence[BandLimitedMotion], first: int, stop: int) -> BandLimitedMotion:
    """Rows first ... stop - 1 of the motion, of parts that follow one another."""
    own = [p for p in parts if p.start < stop and p.start + p.rows > first]

    def cut(z: Sequence[NDArray[Any]]) -> NDArray[Any]:
        joined = np.concatenate(z, axis=-1) if len(z) > 1 else z[0]
        return joined[..., first - own[0].start : stop - own[0].start]

    slow = None if own[0].slow is None else cut([p.slow for p in own if p.slow is not None])
    valid = cut([p.valid for p in own])
    a, v, x, u = (cut([getattr(p, name) for p in own]) for name in "avxu")
    return BandLimitedMotion(start=first, a=a, v=v, x=x, u=u, valid=np.asarray(valid, bool), slow=slow)


def piece_record(
    like: MotionRecord,
    model: Model,
    motion: BandLimitedMotion,
    phase: Array,
    denoising: DenoisingFilter | None,
    margin: int,
) -> MotionRecord | None:
    """The valid blocks of some motion as a record; None without any.

    like : record with the fields that do not depend on time. phase : (n,) rad of all rows of the motion. denoising :
    filter of the displacement that laws see; None: unfiltered. margin : rows at either end that are not of the record.
    """
    block, P = like.block, len(like.places)
    valid = motion.valid[margin : motion.rows - margin].reshape(-1, block).all(axis=1)
    if not valid.any():
        return None
    rows = np.flatnonzero(np.repeat(valid, block)) + margin
    at = slice(margin, motion.rows - margin) if valid.all() else rows

    def taken(z: NDArray[np.floating]) -> Series:
        return np.asarray(z[..., at], np.float32)

    a, v, x = motion.a, motion.v[:P], motion.x[:P]
    known = inertia_and_shaft(like.rotor, like.mass, (a[:P], v, x), motion.u.copy())
    for k, i in enumerate(force_channels(model)):
        known[i] -= a[P + k]
    if like.background is not None:
        x, v = x.copy(), v.copy()
        bring_in_background(like.background, like.places, (x, v, known), [slice(0, motion.rows)], like.rate_hz)
    slow = None if motion.slow is None else taken(motion.slow[:P])
    correction = None if denoising is None else taken(denoising.of(x, like.rate_hz))
    starts = motion.start + margin + np.flatnonzero(valid) * block
    return replace(
        like, v=taken(v), x=taken(x), known=taken(known), t=(motion.start + rows) / like.rate_hz, phase=phase[at],
        start=starts, fold=np.zeros(starts.size, np.int64), measured=slow, slow=slow, denoise_correction=correction,
        level=None, below_band_force=None, free_inertia={i: taken(a[i]) for i in like.free_inertia},
    )  # fmt: skip


_Term = tuple[int, Series, float]  # number, series and value of a regressor
_Forces = tuple[list[Series], list[list[_Term]]]  # by place: what no increment changes, and the regressors


def piece_sums(anchor: Anchor, data: MotionRecord, delta: Array, watched: bool) -> Piece:
    """The sums of a record at an anchor. Raises NotFiniteError where a law is not finite.

    delta : (k,) increments at which the level of the excitation is taken. watched : whether with the candidates.
    """
    K, P = len(anchor.names) if watched else anchor.own, len(data.places)
    tangents, mean_tangent = np.zeros((K, P, P, 2)), np.zeros((P, P, 2))
    known, terms = _forces(anchor, data, watched, tangents, mean_tangent)
    numbers = [[k for k, _, _ in own] for own in terms]
    spectra = [_spectra(anchor, i, known[i], own) for i, own in enumerate(terms)]
    power = np.array([_power(Z, own, delta) for Z, own in zip(spectra, numbers, strict=True)]) / data.blocks
    mask = None if data.measured_force else line_mask(power, data.blocks)
    kept = anchor.kept if mask is None else anchor.kept * mask
    level = _level(anchor, power, kept)
    gram = np.zeros((anchor.cells.size, P, 1 + K, 1 + K))
    for i, (Z, own) in enumerate(zip(spectra, numbers, strict=True)):
        if level[i] != 1.0:
            psd = anchor.whitening.relative_psd(i, level[i : i + 1])[0]
            Z *= np.repeat(1.0 / np.sqrt(psd), 2).astype(np.float32)
        if mask is not None:
            Z *= np.repeat(mask, 2).astype(np.float32)
        at = np.array([0, *(1 + k for k in own)])
        for c, cell in enumerate(anchor.cell_slices):
            z = Z[:, :, 2 * cell.start : 2 * cell.stop].reshape(len(Z), -1)
            gram[c, i][at[:, None], at] = z @ z.T
    return Piece(gram=gram, blocks=float(data.blocks), tangents=tangents, mean_tangent=mean_tangent,
                 kept=kept.mean(axis=0), level=level)  # fmt: skip


def _forces(anchor: Anchor, data: MotionRecord, watched: bool, tangents: Array, mean_tangent: Array) -> _Forces:
    """The forces at every place: what no increment changes, and the regressors. tangents, mean_tangent : filled with
    those of the regressors and of all forces."""
    numbers, lin, value_of = {name: k for k, name in enumerate(anchor.names)}, anchor.lin, anchor.value_of
    known: list[Series] = [*data.known]
    terms: list[list[_Term]] = [[] for _ in known]
    linear = [t for i in range(len(known)) for t in linear_regressors(data, i, lin[i])]
    made = [(t, 0.0 if t.mass_at is not None else value_of[t.name]) for t in linear]  # m a is known
    for i, place in enumerate(data.places):
        for which, (key, z) in enumerate((("kL", data.x[i]), ("c", data.v[i]))):
            if (held := data.held.get(f"{place}.{key}")) is not None:
                known[i] = known[i] + np.float32(held) * z
                mean_tangent[i, i, which] += held
    for use in anchor.placed:
        own = {t.name: t for t in regressors(use, data, lin)}
        amplitudes = [use.name(k) for k, q in enumerate(use.effect.parameters) if q.linear]
        whole = not amplitudes or not own.keys() >= set(amplitudes)
        values = (
            {} if whole else {use.name(k): float(use.p[k]) for k, q in enumerate(use.effect.parameters) if q.linear}
        )
        made += [(t, values.get(t.name, 0.0)) for t in own.values()]
        for i in use.at if whole else ():
            force, slopes, _ = law_along_record(use, data, i, lin)
            known[i] = known[i] + force
            mean_tangent[i] += slopes
    for use in anchor.watched if watched else ():
        made += [(t, 0.0) for t in regressors(use, data, lin, True)]
    for t, value in made:
        k = numbers[t.name]
        tangents[k] = t.tangent * anchor.scales[k]
        mean_tangent += value * t.tangent
        for i, series in t.series.items():
            terms[i].append((k, series, value))
    return known, terms


def _spectra(anchor: Anchor, i: int, known: Series, terms: Sequence[_Term]) -> NDArray[np.float32]:
    """(1 + regressors, blocks, 2 bins) whitened spectra at place i, of the residual force first."""
    out = np.empty((1 + len(terms), known.size // anchor.data.block, 2 * anchor.bins), np.float32)
    anchor.whitening.spectrum(i, known, out=out[0])
    for Z, (k, series, value) in zip(out[1:], terms, strict=True):
        anchor.whitening.spectrum(i, series, anchor.scales[k], Z)
        if value:
            out[0] += np.float32(value / anchor.scales[k]) * Z
    return out


def _power(Z: NDArray[np.float32], numbers: list[int], delta: Array) -> Array:
    """(bins,) power of the residual force, over all blocks, from the spectra of a place."""
    step = np.append(1.0, [delta[k] if k < delta.size else 0.0 for k in numbers]).astype(np.float32)
    F = np.tensordot(step, Z, 1)
    return np.asarray(np.einsum("bk,bk->k", F, F).reshape(-1, 2).sum(axis=1), np.float64)


def _level(anchor: Anchor, power: Array, kept: Array) -> Array:
    """(places,) power of the excitation over that of the anchor. power : (places, bins) of a block."""
    if anchor.data.measured_force:
        return np.ones(len(power))
    force = 1.0 - anchor.whitening.noise.share
    excess = (power / anchor.S[:, None] - 1.0) * (kept > 0.0)
    level = 1.0 + (excess * force).sum(axis=1) / np.maximum((kept * force**2).sum(axis=1), 1e-300)
    return np.asarray(np.maximum(level, LIMITS.min_level))


def line_mask(power: Array, blocks: int) -> Array | None:
    """(bins,) 0 about narrow lines, else 1; None without any line. power : (places, bins) mean over some blocks."""
    from scipy.special import chdtri

    limit = chdtri(2 * blocks, LIMITS.max_line_p) / chdtri(2 * blocks, 0.5)
    if power.shape[1] < 2 * LIMITS.line_surroundings_bins or not np.any(
        power > limit * np.median(power, axis=1, keepdims=True)
    ):
        return None
    from scipy.ndimage import median_filter

    about = median_filter(power, size=(1, LIMITS.line_surroundings_bins), mode="nearest")
    ratio = (power / np.maximum(about, 1e-300)).max(axis=0)
    lines = np.flatnonzero(ratio > limit)
    if not lines.size:
        return None
    out, bins = np.ones(ratio.size), np.arange(ratio.size)
    for k, reach in zip(lines, np.sqrt(ratio[lines] / LIMITS.line_reach_share) / np.pi + 1.0, strict=True):
        out[np.abs(bins - k) <= reach] = 0.0
    return out


def cell_power(anchor: Anchor, memory: Memory, delta: Array) -> tuple[Array, Array]:
    """Power of the whitened residual force in a memory, (places, cells) N^2/Hz, and the weighted number of bins of each
    cell, (cells,). The power is a sum over the bins and the weighted blocks. delta : (k,) increments, scaled."""
    b, K = np.append(1.0, delta), 1 + anchor.own
    power = np.einsum("a,ciab,b->ic", b, memory.gram[:, :, :K, :K], b)
    return power, np.add.reduceat(memory.kept, anchor.cells)


def excess_power(anchor: Anchor, memory: Memory, delta: Array) -> list[tuple[float, float]]:
    """Relative excess over the model of the most significant cell, and the frequency of the cell, Hz, by place.

    0 where none stands out by more than chance, or where a force is measured. delta : (k,) increments, scaled.
    """
    from scipy.special import chdtr, chdtrc

    if anchor.data.measured_force:
        return [(0.0, 0.0)] * len(anchor.data.places)
    powers, bins = cell_power(anchor, memory, delta)
    f_hz = anchor.data.f_hz
    middle = np.array([0.5 * (f_hz[c.start] + f_hz[c.stop - 1]) for c in anchor.cell_slices])
    n, freedom = np.maximum(bins, 1e-300), 2.0 * bins * memory.n / memory.n2
    ratio = powers / n / (powers.sum(axis=1, keepdims=True) / n.sum())
    p = np.minimum(chdtr(freedom, freedom * ratio), chdtrc(freedom, freedom * ratio))
    significant = (p < LIMITS.max_colour_p) & (bins > 0.0)
    worst = np.argmax(np.where(significant, np.maximum(ratio, 1.0 / np.maximum(ratio, 1e-300)), 0.0), axis=1)
    at = np.arange(len(powers)), worst
    return list(zip(np.where(significant[at], ratio[at] - 1.0, 0.0).tolist(), middle[worst].tolist(), strict=True))


def renewed_noise(anchor: Anchor, memory: Memory, delta: Array) -> tuple[Array, Array] | None:
    """nu and S, (places,) each, if the memory contradicts the sensor noise of the anchor; None otherwise.

    delta : (k,) increments, scaled.
    """
    data = anchor.data
    if memory.n < LIMITS.min_noise_blocks:
        return None
    powers, bins = cell_power(anchor, memory, delta)
    share = np.add.reduceat(memory.kept, anchor.first)  # of the nodes
    cell = np.searchsorted(anchor.cells, anchor.nodes, side="right") - 1
    used = np.flatnonzero(np.bincount(cell, share, anchor.cells.size) > 0.0)

    def by_cell(z: Array) -> Array:
        """(..., cells) mean of z (..., nodes) over the nodes of each cell."""
        weights = (cell == np.arange(anchor.cells.size)[:, None]) * share
        return np.asarray(z @ weights[used].T / weights[used].sum(axis=1))

    gain = np.abs(anchor.A) ** 2  # (nodes, places, places)
    shape, W = data.noise_shape[:, anchor.nodes], anchor.whitening.weight[:, anchor.nodes]
    own = np.einsum("kii->ik", gain) * shape
    known = data.excitation_shape[:, anchor.nodes] - own * anchor.nu[:, None]
    known += np.einsum("kil,lk->ik", gain, shape * (anchor.nu * anchor.S)[:, None]) / anchor.S[:, None]
    n, nu, S, gained = bins[used], anchor.nu.copy(), anchor.S.copy(), 0.0
    for i, z in enumerate(powers[:, used]):
        grid = np.concatenate([[0.0], np.geomspace(MIN_NOISE_RATIO, 1e3, LIMITS.noise_grid_points) / own[i].mean()])

        def fit(ratio: Array, i: int = i, z: Array = z) -> tuple[Array, Array]:
            """Nats below the maximum and S at noise ratios."""
            psd = by_cell(W[i] * (known[i] + ratio[:, None] * own[i]))
            level = (z / psd).sum(axis=1) / n.sum()
            return n.sum() * np.log(level) + np.log(psd) @ n, level

        cost, _ = fit(grid)
        best = grid_minimum(grid, cost)
        ends, levels = fit(np.array([anchor.nu[i], best]))
        nu[i], S[i] = best, levels[1]
        gained = max(gained, float(ends[0] - ends[1]))
    return (nu, S) if gained > LIMITS.min_noise_gain_nats else None
