"""Periodic forces: lines in the inferred force, inside the band or outside it, and what could make them.

A line at f in the accelerations of all caps is a force A(f) a(f) on the caps, A the tangent of the fitted model. Its
strength is judged against the noise of the neighbouring frequencies, so it is seen even where the band ends: a shaft
order below the band is not hidden. |Y|^2 over its local mean is exponential where there is no line.

Which cause: a rotating force on the disc (imbalance, bow: order 1, forward, in the proportion that the shaft passes
to both caps), a cap force at order 2 (misalignment), a train of harmonics of a bearing order (local_defect), or a
line at a frequency of its own. At one constant speed imbalance and bow are the same; the usual one is named.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .effects import CATALOGUE
from .effects.places import kinematic, orders
from .estimate import Parameter
from .model import Model
from .motion_blocks import shaft_response
from .periodic import known_lines, to_cap
from .suspect import Suspect
from .working_point import WorkingPoint, tangent_at

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]
NEIGHBOURS, THIN = 240, 4  # bins either side for the local noise, of which every fourth is looked at
BESIDE = 20  # bins on either side that a line is to be the main thing in
STEADY = 0.45  # of the power of these bins, what has the shape of a line
SURE = 1.3  # the local noise is known to about a tenth: so much more is asked of a line
LEVEL = 1e-4  # chance of one false line in a record, in a blind search
KNOWN_LEVEL = 1e-4  # at an order that is looked at on purpose


@dataclass(frozen=True, slots=True)
class Spectrum:
    """Whole-record spectrum under a Hann window. Y : (places, bins), amplitude of a line at the bin; noise : mean
    |Y|^2 of the surroundings. Single precision: its rounding is a thousandth of the noise of a line."""

    f_hz: Array
    Y: NDArray[np.complex64]
    noise: Array
    seconds: float
    windowed: NDArray[np.float32]  # (places, n) accelerations under the window
    rate_hz: float
    model: Model

    def at(self, hz: float) -> tuple[Complexes, Array]:
        """(places,) complex amplitudes (phase at t = 0) at any frequency, and their noise."""
        P, n = self.windowed.shape
        w = -2j * np.pi * hz / self.rate_hz
        step = 2048
        whole = n // step * step
        turn = np.exp(w * np.arange(step)).astype(np.complex64)
        inner = self.windowed[:, :whole].reshape(P, -1, step) @ np.stack([turn.real, turn.imag], axis=1)
        total = (inner[..., 0] + 1j * inner[..., 1]) @ np.exp(w * step * np.arange(whole // step))
        total = total + self.windowed[:, whole:] @ np.exp(w * np.arange(whole, n))
        amplitude = 2 * total / (0.5 * (n - 1))
        k = int(np.clip(round(hz * self.seconds), 1, self.f_hz.size - 1))
        return amplitude, self.noise[:, k]

    def steady(self, hz: float) -> bool:
        """Whether what is at a frequency has the shape of a line, where it is largest, in phase as in power: a sharp
        resonance under random forces (of the disc, say, if its mass is not quite known) wanders over its width."""
        k = int(np.clip(round(hz * self.seconds), BESIDE, self.f_hz.size - 1 - BESIDE))
        Y = self.Y[:, k - BESIDE : k + BESIDE + 1]
        Y = Y[int(np.argmax(np.abs(Y[:, BESIDE]) ** 2 / self.noise[:, k]))]
        x = hz * self.seconds - np.arange(k - BESIDE, k + BESIDE + 1) + 1e-9
        line = np.exp(1j * np.pi * x) * np.sinc(x) / (1 - x * x)  # of a tone under the window
        together = np.abs(np.vdot(line, Y)) ** 2 / (np.vdot(line, line).real * np.vdot(Y, Y).real)
        return bool(together > STEADY)


def spectrum_of(model: Model, y: Array, rate_hz: float) -> Spectrum:
    """Spectrum of the motion channels, one per place, as accelerations; missing samples count as zero."""
    from scipy.fft import next_fast_len, rfft

    columns = [next(k for k, c in enumerate(model.channels) if c.place == p and c.kind in _POWER) for p in model.places]
    keep = len(y)
    while next_fast_len(keep, real=True) != keep:
        keep -= 1
    windowed = np.nan_to_num(np.ascontiguousarray(y[:keep, columns].T, dtype=np.float32), copy=False)
    windowed *= np.hanning(keep).astype(np.float32)
    f: Array = np.asarray(np.fft.rfftfreq(keep, 1 / rate_hz), dtype=np.float64)
    Y = np.asarray(rfft(windowed, axis=1, workers=2))
    Y *= 2 / (0.5 * (keep - 1))
    noise = np.stack([surroundings(z.real**2 + z.imag**2, NEIGHBOURS) for z in Y])
    return Spectrum(f, Y, noise, keep / rate_hz, windowed, rate_hz, model)


def surroundings(power: Array, reach: int) -> Array:
    """(bins,) mean of the bins up to `reach` away, by the median of every fourth of them: a line is not in it."""
    from scipy.ndimage import median_filter

    local = median_filter(power[::THIN], 2 * reach // THIN + 1, mode="reflect") / np.log(2)
    return np.asarray(np.maximum(np.repeat(local, THIN)[: power.size], 1e-300))


_POWER = {"acceleration": 0, "velocity": 1, "displacement": 2}


def find(model: Model, point: WorkingPoint, y: Array, rate_hz: float) -> list[Suspect]:
    """Every periodic force that the model does not have yet, by cause."""
    s = spectrum_of(model, y, rate_hz)
    known = known_lines(model)
    Z = (s.Y.real**2 + s.Y.imag**2) / s.noise
    usable = (s.f_hz > max(3.0, 20 / s.seconds)) & (s.f_hz < 0.47 * rate_hz)
    width = 3.0 / s.seconds
    for hz in known:
        usable &= np.abs(s.f_hz - hz) > width
    Z[:, ~usable] = 0.0
    threshold = SURE * float(np.log(Z.size / LEVEL))
    lines = _peaks(s, Z, threshold)
    out: list[Suspect] = []
    rotation = (model.speed_rpm or 0.0) / 60.0
    if rotation > 0.0 and not any(use.name == "local_defect" for use in model.effects):
        lines, found = _defects(model, point, s, lines, rotation)
        out += found
    if rotation > 0.0:
        lines += [k * rotation for k in (1, 2) if not any(abs(k * rotation - h) < width for h in [*lines, *known])]
    for hz in filter(s.steady, lines):
        suspect = _one_line(model, point, s, hz, rotation, threshold)
        if suspect is not None:
            out.append(suspect)
    return out


def _peaks(s: Spectrum, Z: Array, threshold: float) -> list[float]:
    """Frequencies of the bins that stand out in any channel, neighbours joined, strongest first, refined."""
    best = Z.max(axis=0)
    order = np.argsort(-best)
    out: list[float] = []
    for k in order[:4000]:
        if best[k] < threshold:
            break
        hz = float(s.f_hz[k])
        if all(abs(hz - h) > 4.0 / s.seconds for h in out):
            out.append(_centre(s, int(k), int(np.argmax(Z[:, k]))))
        if len(out) >= 200:
            break
    return out


def _centre(s: Spectrum, k: int, i: int) -> float:
    """Peak frequency under a Hann window from three bins (ratio of amplitudes)."""
    a, b, c = (float(np.abs(s.Y[i, j])) for j in (k - 1, k, min(k + 1, s.f_hz.size - 1)))
    shift = (2 * c - b) / (b + c) if c >= a else -(2 * a - b) / (a + b)
    return float(s.f_hz[k] + np.clip(shift, -0.7, 0.7) / s.seconds)


def forces(point: WorkingPoint, s: Spectrum, hz: float) -> tuple[Complexes, Array]:
    """(places,) complex force amplitudes in N of a line, and (places,) the variance E|.|^2 of their noise."""
    Y, noise = s.at(hz)
    A = tangent_at(point, np.array([hz]), shaft_response(s.model, point.data.places, np.array([hz])))[0]
    return A @ Y, (np.abs(A) ** 2) @ noise


def _one_line(
    model: Model, point: WorkingPoint, s: Spectrum, hz: float, rotation: float, threshold: float
) -> Suspect | None:
    order = hz / rotation if rotation > 0 else 0.0
    near = [k for k in (1, 2) if rotation > 0 and abs(hz - k * rotation) < 2.0 / s.seconds]
    if near:
        hz = near[0] * rotation  # a tenth of a bin beside it, the phase at t = 0 would be off by a third
    F, noise = forces(point, s, hz)
    Z = np.abs(F) ** 2 / noise
    total, P = float(Z.sum()), len(Z)
    needed = float(np.log(P / KNOWN_LEVEL)) + 6.0 if near else threshold
    if Z.max() < needed and total < needed + 3 * P:
        return None
    power = {i: float(np.abs(F[i]) ** 2 / 2) for i in range(P) if Z[i] > 5}
    p = float(min(1.0, np.exp(-(total - P)) * (4 if near else Z.size * s.f_hz.size)))
    if near == [1] and model.shaft != "none":
        weights = _disc(model, point, rotation)
        f_d = complex(np.sum(np.conj(weights) * F / noise) / np.sum(np.abs(weights) ** 2 / noise))
        explained = float(np.sum(np.abs(weights) ** 2 / noise) * abs(f_d) ** 2)
        if total - explained < 0.2 * total + 3 * P:
            sd = float(np.sqrt(0.5 / np.sum(np.abs(weights) ** 2 / noise)))
            settings = {"a": Parameter(f_d.real, sd, "N"), "b": Parameter(f_d.imag, sd, "N")}
            return Suspect(
                "imbalance", ("disc",), explained, 2, p, power, "shaft_angle",
                f"1 x shaft speed ({hz:.2f} Hz), forward", {"disc": settings},
                "a bow of the shaft gives the same line at one speed: change the speed to tell them", (5 * sd, "N"),
            )  # fmt: skip
    name = "misalignment" if near == [2] else "line"
    chosen = [i for i in range(P) if Z[i] > 9]
    places = [point.data.places[i] for i in (chosen or [int(np.argmax(Z))])]
    settings_by = {}
    for place in places:
        i = point.data.places.index(place)
        sd = float(np.sqrt(noise[i] / 2))
        values = {"a": Parameter(F[i].real, sd, "N"), "b": Parameter(-F[i].imag, sd, "N")}
        if name == "line":
            values["frequency"] = Parameter(hz, 0.3 / s.seconds / float(np.sqrt(Z[i])), "Hz")
        settings_by[place] = values
    what = f"{near[0]} x shaft speed ({hz:.2f} Hz)" if near else f"{hz:.3f} Hz"
    if not near and rotation > 0:
        what += f", {order:.3f} x shaft speed"
    df = len(places) * 2 + (name == "line")
    return Suspect(
        name, tuple(places), total, df, p, power, "shaft_angle" if near else "frequency", what, settings_by,
        detectable=(float(5 * np.sqrt(noise.min() / 2)), "N"),
    )  # fmt: skip


def _disc(model: Model, point: WorkingPoint, rotation: float) -> Complexes:
    """(places,) force at each cap per forward rotating force on the disc."""
    w = np.array([2 * np.pi * rotation])
    return np.array([to_cap(model, p, w)[0] * (1.0 if p.endswith("x") else -1j) for p in point.data.places])


def _defects(
    model: Model, point: WorkingPoint, s: Spectrum, lines: list[float], rotation: float
) -> tuple[list[float], list[Suspect]]:
    """Trains of harmonics of a bearing order: the lines they take, and the suspects."""
    fundamentals = []
    bpfo = kinematic("bpfo", model)
    if bpfo is not None:
        fundamentals.append(float(bpfo))
    if model.bearing is not None:
        fundamentals += [v for k, v in orders(model).items() if k != "FTF"]
    blind = len(lines) >= 4
    if blind:  # the spacing that most of the lines share
        spacing = np.diff(np.sort(lines))
        fundamentals += [float(d / rotation) for d in np.unique(np.round(spacing, 2)) if d > 0.3 * rotation][:20]
    best: Suspect | None = None
    taken: list[float] = []
    for order in dict.fromkeys(round(o, 4) for o in fundamentals):
        hz = order * rotation
        if abs(order - round(order)) < 0.02 and order < 2.5:
            continue
        harmonics = np.arange(1, min(400, int(min(0.45 * s.rate_hz, model.band[1]) / hz)) + 1)
        bins = np.clip(np.round(harmonics * hz * s.seconds).astype(int), 1, s.f_hz.size - 2)
        Z = np.max([np.abs(s.Y[:, bins + d]) ** 2 / s.noise[:, bins] for d in (-1, 0, 1)], axis=0)
        # a Hann line fills three bins; the largest of three is about 1.8 by chance
        gains = np.maximum(Z - 3.0, 0.0).sum(axis=1) - 0.15 * harmonics.size
        i = int(np.argmax(gains))
        visible = int((Z[i] > 8).sum())
        if visible >= 4 and gains[i] > 40 + 5 * np.sqrt(harmonics.size) and (best is None or gains[i] > best.gain):
            places = [point.data.places[j] for j in range(len(gains)) if gains[j] > 40.0 + 5 * np.sqrt(harmonics.size)]
            best = _defect(point, s, order, rotation, places, float(np.sum(gains)))
            taken = [h for h in lines if abs(h / hz - round(h / hz)) < 2.0 / s.seconds / hz * max(1, round(h / hz))]
    if best is None:
        return lines, []
    return [h for h in lines if h not in taken], [best]


def _defect(
    point: WorkingPoint, s: Spectrum, order: float, rotation: float, places: list[str], gained: float
) -> Suspect:
    """Strike, angle and width from the folded inferred force: the mean over all periods."""
    settings, power = {}, {}
    hz = order * rotation
    for place in places:
        i = point.data.places.index(place)
        turn = (hz * point.data.t) % 1.0
        bins = 256
        index = np.minimum((turn * bins).astype(int), bins - 1)
        folded = np.bincount(index, point.force[i], bins) / np.maximum(np.bincount(index, minlength=bins), 1)
        folded -= np.median(folded)
        sd = float(point.force[i].std() / np.sqrt(point.force.shape[1] / bins))
        peak = int(np.argmax(np.abs(folded)))
        tail = np.roll(folded, -peak)[: bins // 4] / folded[peak]
        width = 2 * np.pi / bins * float(np.clip(np.sum(np.clip(tail, 0, None)), 1.0, 40.0))
        settings[place] = {
            "strike": Parameter(float(folded[peak]), sd, "N"),
            "order": Parameter(order, order / s.seconds / hz / 10, "1"),
            "angle": Parameter(2 * np.pi * peak / bins, 2 * np.pi / bins, "rad"),
            "width": Parameter(width, 2 * np.pi / bins, "rad"),
        }
        power[i] = max(float(np.mean(folded**2)) - sd**2, 0.0)
    effect = CATALOGUE["local_defect"]
    return Suspect(
        "local_defect", tuple(places), gained, 4 * len(places), float(np.exp(-min(gained, 700.0) / 2)), power,
        "shaft_angle", f"impacts at {order:.3f} x shaft speed ({hz:.2f} Hz)", settings, effect.signature,
    )  # fmt: skip
