"""Periodic forces: spectral lines of the motion, inside the band and outside it, and their likeliest causes.

A line at f in the accelerations a(f) of all caps is a force A(f) a(f) on the caps, where A is the mean tangent of the
fitted model. The strength of a line is judged against the noise at neighbouring frequencies. Without a line |Y|^2 over
its local mean is an exponential variable. If the force is measured, the spectrum of A(f) a(f) less that force is
searched: a line of the measured force itself is nothing that the model lacks.

Causes: a rotating force on the disc (imbalance or bow: order 1, forward, in the proportion in which the shaft loads the
caps), a cap force at order 2 (misalignment), an impact train at a bearing order (local_defect), or a line at a fixed
frequency. An imbalance and a bow load the caps alike at every speed; the imbalance is named.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.effects.engine.custom import effect_of
from estimator.effects.excitation.line import LINE
from estimator.effects.rotating.imbalance import IMBALANCE
from estimator.effects.rotating.misalignment import MISALIGNMENT
from estimator.identification.finding import Finding
from estimator.likelihood.motion.force_balance import shaft_notches
from estimator.likelihood.motion.harmonics import cap_force_per_shaft_force, known_lines
from estimator.likelihood.path.working_point import WorkingPoint, tangent_at
from estimator.model.rig import Model
from estimator.results import Parameter
from estimator.signals.band_limit import noise_shape
from estimator.signals.channel_response import corrected_record
from estimator.signals.line_spectrum import (
    LineSpectrum,
    hann_peak_offset_bins,
    line_spectrum,
    order_spectrum,
    residual_spectrum,
)

from . import harmonic_fit, impact_train
from .thresholds import LIMITS


def find_lines(model: Model, point: WorkingPoint, y: Array) -> list[Finding]:
    """Periodic forces that the model lacks, each with its likeliest cause. y : (n, channels) SI."""
    s = searched_spectrum(model, point, y, point.data.rate_hz)
    known = known_lines(model)
    rotation = (model.speed_rpm or 0.0) / 60.0
    tracked = [] if s.phase is None else [rotation, 2 * rotation]
    threshold = LIMITS.noise_margin_rel * float(np.log(s.Y.size / LIMITS.false_line_chance))
    lines = [
        hz
        for hz in _outstanding_lines(s, (*known, *tracked), threshold)
        if not _near_disc_resonance(model, hz)
        or (s.over_neighbours(hz) > threshold and not _loads_caps_alike(point, s, hz))
    ]
    out: list[Finding] = []
    if rotation > 0.0 and not any(effect_of(use).harmonics == "all" for use in model.effects):
        turned = order_spectrum(s)
        own = lines if turned is s else _outstanding_lines(turned, known, threshold)
        defect, fundamental = impact_train.find_impact_train(model, point, turned, own, rotation, known)
        if defect is not None:
            lines = [hz for hz in lines if not _is_harmonic(s, hz, fundamental)]
            out.append(defect)
    if rotation > 0.0:
        looked = [k * rotation for k in (1, 2)]
        lines += [hz for hz in looked if not any(abs(hz - h) < s.width(hz) for h in [*lines, *known])]
    for hz in lines:
        if hz not in tracked and not s.steady(hz):
            continue
        if (found := _line_finding(model, point, s, hz, rotation, threshold)) is not None:
            out.append(found)
    return out


def _near_disc_resonance(model: Model, hz: float) -> bool:
    """Whether the disc may resonate at hz, within the uncertainty of shaft stiffness and disc mass."""
    return any(abs(hz / (0.5 * sum(notch)) - 1.0) < LIMITS.disc_uncertainty_rel for notch in shaft_notches(model))


def _loads_caps_alike(point: WorkingPoint, s: LineSpectrum, hz: float) -> bool:
    """Whether a line loads both caps alike, as the disc resonance does.

    A disc resonance that rings for longer than the record looks like a line.
    """
    F, noise = line_forces(point, s, hz)
    pairs = [(i, j) for i in range(len(F)) if (j := point.data.opposite(i)) is not None and i < j]
    return bool(pairs) and all(
        abs(F[i] - F[j]) < LIMITS.line_tolerance_rel * abs(F[i] + F[j]) / 2 + 3.0 * np.sqrt(noise[i] + noise[j])
        for i, j in pairs
    )


def searched_spectrum(model: Model, point: WorkingPoint, y: Array, rate_hz: float) -> LineSpectrum:
    """The spectrum in which lines are searched: of the motion, or of the residual force if the force is measured."""
    if not point.data.measured_force:
        return line_spectrum(model, y, rate_hz)
    places = point.data.places
    rows = {places.index(c.place): k for k, c in enumerate(model.channels) if c.kind == "force" and c.place in places}
    s = residual_spectrum(
        line_spectrum(model, corrected_record(model, y, rate_hz), rate_hz), y, rows,
        lambda f_hz: tangent_at(point, model, f_hz),
    )  # fmt: skip
    for notch in shaft_notches(model):  # any error of the model rings there like a line
        s.noise[:, np.abs(s.f_hz / (0.5 * sum(notch)) - 1.0) < LIMITS.disc_notch_rel] = np.inf
    return s


def _outstanding_lines(s: LineSpectrum, known: Sequence[float], threshold: float) -> list[float]:
    """Frequencies (Hz) of lines that exceed the threshold in any channel, strongest first. known : Hz to leave out."""
    best = np.zeros(s.f_hz.size)
    for Y, noise in zip(s.Y, s.noise, strict=True):
        np.maximum(best, (Y.real**2 + Y.imag**2) / noise, out=best)
    usable = (s.f_hz > max(3.0, 20 / s.seconds)) & (s.f_hz < 0.47 * s.rate_hz)
    for hz in known:
        usable &= np.abs(s.f_hz - hz) > s.width(hz)
    high = np.flatnonzero(usable & (best >= threshold))
    out: list[float] = []
    for k in high[np.argsort(-best[high])][:4000]:
        hz = float(s.f_hz[k])
        if all(abs(hz - h) > 4.0 / s.seconds for h in out):
            out.append(_peak_hz(s, int(k), int(np.argmax(np.abs(s.Y[:, k]) ** 2 / s.noise[:, k]))))
        if len(out) >= 200:
            break
    return out


def _peak_hz(s: LineSpectrum, k: int, i: int) -> float:
    """Frequency (Hz) of the peak at bin k of channel i, from the amplitudes of three bins."""
    three = np.abs(s.Y[i, [k - 1, k, min(k + 1, s.f_hz.size - 1)]]).astype(np.float64)
    return float(s.f_hz[k]) + hann_peak_offset_bins(three) / s.seconds


def line_forces(point: WorkingPoint, s: LineSpectrum, hz: float, order: int = 0) -> tuple[Complexes, Array]:
    """(places,) complex force amplitudes of a line at hz, N, and (places,) the variance E|.|^2 of their noise, N^2.

    order : of the shaft; 0 for a line at a fixed frequency.
    """
    Y, noise = s.at_order(order, hz / order) if order else s.at(hz)
    if set(s.kinds) == {"force"}:
        return Y, noise
    A = tangent_at(point, s.model, np.array([hz]))[0]
    low, high = s.model.band
    return A @ Y, _force_noise(point, s, hz) if low <= hz <= high else (np.abs(A) ** 2) @ noise


def _force_noise(point: WorkingPoint, s: LineSpectrum, hz: float) -> Array:
    """(places,) variance E|.|^2 of the forces near a line in the band, N^2.

    The forces of all caps are combined with their phases, as the shaft couples the caps: the sum of their powers is
    20 000 times too large at the disc resonance. The expected shape contains sensor noise referred to force, which
    changes within the surrounding bins. Outside the band it rises too steeply for this estimate.
    """
    near = s.about(hz)
    f_hz = np.append(s.f_hz[near], hz)
    A = tangent_at(point, s.model, f_hz)
    sensor_noise = (point.nu * point.S)[:, None] * noise_shape(s.kinds, 2 * np.pi * f_hz)
    expected = point.S[:, None] + np.einsum("fij,jf->if", np.abs(A) ** 2, sensor_noise)
    F = np.einsum("fij,jf->if", A[:-1], s.accelerations(near))
    level = np.median((F.real**2 + F.imag**2) / expected[:, :-1], axis=1) / np.log(2)
    return np.asarray(level * expected[:, -1])


def _line_finding(
    model: Model, point: WorkingPoint, s: LineSpectrum, hz: float, rotation: float, threshold: float
) -> Finding | None:
    """The finding of a line at a frequency (Hz), with its likeliest cause; None where it does not stand out.

    rotation : Hz of the shaft, 0 where unknown. threshold : |F|^2 over its noise that a line away from orders 1 and 2
    needs.
    """
    order = next((k for k in (1, 2) if rotation > 0 and abs(hz - k * rotation) < 2.0 / s.seconds), 0)
    if order:
        hz = order * rotation  # an error of 0.1 bin would turn the phase at t = 0 by a third of a radian
    F, noise = line_forces(point, s, hz, order)
    Z = np.where(_made_by_laws(point, hz, order, F), 0.0, np.abs(F) ** 2 / noise)
    total, P = float(Z.sum()), len(Z)
    needed = float(np.log(P / LIMITS.false_order_chance)) + 6.0 if order else threshold
    if Z.max() < needed and total < needed + 3 * P:
        return None
    power = {i: float(np.abs(F[i]) ** 2 / 2) for i in range(P) if Z[i] > 5}
    if point.data.measured_force:
        power = {i: w for i, w in power.items() if w > (LIMITS.negligible_force_share * point.bearing_force[i]) ** 2}
        Z[[i for i in range(P) if i not in power]] = 0.0
        if not power:
            return None
    p = float(min(1.0, np.exp(-(total - P)) * (4 if order else Z.size * s.f_hz.size)))
    if order == 1 and (found := _imbalance_finding(model, point, F, noise, total, hz, p, power)) is not None:
        return found
    at = [i for i in range(P) if Z[i] > 9] or [int(np.argmax(Z))]
    what = f"{order} x shaft speed ({hz:.2f} Hz)" if order else f"{hz:.3f} Hz"
    if not order and rotation > 0:
        what += f", {hz / rotation:.3f} x shaft speed"
    return Finding(
        effect=MISALIGNMENT.name if order == 2 else LINE.name,
        at=tuple(point.data.places[i] for i in at),
        gain_nats=total,
        dof=len(at) * 2 + (order != 2),
        p_value=p,
        power_N2=power,
        against="shaft_angle" if order else "frequency",
        region=what,
        settings={point.data.places[i]: _phasor(F[i], noise[i], None if order == 2 else (hz, Z[i], s)) for i in at},
        note="" if order else _force_or_hum(point, s, hz),
        detectable=(float(5 * np.sqrt(noise.min() / 2)), "N"),
    )


def _phasor(F: complex, noise: float, line: tuple[float, float, LineSpectrum] | None) -> dict[str, Parameter]:
    """Parameters of a force F cos(w t) with noise E|.|^2, N^2. line : Hz, |F|^2 / noise; None at a known frequency."""
    sd = float(np.sqrt(noise / 2))
    values = {"a": Parameter(F.real, sd, "N"), "b": Parameter(-F.imag, sd, "N")}
    if line is not None:
        hz, over_noise, s = line
        values["frequency"] = Parameter(hz, 0.3 / s.seconds / float(np.sqrt(over_noise)), "Hz")
    return values


def _imbalance_finding(
    model: Model, point: WorkingPoint, F: Complexes, noise: Array, total: float, hz: float, p: float,
    power: dict[int, float],
) -> Finding | None:  # fmt: skip
    """The forces F (places,) at order 1 as one rotating force on a disc; None where that leaves a fifth of them."""
    tried = []
    for disc in model.discs:
        weights = _cap_forces_of_disc(model, point, disc, hz)
        information = float(np.sum(np.abs(weights) ** 2 / noise))
        force = complex(np.sum(np.conj(weights) * F / noise)) / information
        tried.append((information * abs(force) ** 2, disc, force, float(np.sqrt(0.5 / information))))
    explained, disc, f_d, sd = max(tried, default=(0.0, "", 0j, 0.0))
    if not disc or total - explained >= 0.2 * total + 3 * F.size:
        return None
    return Finding(
        effect=IMBALANCE.name,
        at=(disc,),
        gain_nats=explained,
        dof=2,
        p_value=p,
        power_N2=power,
        against="shaft_angle",
        region=f"1 x shaft speed ({hz:.2f} Hz), forward",
        settings={disc: {"a": Parameter(f_d.real, sd, "N"), "b": Parameter(f_d.imag, sd, "N")}},
        note="a bowed shaft gives the same forces at one speed: its run-out at slow roll separates the two",
        detectable=(5 * sd, "N"),
    )


def _force_or_hum(point: WorkingPoint, s: LineSpectrum, hz: float) -> str:
    """A note on whether a line is a force or hum picked up by cables; empty where the channels do not show it.

    Hum is one acceleration in every channel; one force on caps of different stiffness is not. A line in one channel may
    be either, as a cap hardly moves its neighbours.
    """
    if set(s.kinds) != {"acceleration"} or len(s.kinds) < 2:
        return ""
    Y, noise = s.at(hz)
    visible = np.abs(Y) ** 2 > 9.0 * noise
    if visible.sum() == 1:
        place = point.data.places[int(np.argmax(visible))]
        return f"only the channel of {place} shows the line: a force there, or hum, which a rotor at rest leaves"
    mean = np.mean(Y)
    is_common = np.abs(Y - mean) < LIMITS.line_tolerance_rel * abs(mean) + 3.0 * np.sqrt(noise)
    if not is_common.all() or np.sqrt(noise.max()) > 5.0 * LIMITS.line_tolerance_rel * abs(mean):
        return ""
    A = tangent_at(point, s.model, np.array([hz]))[0]
    moved = np.linalg.solve(A, np.ones(Y.size))
    if np.abs(moved / moved.mean() - 1.0).max() < 2.0 * LIMITS.line_tolerance_rel:
        return "the same acceleration in every channel: one force on all caps, or hum that the sensors pick up"
    return "the same acceleration in every channel: hum in the sensors, as a force would move these caps differently"


def _made_by_laws(point: WorkingPoint, hz: float, order: int, F: Complexes) -> NDArray[np.bool_]:
    """(places,) whether the laws of the model make the line out of other lines.

    F : (places,) N, amplitudes of the force by the mean tangent. Laws are nonlinear, and the residual force of a line
    that they make is smaller than F.
    """
    data = point.data
    if data.measured_force or not harmonic_fit.residual_shows_lines(point, np.array([hz]))[0]:
        return np.zeros(F.size, bool)
    angle = order * data.phase if order else 2 * np.pi * hz * data.t
    residual = np.array([harmonic_fit.residual_harmonics(point, i, angle, 1)[0] for i in range(F.size)])
    return np.asarray(np.abs(residual) < LIMITS.min_unexplained_rel * np.abs(F))


def _cap_forces_of_disc(model: Model, point: WorkingPoint, disc: str, rotation: float) -> Complexes:
    """(places,) N at each cap per N of a forward rotating force on the disc. rotation : Hz."""
    w = np.array([2 * np.pi * rotation])
    return np.array([cap_force_per_shaft_force(model, disc, p, w) @ (1.0, -1j) for p in point.data.places])[:, 0]


def _is_harmonic(s: LineSpectrum, hz: float, fundamental: float) -> bool:
    """Whether a line at hz is a harmonic of an impact train."""
    k = max(1, round(hz / fundamental))
    return abs(hz - k * fundamental) < 2.0 * k / s.seconds + s.wander * hz
