"""Faults of the path from a measured force to the motion of its place: gain and delay of the motion sensor.

Noise of the motion sensor and forces that nobody measures are independent of the measured force f. The part of the
residual force R = A a - f that is coherent with f is therefore an error of the tangent A of the fit: that of the path
is A - <R f*> / <a f*>. A known mass identifies the gain: with gain 1 + error it appears as m / (1 + error). Noise q of
the force channel gives <R f*> = -<|q|^2> and looks like a gain by its share of the power; no smaller gain is named.
An error that neither fault explains is unknown: a pedestal, a sensor resonance and a cable ripple bias it alike.

References
----------
Bendat and Piersol, Random Data, 2010, ch. 6: the estimate H1 and its variance.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from estimator.arrays import Array, Complexes
from estimator.effects import CATALOGUE
from estimator.effects.places import at, written
from estimator.identification.finding import UNKNOWN_EFFECT, Finding
from estimator.likelihood.motion.harmonics import known_lines
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import Model
from estimator.results import Parameter
from estimator.signals.channel_response import GAIN_AND_DELAY, fault_response, measured_force_places

from .thresholds import LIMITS


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredPath:
    """Spectra of one place by cells of the band.

    Attributes
    ----------
    w, hz, n : (cells,) float64
        Mean angular frequency, rad/s; width, Hz; independent numbers.
    A, error : (cells,) complex128
        Tangent of the fit, and its excess over the tangent of the path, kg.
    per_force : (cells,) float64
        Coherent force per error of the tangent, N/Hz^0.5 per kg.
    rest, force : (cells,) float64
        PSD of the residual force that is not coherent with the measured force, and PSD of the measured force.
    noise_share : float
        Share of the residual force that is noise of the force channel.
    """

    w: Array
    hz: Array
    n: Array
    A: Complexes
    error: Complexes
    per_force: Array
    rest: Array
    force: Array
    noise_share: float

    def coherent(self, error: Complexes) -> tuple[float, float]:
        """Power (N^2) that an error of the tangent (cells,) leaves coherent, and its excess over chance, sd."""
        odd, chance = np.abs(error * self.per_force) ** 2, self.rest / self.n
        return float((odd - chance) @ self.hz), float(np.sum(odd / chance - 1.0) / np.sqrt(odd.size))


@dataclass(frozen=True, slots=True)
class FaultFit:
    """The likeliest path with a fault. p, sd : parameter. nats. left : (cells,) kg, residual error of the tangent."""

    p: float
    sd: float
    nats: float
    left: Complexes


def measured_path(point: WorkingPoint, i: int, lines: Collection[float] = ()) -> MeasuredPath | None:
    """The spectra of place i; None where the band has too few bins. lines : Hz, tones whose bins are left out."""
    data = point.data
    w, spacing = 2 * np.pi * data.f_hz, data.rate_hz / data.block
    R = _spectra(point.force[i], data.block, data.start)[:, data.bins]
    motion = [1j * w * _spectra(data.v[j], data.block, data.start)[:, data.bins] for j in range(len(data.places))]
    f = sum(point.A[:, i, j] * a for j, a in enumerate(motion) if point.A[:, i, j].any()) - R
    keep = np.all([np.abs(data.f_hz - hz) > LIMITS.line_half_width_bins * spacing for hz in lines] or [w > 0.0], axis=0)
    if keep.sum() < LIMITS.min_cells:
        return None
    edges = np.unique(np.round(np.geomspace(LIMITS.single_bin_cells, keep.sum(), LIMITS.max_cells)).astype(int))
    first = np.concatenate([np.arange(LIMITS.single_bin_cells), edges[:-1]])
    width = np.diff(np.append(first, keep.sum())).astype(np.float64)

    def mean(z: NDArray[np.generic]) -> Complexes:
        return np.asarray(np.add.reduceat(z[keep], first) / width)

    scale = 2.0 / (data.rate_hz * 0.375 * data.block)
    rr, rf, af, ff = (mean(scale * np.mean(p * q.conj(), axis=0)) for p, q in ((R, R), (R, f), (motion[i], f), (f, f)))
    return MeasuredPath(
        w=mean(w).real, hz=spacing * width, n=LIMITS.independent_per_bin * width * len(R), A=mean(point.A[:, i, i]),
        error=rf / af, per_force=np.abs(af) / np.sqrt(ff.real),
        rest=np.maximum(rr.real - np.abs(rf) ** 2 / ff.real, 1e-12 * rr.real), force=ff.real,
        noise_share=float(-(rf.real @ width) / (rr.real @ width)),
    )  # fmt: skip


def _spectra(z: Array, block: int, start: NDArray[np.int64]) -> NDArray[np.complex64]:
    """(blocks, bins) spectra under Hann windows of a series z (n,) of blocks laid end to end.

    start : (blocks,) first row of each block. Windows overlap by half where the record is contiguous.
    """
    from scipy.fft import rfft

    rows = z.reshape(-1, block).astype(np.float32)
    on = np.flatnonzero(np.diff(start) == block)
    half = block // 2
    between = np.concatenate([rows[on, half:], rows[on + 1, :half]], axis=1)
    window = (0.5 - 0.5 * np.cos(2 * np.pi * np.arange(block) / block)).astype(np.float32)
    return np.asarray(rfft(np.concatenate([rows, between]) * window, axis=1))


def fit_path(r: MeasuredPath, effect: str | None = None, starts: Collection[float] = (0.0,)) -> FaultFit:
    """The likeliest stiffness and damping of the path, with a fault of the sensor or without."""
    from scipy.optimize import least_squares

    weight = np.sqrt(2.0 * r.n / r.rest) * r.per_force
    k = float(np.average(np.abs(r.A) * r.w**2, weights=weight**2))
    unit = np.array([k, k / float(np.mean(r.w))])
    if effect is not None:
        unit = np.append(unit, 1.0 / r.w[-1] if is_delay(effect) else 1.0)

    def error_left(z: Array) -> Complexes:
        u = z * unit
        path = r.A - u[0] / r.w**2 + u[1] / (1j * r.w)
        if effect is not None:
            path = path / fault_response(effect, {CATALOGUE[effect].parameters[0].name: float(u[2])}, r.w)
        return np.asarray(path - r.A + r.error)

    def residual(z: Array) -> Array:
        odd = error_left(z) * weight
        return np.concatenate([odd.real, odd.imag])

    points = [np.append(np.zeros(2), start / unit[2:]) for start in starts]
    best = min((least_squares(residual, z) for z in points), key=lambda one: float(one.cost))
    J: Array = np.asarray(best.jac, np.float64)
    sd = np.sqrt(np.diag(np.linalg.pinv(J.T @ J))) * unit
    return FaultFit(float(best.x[-1] * unit[-1]), float(sd[-1]), -float(best.cost), error_left(best.x))


def is_delay(effect: str) -> bool:
    """Whether the parameter of a sensor's fault is a time; else it is a relative error."""
    return CATALOGUE[effect].parameters[0].unit == "s"


