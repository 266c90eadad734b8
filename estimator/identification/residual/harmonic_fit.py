"""The parameters of periodic forces, fitted to the residual force.

Near the right parameters the residual force, demodulated in pieces of the record, is linear in their errors: a wrong
frequency turns the phase from piece to piece. One weighted least-squares step removes them. The line that a force makes
in the motion is read through the mean tangents of the model, so their uncertainty is added to the scatter of the random
force.

Nonlinear laws make harmonics and sums of strong lines. The mean tangent reads them as forces; the residual force, from
which the laws are subtracted, holds real forces only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes, Series
from estimator.effects.engine.custom import effect_of
from estimator.effects.places import written
from estimator.identification.finding import effect_use
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.harmonics import (
    NOT_IDENTIFIABLE_TEXT,
    PeriodicEffect,
    acts_on,
    frequency_index,
    periodic_amplitudes,
    periodic_effects,
    periodic_series,
)
from estimator.likelihood.motion.motion_record import MotionRecord
from estimator.likelihood.path.working_point import WorkingPoint, tangent_at
from estimator.model.rig import EffectUse, Model, Setting
from estimator.results import Parameter
from estimator.signals.band_limit import passband

from .thresholds import LIMITS

Settings = Mapping[str, Mapping[str, Parameter]]  # by canonical place, by name
RECORD_PIECES = 16  # of equal length, to see a phase that drifts


def fit_found_harmonics(
    model: Model, point: WorkingPoint, settings: Mapping[str, Settings]
) -> tuple[dict[str, dict[str, dict[str, Parameter]]], WorkingPoint]:
    """Parameters of periodic effects that a model lacks, fitted together with the model, and its new working point.

    settings : by effect, canonical location and name, as the detector found them. The detector takes each parameter by
    itself, and the missing force has biased the stiffness and damping of the model. Where the fit separates no strength
    from a width, the detector's frequency stays: the harmonics show it.
    """
    uses = tuple(effect_use(name, own) for name, own in settings.items())
    alone, bare = replace(model, effects=uses), point.data
    alone, _ = _step_until_settled(alone, point, point.force)
    added = periodic_amplitudes(alone, bare.places, bare.rate_hz)
    data = replace(
        bare,
        known=bare.known - _periodic_series(alone, bare),
        periodic_amplitudes=(*bare.periodic_amplitudes, *added),
    )
    point = fit_model(data, [*point.placed])
    whole = bare.known - data.known
    whole += point.force
    _, found = _step_until_settled(alone, point, whole)

    def fitted(use: EffectUse, key: str, name: str, detected: Parameter) -> Parameter:
        parameter, effect = found.get(f"{key}.{use.name}.{name}", detected), effect_of(use)
        k = frequency_index(effect)
        is_frequency = k is not None and name == effect.parameters[k].name
        return detected if is_frequency and not parameter.identifiable else parameter

    named = {
        use.name: {key: {n: fitted(use, key, n, p) for n, p in values.items()} for key, values in own.items()}
        for use, own in zip(uses, settings.values(), strict=True)
    }
    return named, point


def settle_harmonics(model: Model, point: WorkingPoint) -> tuple[Model, dict[str, Parameter]]:
    """The model with converged parameters of its periodic effects, all else fixed; and these parameters.

    Parameters are keyed "location.effect.name". Narrow impacts need more than two steps.
    """
    return _step_until_settled(model, point, point.force + _periodic_series(model, point.data))


def _step_until_settled(alone: Model, point: WorkingPoint, whole: Series) -> tuple[Model, dict[str, Parameter]]:
    """The model with its periodic effects after steps to convergence. whole : (places, n) N without these effects."""
    found: dict[str, Parameter] = {}
    for _ in range(LIMITS.max_steps):
        wave = _periodic_series(alone, point.data)
        before = found
        alone, found = refine_harmonics(alone, point, np.subtract(whole, wave, out=wave))
        if _largest_step_sd(before, found) < LIMITS.settled_step_sd:
            break
    return alone, found


def _largest_step_sd(before: Mapping[str, Parameter], now: Mapping[str, Parameter]) -> float:
    """Largest change of the parameters known both times, in standard deviations; infinite without any."""
    pairs = ((p, before[name]) for name, p in now.items() if name in before)
    moves = [abs(p.value - q.value) / p.sd for p, q in pairs if p.sd and p.value is not None and q.value is not None]
    return max(moves, default=np.inf)


def _periodic_series(model: Model, data: MotionRecord) -> Series:
    """(places, n) N, force of a model's periodic effects; zeros without any."""
    wave = periodic_series(model, data.places, data.t, data.phase, data.rate_hz)
    return np.zeros_like(data.known) if wave is None else wave


