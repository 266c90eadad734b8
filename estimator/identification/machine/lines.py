"""Periodic forces: lines in the inferred force, inside the band or outside it, and what could make them.

A line at f in the accelerations of all caps is a force A(f) a(f) on the caps, A the tangent of the fitted model. Its
strength is judged against the noise of the neighbouring frequencies, so it is seen even where the band ends: a shaft
order below the band is not hidden. |Y|^2 over its local mean is exponential where there is no line. Where the force is
measured, A(f) a(f) less that force is looked at instead: a line that it has itself is nothing that the model lacks.

Which cause: a rotating force on the disc (imbalance, bow: order 1, forward, in the proportion that the shaft passes
to both caps), a cap force at order 2 (misalignment), a train of harmonics of a bearing order (local_defect), or a
line at a frequency of its own. An imbalance and a bow load the caps alike at every speed; the usual one is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.identification.finding import Finding
from estimator.identification.residual.missing_force import NEGLIGIBLE_FORCE_SHARE
from estimator.likelihood.motion.force_balance import shaft_notch
from estimator.likelihood.motion.harmonics import cap_force_per_shaft_force, known_lines
from estimator.likelihood.path.working_point import WorkingPoint, tangent_at
from estimator.model.rig import Model
from estimator.results import Parameter
from estimator.signals.band_limit import noise_shape
from estimator.signals.channel_response import corrected_record
from estimator.signals.line_spectrum import LineSpectrum, line_spectrum, order_spectrum, residual_spectrum

from . import beyond_harmonics, impact_train

SURE = 1.3  # the local noise is known to about a tenth: so much more is asked of a line
LEVEL = 1e-4  # chance of one false line in a record, in a blind search
NEAR_DISC = 0.04  # of the disc's resonance on its shaft, on either side
UNSURE_DISC = 0.25  # of the same, where it may be: a shaft 30 % stiffer, or a disc a fifth lighter, than was said
ALIKE = 0.02  # of a line in two channels or at two caps, that they may differ by
KNOWN_LEVEL = 1e-4  # at an order that is looked at on purpose


def find_lines(model: Model, point: WorkingPoint, y: Array) -> list[Finding]:
    """Every periodic force that the model does not have yet, by cause."""
    s = searched_spectrum(model, point, y, point.data.rate_hz)
    known = known_lines(model)
    rotation = (model.speed_rpm or 0.0) / 60.0
    tracked = [] if s.phase is None else [rotation, 2 * rotation]
    threshold = SURE * float(np.log(s.Y.size / LEVEL))
    lines = [
        hz for hz in _standing(s, (*known, *tracked), threshold)
        if not _about_disc(model, hz) or (s.over_neighbours(hz) > threshold and not _through_disc(point, s, hz))
    ]  # fmt: skip
    out: list[Finding] = []
    if rotation > 0.0 and not any(use.name == "local_defect" for use in model.effects):
        turned = order_spectrum(s)
        own = lines if turned is s else _standing(turned, known, threshold)
        defect, fundamental = impact_train.find_impact_train(model, point, turned, own, rotation, known)
        if defect is not None:
            lines = [hz for hz in lines if not _multiple(s, hz, fundamental)]
            out.append(defect)
    if rotation > 0.0:
        looked = [k * rotation for k in (1, 2)]
        lines += [hz for hz in looked if not any(abs(hz - h) < s.width(hz) for h in [*lines, *known])]
    for hz in lines:
        if hz not in tracked and not s.steady(hz):
            continue
        suspect = _one_line(model, point, s, hz, rotation, threshold)
        if suspect is not None:
            out.append(suspect)
    return out if rotation > 0.0 else _of_one_cause(out, s)


def _of_one_cause(lines: list[Finding], s: LineSpectrum) -> list[Finding]:
    """Lines of a shaft of no known speed, the first with what they are multiples of: strikes have no angle there."""
    hz = impact_train.common_fundamental(
        [next(iter(one.settings.values()))["frequency"].value or 0.0 for one in lines], s.seconds
    )
    if hz == 0.0:
        return lines
    said = f"multiples of {hz:.3f} Hz, as of impacts or mains hum: give speed_rpm to search for an impact train"
    return [replace(lines[0], note="; ".join(filter(None, (lines[0].note, said)))), *lines[1:]]


def _about_disc(model: Model, hz: float) -> bool:
    """Whether the disc may resonate there on its shaft, if both are not quite those of the rig file."""
    notch = shaft_notch(model)
    return notch is not None and abs(hz / (0.5 * sum(notch)) - 1.0) < UNSURE_DISC


def _through_disc(point: WorkingPoint, s: LineSpectrum, hz: float) -> bool:
    """Whether a line loads both caps alike, as a disc does that resonates elsewhere than the rig file says: one that
    rings for longer than the record cannot be told from a line."""
    F, noise = line_forces(point, s, hz)
    pairs = [(i, j) for i in range(len(F)) if (j := point.data.opposite(i)) is not None and i < j]
    return bool(pairs) and all(
        abs(F[i] - F[j]) < ALIKE * abs(F[i] + F[j]) / 2 + 3.0 * np.sqrt(noise[i] + noise[j]) for i, j in pairs
    )


def searched_spectrum(model: Model, point: WorkingPoint, y: Array, rate_hz: float) -> LineSpectrum:
    """The spectrum that lines are sought in: of the motion, or beside a measured force of what it leaves."""
    if not point.data.measured_force:
        return line_spectrum(model, y, rate_hz)
    places = point.data.places
    rows = {places.index(c.place): k for k, c in enumerate(model.channels) if c.kind == "force" and c.place in places}
    s = residual_spectrum(
        line_spectrum(model, corrected_record(model, y, rate_hz), rate_hz), y, rows,
        lambda f_hz: tangent_at(point, model, f_hz),
    )  # fmt: skip
    if (notch := shaft_notch(model)) is not None:  # whatever is wrong rings there like a line
        s.noise[:, np.abs(s.f_hz / (0.5 * sum(notch)) - 1.0) < NEAR_DISC] = np.inf
    return s


def _standing(s: LineSpectrum, known: Sequence[float], threshold: float) -> list[float]:
    """Frequencies of the bins that stand out in any channel, neighbours joined, strongest first, refined."""
    best = np.max([(Y.real**2 + Y.imag**2) / noise for Y, noise in zip(s.Y, s.noise, strict=True)], axis=0)
    usable = (s.f_hz > max(3.0, 20 / s.seconds)) & (s.f_hz < 0.47 * s.rate_hz)
    for hz in known:
        usable &= np.abs(s.f_hz - hz) > s.width(hz)
    high = np.flatnonzero(usable & (best >= threshold))
    out: list[float] = []
    for k in high[np.argsort(-best[high])][:4000]:
        hz = float(s.f_hz[k])
        if all(abs(hz - h) > 4.0 / s.seconds for h in out):
            out.append(_centre(s, int(k), int(np.argmax(np.abs(s.Y[:, k]) ** 2 / s.noise[:, k]))))
        if len(out) >= 200:
            break
    return out


def _centre(s: LineSpectrum, k: int, i: int) -> float:
    """Peak frequency under a Hann window from three bins (ratio of amplitudes)."""
    a, b, c = (float(np.abs(s.Y[i, j])) for j in (k - 1, k, min(k + 1, s.f_hz.size - 1)))
    shift = (2 * c - b) / (b + c) if c >= a else -(2 * a - b) / (a + b)
    return float(s.f_hz[k] + np.clip(shift, -0.7, 0.7) / s.seconds)


def line_forces(point: WorkingPoint, s: LineSpectrum, hz: float, order: int = 0) -> tuple[Complexes, Array]:
    """(places,) complex force amplitudes in N of a line, and (places,) the variance E|.|^2 of their noise.

    order : of the shaft, if it is one.
    """
    Y, noise = s.at_order(order, hz / order) if order else s.at(hz)
    if set(s.kinds) == {"force"}:
        return Y, noise
    A = tangent_at(point, s.model, np.array([hz]))[0]
    low, high = s.model.band
    return A @ Y, _noise_about(point, s, hz) if low <= hz <= high else (np.abs(A) ** 2) @ noise


def _noise_about(point: WorkingPoint, s: LineSpectrum, hz: float) -> Array:
    """(places,) E|.|^2 of the forces about a line in the band.

    What a shaft brings over from the other caps is in step with what it meets: apart, the caps would make 20 000 times
    that where a disc resonates. The noise of sensors, in A y, is loudest there, within less than these surroundings.
    Outside of the band it rises too steeply to be told so.
    """
    near = s.about(hz)
    f_hz = np.append(s.f_hz[near], hz)
    A = tangent_at(point, s.model, f_hz)
    heard = (point.nu * point.S)[:, None] * noise_shape(s.kinds, 2 * np.pi * f_hz)
    expected = point.S[:, None] + np.einsum("fij,jf->if", np.abs(A) ** 2, heard)
    F = np.einsum("fij,jf->if", A[:-1], s.accelerations(near))
    level = np.median((F.real**2 + F.imag**2) / expected[:, :-1], axis=1) / np.log(2)
    return np.asarray(level * expected[:, -1])


def _one_line(
    model: Model, point: WorkingPoint, s: LineSpectrum, hz: float, rotation: float, threshold: float
) -> Finding | None:
    """The finding of a line at a frequency (Hz), with its likeliest cause; None where it does not stand out.

    rotation : Hz of the shaft, 0 where unknown. threshold : |F|^2 over its noise that a line away from orders 1 and 2
    needs.
    """
    order = next((k for k in (1, 2) if rotation > 0 and abs(hz - k * rotation) < 2.0 / s.seconds), 0)
    if order:
        hz = order * rotation  # a tenth of a bin beside it, the phase at t = 0 would be off by a third
    F, noise = line_forces(point, s, hz, order)
    Z = np.where(_made_by_laws(point, hz, order, F), 0.0, np.abs(F) ** 2 / noise)
    total, P = float(Z.sum()), len(Z)
    needed = float(np.log(P / KNOWN_LEVEL)) + 6.0 if order else threshold
    if Z.max() < needed and total < needed + 3 * P:
        return None
    power = {i: float(np.abs(F[i]) ** 2 / 2) for i in range(P) if Z[i] > 5}
    if point.data.measured_force:
        power = {i: w for i, w in power.items() if w > (NEGLIGIBLE_FORCE_SHARE * point.bearing_force[i]) ** 2}
        Z[[i for i in range(P) if i not in power]] = 0.0
        if not power:
            return None
    p = float(min(1.0, np.exp(-(total - P)) * (4 if order else Z.size * s.f_hz.size)))
    if order == 1 and (found := _imbalance(model, point, F, noise, total, hz, p, power)) is not None:
        return found
    at = [i for i in range(P) if Z[i] > 9] or [int(np.argmax(Z))]
    what = f"{order} x shaft speed ({hz:.2f} Hz)" if order else f"{hz:.3f} Hz"
    if not order and rotation > 0:
        what += f", {hz / rotation:.3f} x shaft speed"
    return Finding(
        effect="misalignment" if order == 2 else "line",
        at=tuple(point.data.places[i] for i in at),
        gain_nats=total,
        dof=len(at) * 2 + (order != 2),
        p_value=p,
        power_N2=power,
        against="shaft_angle" if order else "frequency",
        region=what,
        settings={point.data.places[i]: _phasor(F[i], noise[i], None if order == 2 else (hz, Z[i], s)) for i in at},
        note="" if order else _whose(point, s, hz),
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


def _imbalance(
    model: Model, point: WorkingPoint, F: Complexes, noise: Array, total: float, hz: float, p: float,
    power: dict[int, float],
) -> Finding | None:  # fmt: skip
    """The forces F (places,) at order 1 as one rotating force on the disc; None where that leaves a fifth of them."""
    if model.shaft == "none":
        return None
    weights = _disc(model, point, hz)
    f_d = complex(np.sum(np.conj(weights) * F / noise) / np.sum(np.abs(weights) ** 2 / noise))
    explained = float(np.sum(np.abs(weights) ** 2 / noise) * abs(f_d) ** 2)
    if total - explained >= 0.2 * total + 3 * F.size:
        return None
    sd = float(np.sqrt(0.5 / np.sum(np.abs(weights) ** 2 / noise)))
    return Finding(
        effect="imbalance",
        at=("disc",),
        gain_nats=explained,
        dof=2,
        p_value=p,
        power_N2=power,
        against="shaft_angle",
        region=f"1 x shaft speed ({hz:.2f} Hz), forward",
        settings={"disc": {"a": Parameter(f_d.real, sd, "N"), "b": Parameter(f_d.imag, sd, "N")}},
        note="a bowed shaft gives the same forces at one speed: its run-out at slow roll separates the two",
        detectable=(5 * sd, "N"),
    )


def _whose(point: WorkingPoint, s: LineSpectrum, hz: float) -> str:
    """What the channels say of whether a line is a force or hum that cables pick up; "" where they say nothing.

    Hum is the same acceleration everywhere; the same force on caps of different stiffness is not. In one channel a line
    may be either, as a cap hardly moves its neighbours.
    """
    if set(s.kinds) != {"acceleration"} or len(s.kinds) < 2:
        return ""
    Y, noise = s.at(hz)
    seen = np.abs(Y) ** 2 > 9.0 * noise
    if seen.sum() == 1:
        place = point.data.places[int(np.argmax(seen))]
        return f"only the channel of {place} shows the line: a force there, or hum, which a rotor at rest leaves"
    mean = np.mean(Y)
    alike = np.abs(Y - mean) < ALIKE * abs(mean) + 3.0 * np.sqrt(noise)
    if not alike.all() or np.sqrt(noise.max()) > 5.0 * ALIKE * abs(mean):
        return ""
    A = tangent_at(point, s.model, np.array([hz]))[0]
    moved = np.linalg.solve(A, np.ones(Y.size))
    if np.abs(moved / moved.mean() - 1.0).max() < 2.0 * ALIKE:
        return "the same acceleration in every channel: one force on all caps, or hum that the sensors pick up"
    return "the same acceleration in every channel: hum in the sensors, as a force would move these caps differently"


def _made_by_laws(point: WorkingPoint, hz: float, order: int, F: Complexes) -> NDArray[np.bool_]:
    """(places,) where the laws of the model make a line out of others. F : (places,) N by a linear reading."""
    data = point.data
    if data.measured_force or not beyond_harmonics.residual_tells(point, np.array([hz]))[0]:
        return np.zeros(F.size, bool)
    angle = order * data.phase if order else 2 * np.pi * hz * data.t
    left = np.array([beyond_harmonics.residual_harmonics(point, i, angle, 1)[0] for i in range(F.size)])
    return np.asarray(np.abs(left) < beyond_harmonics.LEAST * np.abs(F))


def _disc(model: Model, point: WorkingPoint, rotation: float) -> Complexes:
    """(places,) force at each cap per forward rotating force on the disc."""
    w = np.array([2 * np.pi * rotation])
    return np.array(
        [cap_force_per_shaft_force(model, p, w)[0] * (1.0 if p.endswith("x") else -1j) for p in point.data.places]
    )


def _multiple(s: LineSpectrum, hz: float, fundamental: float) -> bool:
    """Whether a line is a harmonic of a train."""
    k = max(1, round(hz / fundamental))
    return abs(hz - k * fundamental) < 2.0 * k / s.seconds + s.wander * hz