def _tried_faults(point: WorkingPoint, i: int, r: MeasuredPath, names: Collection[str]) -> dict[str, FaultFit]:
    """The fit with each of some faults at place i."""
    delays = [d / point.data.rate_hz for d in LIMITS.delay_starts_samples]
    return {name: fit_path(r, name, delays if is_delay(name) else LIMITS.gain_starts_rel) for name in names}


def find_path_faults(model: Model, point: WorkingPoint, lines: Collection[float] = ()) -> list[Finding]:
    """Gains and delays of sensors that the model lacks, and biased paths, at the places whose force is measured.

    lines : Hz of periodic forces in the residual, which are left out.
    """
    out = []
    for i, place in enumerate(point.data.places):
        if place in measured_force_places(model) and point.kL[i] > 0.0:
            r = measured_path(point, i, lines)
            out += [] if r is None else _place_findings(model, point, i, r)
    return out


def _place_findings(model: Model, point: WorkingPoint, i: int, r: MeasuredPath) -> list[Finding]:
    """Findings at place i: the faults that explain the error of the path, or an unknown one."""
    place, base = point.data.places[i], fit_path(r)
    least = (LIMITS.negligible_force_share * point.bearing_force[i]) ** 2
    power, z = r.coherent(base.left)
    if power < least or z < LIMITS.min_bias_sd:
        return []
    taken = {u.name for u in model.effects if place in u.parameters or place.split(".")[0] in u.parameters}
    known = model.cap_mass(place) is not None
    names = [name for name in GAIN_AND_DELAY if name not in taken and (known or is_delay(name))]
    tried = _tried_faults(point, i, r, names)
    noise = float(np.average(r.rest / r.force, weights=r.hz))
    out = []
    for name, fit in tried.items():
        explained = power - r.coherent(fit.left)[0]
        gain, q = fit.nats - base.nats, CATALOGUE[name].parameters[0]
        p = float(min(1.0, chdtrc(1, 2 * max(gain, 0.0)) * len(tried) * len(point.data.places)))
        if explained < max(LIMITS.min_explained_share * power, least) or p > LIMITS.max_fault_p_value:
            continue
        if not is_delay(name) and max(-LIMITS.min_gain_over_noise * noise, -1.0) < fit.p < LIMITS.min_gain_error_rel:
            return []  # within calibration, or noise of the force channel
        out.append(
            Finding(
                effect=name, at=(place,), gain_nats=gain, dof=1, p_value=p, power_N2={i: explained},
                against="frequency", region=_bias_region(r, base.left), note=CATALOGUE[name].distinguish,
                settings={place: {q.name: Parameter(fit.p, fit.sd, q.unit)}},
            )
        )  # fmt: skip
    if out:
        return out
    return [
        Finding(
            effect=UNKNOWN_EFFECT, at=(place,), gain_nats=z * z / 2, dof=r.n.size, p_value=float(np.exp(-z * z / 2)),
            power_N2={i: power}, against="frequency", region=_bias_region(r, base.left),
        )
    ]  # fmt: skip