def refine_harmonics(model: Model, point: WorkingPoint, force: Series) -> tuple[Model, dict[str, Parameter]]:
    """The model with its periodic parameters after one step, and these parameters with standard deviations.

    point : working point of the rest of the model. force : (places, n) N, residual force with the effects as they are.
    Parameters of effects outside the band stay.
    """
    found: dict[str, Parameter] = {}
    uses = {use.name: dict(use.parameters) for use in model.effects}
    for one in periodic_effects(model):
        stepped = _one_step(model, one, point, force)
        if stepped is None:
            continue
        p, sd = stepped
        old = written(one.effect, next(u for u in model.effects if u.name == one.effect.name), model, one.key)
        uses[one.effect.name][one.key] = {
            q.name: replace(old.get(q.name, Setting()), value=float(v))
            for q, v in zip(one.effect.parameters, p, strict=True)
        }
        identifiable = _identifiable(one, p, sd)
        for k, q in enumerate(one.effect.parameters):
            value, spread = float(p[k]), float(sd[k])
            if not one.free[k]:
                parameter = Parameter(value, 0.0, q.unit, reason="given")
            elif identifiable[k]:
                parameter = Parameter(value, spread, q.unit)
            else:
                reason = f"{value:.3g} +- {spread:.2g}: {NOT_IDENTIFIABLE_TEXT}"
                parameter = Parameter(None, None, q.unit, identifiable=False, reason=reason)
            found[f"{one.key}.{one.effect.name}.{q.name}"] = parameter
    effects = tuple(replace(u, parameters=uses[u.name]) for u in model.effects)
    return replace(model, effects=effects), found


def _identifiable(one: PeriodicEffect, p: Array, sd: Array) -> list[bool]:
    """Whether each parameter is identifiable: the two components of a phasor together, an angle whatever its value."""
    names = [q.name for q in one.effect.parameters]
    amplitude = [k for k, q in enumerate(one.effect.parameters) if q.linear]
    there = bool(np.hypot.reduce(p[amplitude]) > 2.0 * sd[amplitude].max())
    return [there and (name == "angle" or k in amplitude or s <= 0.5 * abs(v))
            for k, (name, v, s) in enumerate(zip(names, p, sd, strict=True))]  # fmt: skip


def _one_step(model: Model, one: PeriodicEffect, point: WorkingPoint, force: Series) -> tuple[Array, Array] | None:
    """(k,) parameters after one step, and their standard deviations; None if none is free or no harmonic is in band."""
    data = point.data
    count, inside = one.highest(data.band), one.within(data.band) - 1
    loose = [k for k, free in enumerate(one.free) if free]
    if inside.size == 0 or not loose:
        return None
    # theta per unit of the frequency parameter
    turned = 2 * np.pi * data.t if one.effect.state == "time" else data.phase
    pieces = _piece_index(turned.size)
    middle = np.bincount(pieces, turned) / np.bincount(pieces)
    through = _model_leakage(model, one, point, 1 + inside)
    rows, right, unsure = [], [], []
    for i, place in enumerate(data.places):
        if not acts_on(one, place):
            continue
        seen = demodulate(force[i], one.angle(data.t, data.phase), count)[:, inside]
        slopes = np.zeros((len(loose), *seen.shape), complex)
        for j, k in enumerate(loose):
            if k == frequency_index(one.effect):
                F = one.harmonics(model, place, count)[inside]
                slopes[j] = 1j * (1 + inside) * F * middle[:, None]
            else:
                slopes[j] = _harmonic_slope(model, one, place, count, k)[inside]
        psd = point.S[i] / np.interp(one.hz * (1 + inside), data.f_hz, point.whitening.weight[i])
        scale = np.sqrt(data.t.size / RECORD_PIECES / (psd * data.rate_hz))  # 1 / sd of a real part, by order
        rows.append((slopes * scale).reshape(len(loose), -1))
        right.append((seen * scale).ravel())
        unsure.append(np.tile(through[:, i] * scale, RECORD_PIECES))
    J, d, G = (_real_parts(np.concatenate(z, axis=-1)) for z in (rows, right, unsure))
    size = np.sqrt(np.sum(J * J, axis=1))
    size[size == 0] = 1.0
    information = (J @ J.T) / np.multiply.outer(size, size)
    inverse = np.linalg.pinv(information, rcond=1e-10) / np.multiply.outer(size, size)
    step, moved = inverse @ (J @ d), inverse @ (J @ G.T)
    spread = np.sqrt(np.diag(inverse + moved @ point.fit.covariance @ moved.T))
    p, sd = one.p.copy(), np.zeros(one.p.size)
    for j, k in enumerate(loose):
        q = one.effect.parameters[k]
        limit = np.inf if q.linear else 0.5 if q.name == "angle" else 0.3 * abs(p[k])
        p[k] += np.clip(step[j], -limit, limit)
        if q.name == "angle":
            p[k] %= 2 * np.pi
        sd[k] = spread[j]
    return p, sd


