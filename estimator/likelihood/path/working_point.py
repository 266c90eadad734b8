"""A model at given values on a record: residual force, whitened regressors, Gram matrices, tangent A."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.arrays import Array, Complexes, Series
from estimator.likelihood.motion import linear_memory
from estimator.likelihood.motion.harmonics import PeriodicForce
from estimator.likelihood.motion.known_spectra import shaft_response
from estimator.likelihood.motion.located_law import LocatedLaw, has_nonlinear_memory, law_along_record
from estimator.likelihood.motion.motion_record import TIME_FOLDS, MotionRecord, leading_blocks
from estimator.likelihood.response.fluctuation import Fluctuation, fluctuations
from estimator.likelihood.response.modal_response import ModalResponse, modal_responses
from estimator.likelihood.response.regressor_set import (
    Regressor,
    Spans,
    in_single_precision,
    linear_regressors,
    parameter_scale,
    regressors,
    with_second_order,
)
from estimator.likelihood.thresholds import LIMITS
from estimator.likelihood.whitening.contour import continued_tangent, contour
from estimator.likelihood.whitening.determinant import Jacobian, line_weights
from estimator.likelihood.whitening.sensor_noise import SensorNoise, force_correlation, referred_noise
from estimator.likelihood.whitening.whitening import Spectrum, WhitenedRegressors, Whitening
from estimator.model.rig import Model
from estimator.parallel import map_threads

from .path_fit import Gram, PathFit, fit_increments, gram_matrices


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkingPoint:
    """A fitted model on a record.

    force, spectra, gram and A hold for the values before the last step of the fit, a fraction of a standard deviation.

    data : the motion. kL : (places,) N/m. c : (places,) N s/m. S : (places,) N^2/Hz, one-sided PSD of the excitation.
    nu : (places,) PSD of the sensor noise over S. placed : laws at their locations, with values. force : (places, n) N,
    residual force. whitening : weights of the spectra. spectra : of the residual force, by place. regressors : of all
    parameters (k). whitened : spectra of the regressors. gram : products of the spectra. jacobian : determinant of A.
    fit : last step, k increments. prior_information : (k,) scaled, keeps searched parameters near in every fit at this
    point. A : (bins, places, places) kg, force per acceleration. mean_tangent : (places, places, 2) N/m and N s/m, by
    displacement and velocity. fluctuations : by place, of the tangents of its laws; None where no law needs a
    second-order correction. spans : of the regressors, by place, to keep those of a law on trial independent of them.
    """

    data: MotionRecord
    kL: Array
    c: Array
    S: Array
    nu: Array
    placed: tuple[LocatedLaw, ...]
    force: Series
    whitening: Whitening
    spectra: dict[int, Spectrum]
    regressors: tuple[Regressor, ...]
    whitened: WhitenedRegressors
    gram: Gram
    jacobian: Jacobian
    fit: PathFit
    prior_information: Array
    A: Complexes
    mean_tangent: Array
    fluctuations: tuple[Fluctuation | None, ...]
    spans: Spans

    @property
    def lin(self) -> Array:
        """(places, 3) mass kg, kL N/m, c N s/m."""
        return np.stack([self.data.mass, self.kL, self.c], axis=1)

    @property
    def bearing_force(self) -> Array:
        """(places,) N, rms of the bearing force kL x + c v + effects, each block over its level of the excitation."""
        power = (self.force - self.data.known) ** 2
        if self.data.level is not None:
            power = power.reshape(len(power), self.data.blocks, -1).mean(axis=2) / self.data.level
        return np.asarray(np.sqrt(np.mean(power, axis=1)))

    def without_rows(self) -> WorkingPoint:
        """The point without its time series, which are large: a start for the fit of another record."""
        none = np.zeros(self.data.x.shape[1], bool)
        data, still = self.data.at(none), (None,) * len(self.fluctuations)
        return replace(self, data=data, force=self.force[:, none], whitening=replace(self.whitening, data=data),
                       fluctuations=still)  # fmt: skip


def point_on_part(point: WorkingPoint, seconds: float) -> WorkingPoint:
    """The fitted model on the first seconds of the record, for searches and pictures."""
    part = leading_blocks(point.data, seconds)
    if part is point.data:
        return point
    return point_at(part, point.kL, point.c, point.nu, point.S, list(point.placed), point)


def search_point(point: WorkingPoint, seconds: float) -> WorkingPoint:
    """The fitted model on the first seconds of the record, without second-order corrections.

    They hold for small steps only; a search steps far.
    """
    remembering = {u.name(k) for u in point.placed if u.effect.kind == "memory" for k in range(u.p.size)}
    bare = tuple(t if t.name in remembering else replace(t, memory={}) for t in point.regressors)
    longer = replace(point, regressors=bare, fluctuations=(None,) * len(point.fluctuations))
    return point_at(
        leading_blocks(point.data, seconds), point.kL, point.c, point.nu, point.S, list(point.placed), longer
    )


def _forces(
    data: MotionRecord, kL: Array, c: Array, uses: list[LocatedLaw], made: list[list[Regressor]]
) -> tuple[Series, Complexes, Array]:
    """Residual force (places, n) N, A (bins, places, places) kg and mean tangent (places, places, 2).

    made : the regressors of each law.
    """
    P = len(data.places)
    F = np.empty_like(data.x)
    M = np.zeros_like(data.shaft)
    D = np.zeros((P, P, 2))
    D[np.arange(P), np.arange(P), 0] = kL
    D[np.arange(P), np.arange(P), 1] = c
    lin = np.stack([data.mass, kL, c], axis=1)

    def add(i: int) -> None:
        F[i] = data.known[i] + kL[i] * data.x[i] + c[i] * data.v[i]
        for use, own in zip(uses, made, strict=True):
            if i not in use.at:
                continue
            amplitudes = [k for k, q in enumerate(use.effect.parameters) if q.linear]
            units = {t.name: t for t in own}
            if amplitudes and use.effect.kind != "shaft" and all(use.name(k) in units for k in amplitudes):
                for k in amplitudes:
                    unit = units[use.name(k)]
                    F[i] += use.p[k] * unit.series[i]
                    D[i] += use.p[k] * unit.tangent[i]
                    if i in unit.memory:
                        M[:, i] += use.p[k] * unit.memory[i].T
                continue
            f, slope, memory = law_along_record(use, data, i, lin)
            F[i] += f
            D[i] += slope
            if memory is not None:
                M[:, i] += memory.T

    map_threads(add, range(P))
    w = 2 * np.pi * data.f_hz[:, None, None]
    if data.background is None:
        return F, np.diag(data.mass)[None] - (data.shaft + M + D[..., 0]) / w**2 + D[..., 1] / (1j * w), D
    bearings = (M + D[..., 0] + 1j * w * D[..., 1]) * data.background.deflections(data.places, 1j * w[:, 0, 0])[:, None]
    return F, np.diag(data.mass)[None] - (data.shaft + bearings) / w**2, D


def tangent_at(point: WorkingPoint, model: Model, f_hz: Array) -> Complexes:
    """(f, places, places) kg: A at any frequencies, without laws with memory. model : that of the point."""
    w = 2 * np.pi * f_hz[:, None, None]
    D = point.mean_tangent
    shaft = shaft_response(model, point.data.places, f_hz)
    return np.asarray(np.diag(point.data.mass)[None] - (shaft + D[..., 0]) / w**2 + D[..., 1] / (1j * w))


def point_at(
    data: MotionRecord, kL: Array, c: Array, nu: Array, S: Array, uses: list[LocatedLaw],
    longer: WorkingPoint | None = None,
) -> WorkingPoint:  # fmt: skip
    """The working point of a model at given values (places,). uses : the laws with their values.

    longer : the point on more of the record, whose second-order corrections are kept; None: they are computed.
    """
    P = len(data.places)
    lin = np.stack([data.mass, kL, c], axis=1)
    of_laws = map_threads(lambda use: regressors(use, data, lin), uses)
    F, A, D = _forces(data, kL, c, uses, of_laws)
    s = contour(A, data.mass, D, data.f_hz, data.rotor)

    def along_line(A: Complexes) -> Complexes:
        return continued_tangent(s, A, data.mass, D, data.rotor, data.background, data.places)

    noise = referred_noise(data, A, nu, S)
    whitening = Whitening(data=data, noise=noise, s=s, measured=_to_measured(data, noise, along_line(A), s))
    spectra = dict(enumerate(map_threads(lambda i: whitening.spectrum(i, F[i]), range(P))))
    mean = _modal_responses(data, D, uses, of_laws, lin)
    around = fluctuations(data, uses, mean, lin) if longer is None else longer.fluctuations
    if longer is None:
        of_laws = map_threads(lambda k: with_second_order(of_laws[k], uses[k], around), range(len(uses)))
    else:
        of_laws = map_threads(lambda k: _corrected_as_longer(of_laws[k], uses[k], longer), range(len(uses)))
    common = {(i, j): force_correlation(data, noise.weight, i, j) for i, j in data.shared}
    made = _all_regressors(data, lin, uses, of_laws) + _common_force_regressors(data, F, noise.weight, common)
    whitened = whitening.whiten(made)
    G = gram_matrices(whitening, spectra, whitened)
    correction = _add_second_order(A, data.f_hz, around)
    jacobian = _determinant(whitening, along_line(A), correction)
    prior = _prior_information(data, G, uses)
    result = _fit_near(G, jacobian, data.fold_blocks, prior)
    own_regressors = tuple(in_single_precision(t) for t in made)
    coarse = tuple(here and here.coarse(data.rate_hz, about) for here, about in zip(around, mean, strict=True))
    return WorkingPoint(
        data=data, kL=kL, c=c, S=_whole_power(data, result, common), nu=nu, placed=tuple(uses), force=F,
        whitening=whitening, spectra=spectra, regressors=own_regressors, whitened=whitened, gram=G, jacobian=jacobian,
        fit=result, prior_information=prior, A=A, mean_tangent=D, fluctuations=coarse, spans=Spans(own_regressors),
    )  # fmt: skip


def _determinant(whitening: Whitening, A: Complexes, correction: Complexes) -> Jacobian:
    """The Jacobian from force to motion. A : (bins, places, places) along the line. correction : (bins, places) kg."""
    s = whitening.s
    there = (1j * s.imag / s) ** 2  # over -w^2 becomes over s^2
    kept = None if whitening.leakage is None else whitening.leakage.kept.mean(axis=0)
    return Jacobian(A, line_weights(s, kept), correction * there[:, None])


def _to_measured(data: MotionRecord, noise: SensorNoise, A: Complexes, s: Complexes) -> Complexes | None:
    """(bins, places, places) factor from a response to the deflection of the bearings to one to the measured motion.

    A : along the line s (bins,) of the determinant. None where the two responses are the same.
    """
    factor = noise.to_measured(A)
    if data.background is None:
        return factor
    deflection = data.background.deflections(data.places, s)[:, :, None]
    return np.asarray(deflection * (np.eye(len(data.places)) if factor is None else factor))


def _add_second_order(A: Complexes, f_hz: Array, around: Sequence[Fluctuation | None]) -> Complexes:
    """(bins, places) kg: what the fluctuating tangents of the laws at a place add to A (bins, places, places)."""
    out = np.zeros(A.shape[:2], complex)
    for i, here in enumerate(around):
        if here is not None:
            out[:, i] = here.whole / (2 * np.pi * f_hz) ** 2
            A[:, i, i] += out[:, i]
    return out


def _modal_responses(
    data: MotionRecord, D: Array, uses: list[LocatedLaw], made: list[list[Regressor]], lin: Array
) -> list[ModalResponse]:
    """Modal response of each place.

    Laws with memory count as a stiffness and a damping: those of their mean response at the resonance there.
    made : regressors of each law. lin : (places, 3) m, kL, c.
    """
    linear = [
        (i, own) for use in uses if use.effect.kind == "memory" for i in use.at
        if (own := linear_memory.state_matrix(use.effect, use.p, lin[i])) is not None
    ]  # fmt: skip
    bare = modal_responses(data.mass, D, data.rotor, linear)
    memory_tangent = np.zeros((len(data.places), 2))
    for use, regressors_of in zip(uses, made, strict=True):
        for i in use.at if has_nonlinear_memory(use, lin[use.at[0]]) else ():
            units = {t.name: t for t in regressors_of}
            at = int(np.argmin(np.abs(data.f_hz - bare[i].hz)))
            for k, q in enumerate(use.effect.parameters):
                if q.linear and use.name(k) in units:
                    response = use.p[k] * units[use.name(k)].memory[i][i, at]
                    memory_tangent[i] += response.real, response.imag / (2 * np.pi * data.f_hz[at])
    if not memory_tangent.any():
        return list(bare)
    there = D + np.eye(len(D))[..., None] * memory_tangent[:, None]
    return list(modal_responses(data.mass, there, data.rotor, linear))


def _all_regressors(
    data: MotionRecord, lin: Array, uses: list[LocatedLaw], own: list[list[Regressor]]
) -> list[Regressor]:
    """Regressors of stiffness and damping, of the laws, and of periodic forces. own : those of each law."""
    made = [t for i in range(len(data.places)) for t in linear_regressors(data, i, lin[i], uses)]
    made += [t for ts in own for t in ts]
    return made + map_threads(lambda wave: _periodic_regressor(data, wave), data.periodic_amplitudes)


def _corrected_as_longer(own: list[Regressor], use: LocatedLaw, longer: WorkingPoint) -> list[Regressor]:
    """The regressors of a law on part of a record, with the second-order correction of the whole record.

    A law with memory has none: its response is that of its present values.
    """
    known = {t.name: t.memory for t in longer.regressors}
    there = [t for t in own if t.name in known]
    return there if use.effect.kind == "memory" else [replace(t, memory=known[t.name]) for t in there]


def _prior_information(data: MotionRecord, G: Gram, uses: list[LocatedLaw]) -> Array:
    """(k,) prior information, scaled: regressors of searched parameters are tangents, which hold for small steps."""
    prior = np.zeros(len(G.names))
    for use in uses:
        for k, q in enumerate(use.effect.parameters):
            far = LIMITS.searched_step_sd * parameter_scale(use, k, data)
            if not q.linear and far > 0.0 and use.name(k) in G.names:
                j = G.names.index(use.name(k))
                prior[j] = (G.scales[j] / far) ** 2
    return prior


def _fit_near(G: Gram, jacobian: Jacobian, blocks: Array, prior: Array) -> PathFit:
    """The step of the fit with prior information (k,), and the covariance without it."""
    everything = np.arange(TIME_FOLDS)
    result = fit_increments(G, jacobian, everything, blocks)
    if not prior.any():
        return result
    return replace(fit_increments(G, jacobian, everything, blocks, ridge=prior), covariance=result.covariance)


def _common_force_regressors(
    data: MotionRecord, F: Series, weight: Array, common: dict[tuple[int, int], Complexes]
) -> list[Regressor]:
    """Regressors of correlated excitation: the residual force of place j at place i, and the other way round.

    With them the rest of F_i is independent of F_j and of all motion that F_j causes. The determinant stays the same.
    """

    def follows(i: int, j: int, shape: Complexes) -> Regressor:
        P = len(data.places)
        rms, name = max(float(F[j].std()), 1e-300), f"{data.places[i]}.follows.{data.places[j]}"
        shape = shape * np.sqrt(weight[j] / weight[i])
        return in_single_precision(Regressor(name, "1", {i: F[j]}, np.zeros((P, P, 2)), scale=1.0 / rms, shape=shape))

    return [t for (i, j), own in common.items() for t in (follows(i, j, own), follows(j, i, own.conj()))]


def _periodic_regressor(data: MotionRecord, wave: PeriodicForce) -> Regressor:
    """Regressor of the amplitude of a periodic force. Without it an error of the amplitude biases kL and c."""
    P = len(data.places)
    made = wave.series(data.t, data.phase)
    rms = max(float(np.std(z)) for z in made.values())
    return in_single_precision(Regressor(wave.name, wave.unit, made, np.zeros((P, P, 2)), scale=1.0 / max(rms, 1e-300)))


def _whole_power(data: MotionRecord, fit: PathFit, common: dict[tuple[int, int], Complexes]) -> Array:
    """(places,) S of the whole excitation: the regressors of correlated excitation leave 1 - rho^2 of it."""
    S = fit.S.copy()
    for (i, j), own in common.items():
        there, back = (fit.value(f"{data.places[a]}.follows.{data.places[b]}")[0] for a, b in ((i, j), (j, i)))
        S[[i, j]] /= max(1.0 - there * back * float(np.mean(np.abs(own) ** 2)), 1e-6)
    return S