def _bias_region(r: MeasuredPath, error: Complexes) -> str:
    """Where the motion deviates most from the response to the measured force, in words."""
    k = int(np.argmax(np.abs(error * r.per_force) ** 2 * r.n / r.rest))
    return f"the motion does not follow the measured force as the model predicts near {r.w[k] / 2 / np.pi:.0f} Hz"


def force_noise_ratio(model: Model, point: WorkingPoint) -> dict[str, float]:
    """Power of the noise of a force channel over that of the force, by place, where it biases the damping.

    The fit takes the residual force for a force that nobody measures. Noise of the force channel makes c too large by
    this ratio.
    """
    out = {}
    for i, place in enumerate(point.data.places):
        known = place in measured_force_places(model) and model.cap_mass(place) is not None and point.kL[i] > 0.0
        r = measured_path(point, i, known_lines(model)) if known else None
        if r is not None:
            rest = r.noise_share * float(np.average(r.rest / r.force, weights=r.hz))  # p (1 - p), p the share of noise
            share = 0.5 * (1.0 - float(np.sqrt(max(1.0 - 4.0 * rest, 0.0))))
            out[place] = share / (1.0 - share)
    return {place: ratio for place, ratio in out.items() if ratio > LIMITS.min_force_noise_ratio}


def refine_sensor_faults(model: Model, point: WorkingPoint) -> tuple[Model, dict[str, Parameter]]:
    """The model with gains and delays of sensors after one step, and these parameters keyed "location.effect.name".

    The record of the point has the faults undone at their present values. Two faults of a sensor take turns.
    """
    found: dict[str, Parameter] = {}
    uses = []
    for use in model.effects:
        new = {key: dict(own) for key, own in use.parameters.items()}
        for key in at(CATALOGUE[use.name], use, model) if use.name in GAIN_AND_DELAY else ():
            (q,), i = CATALOGUE[use.name].parameters, point.data.places.index(key)
            own = written(CATALOGUE[use.name], use, model, key)
            now = own[q.name].value if q.name in own else None
            path = measured_path(point, i, known_lines(model)) if key in measured_force_places(model) else None
            if path is None or now is None or own[q.name].fixed or point.kL[i] <= 0.0:
                continue
            more = _tried_faults(point, i, path, [use.name])[use.name]
            value, sd = now + more.p, more.sd
            if not is_delay(use.name):
                value, sd = (1.0 + now) * (1.0 + more.p) - 1.0, abs(1.0 + now) * more.sd
            new.pop(key.split(".")[0], None)
            new[key] = own | {q.name: replace(own[q.name], value=value)}
            found[f"{key}.{use.name}.{q.name}"] = Parameter.from_estimate(value, sd, q.unit)
        uses.append(replace(use, parameters=new))
    return replace(model, effects=tuple(uses)), found