def _real_parts(z: Complexes) -> Array:
    """Real and imaginary parts of complex numbers (..., n), one after the other: (..., 2 n)."""
    return np.concatenate([z.real, z.imag], axis=-1)


def _model_leakage(model: Model, one: PeriodicEffect, point: WorkingPoint, orders: NDArray[np.int64]) -> Complexes:
    """(regressors, places, orders) N, error of an effect's force per scaled unit of each parameter of the model.

    It is the mean tangent of each regressor times the motion that the effect makes.
    """
    f = np.asarray(one.hz * orders, dtype=np.float64)
    places, w = point.data.places, 2 * np.pi * f
    F = np.stack([one.harmonics(model, p, orders[-1])[orders - 1] * acts_on(one, p) for p in places], axis=1)
    A = tangent_at(point, model, f)
    x = -np.linalg.solve(A, F[..., None])[..., 0] / w[:, None] ** 2
    tangents = np.stack([t.tangent * t.scale for t in point.regressors])
    return np.asarray(np.einsum("tilc,cf,fl->tif", tangents, np.stack([np.ones_like(w), 1j * w]), x))


def _harmonic_slope(model: Model, one: PeriodicEffect, place: str, count: int, k: int) -> Complexes:
    """(count,) derivative of the harmonics with respect to parameter k, N per unit."""
    q = one.effect.parameters[k]
    h = 1.0 if q.linear else 0.01 if q.name == "angle" else 0.01 * abs(one.p[k])
    up, down = one.p.copy(), one.p.copy()
    up[k] += h
    down[k] -= h
    both = (one.harmonics(model, place, count, p) for p in (up, down))
    return np.asarray((next(both) - next(both)) / (2 * h))


def _piece_index(n: int) -> NDArray[np.int64]:
    """(n,) index of the piece that holds each sample."""
    return np.minimum((np.arange(n) * RECORD_PIECES) // n, RECORD_PIECES - 1)


def demodulate(force: Series, angle: Array, count: int) -> Complexes:
    """(pieces, count) harmonics of a force (n,) N over an angle (n,) rad, by folding each piece of the record."""
    pieces = _piece_index(force.size)
    bins = 1 << int(np.ceil(np.log2(8 * count)))
    cell = ((angle / (2 * np.pi)) % 1.0 * bins).astype(np.int64) % bins
    folded = np.bincount(pieces * bins + cell, force, RECORD_PIECES * bins).reshape(RECORD_PIECES, bins)
    k = np.arange(1, count + 1)
    F = np.fft.rfft(folded, axis=1)[:, 1 : count + 1] * np.exp(-1j * np.pi * k / bins) / np.sinc(k / bins)
    return np.asarray(2 * F / np.bincount(pieces)[:, None])


def residual_harmonics(point: WorkingPoint, i: int, angle: Array, count: int) -> Complexes:
    """(count,) harmonics of the residual force at location i over an angle (n,) rad, N, under a window."""
    window = np.sin(np.pi * (np.arange(RECORD_PIECES) + 0.5) / RECORD_PIECES) ** 2
    return np.asarray(np.average(demodulate(point.force[i], angle, count), axis=0, weights=window))


def residual_shows_lines(point: WorkingPoint, f_hz: Array) -> NDArray[np.bool_]:
    """(f,) whether the residual force shows a line better than the motion: the line is in the band, and laws act."""
    data = point.data
    if not point.placed:
        return np.zeros(f_hz.size, bool)
    taken_out = () if data.deflects_at_lines else data.lines
    there = np.array([not any(line.holds(hz) for line in taken_out) for hz in f_hz], bool)
    return np.asarray(there & (passband(f_hz, data.rate_hz, data.band) > LIMITS.min_band_gain))
