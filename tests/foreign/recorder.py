"""Sensors, cables and a recorder of another make, and the rig file that a user writes for them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from .machine import Machine, Moved
from .scene import Scene

Array = NDArray[np.float64]
UNITS = {"m/s^2": 1.0, "g": 9.80665, "mm/s": 1e-3}
GIVEN_FILTERS = ("butterworth", "bessel", "fir")  # of the others a rig file cannot give the ripple
PITCH_MM, GROOVE = 40.0, 0.52  # of the bearing; groove radius of the ball diameter


def recorded(machine: Machine, moved: Moved) -> dict[str, Array]:
    """Name of a channel -> samples in its unit, swapped or inverted where that is the mistake."""
    s = machine.scene
    rng = s.rng(10)
    n = len(moved.caps) // s.keep
    t = np.arange(n) / s.rate_hz
    hum = np.zeros(n)
    for hz, loud in s.around.hum:
        hum += loud * np.sqrt(2) * np.sin(2 * np.pi * (hz * t + rng.uniform()))
    angle = moved.rotation(t)
    out = {}
    for k, name in enumerate(s.channels):
        y = moved.caps[:, k].astype(np.float64) / UNITS[s.unit]
        y = _mounted(y, s)
        y = _filtered(y, s)[:: s.keep][:n]
        rms = float(np.std(y))
        y += _sway(machine, angle, name[-1]) / UNITS[s.unit]
        noise = s.around.white * rng.standard_normal(n) + s.around.pink * _pink(n, rng)
        y += rms * (hum * rng.uniform(0.5, 1.5) + noise)
        if "sensor_clipping" in s.hidden and k == 0:
            level = rng.uniform(1.8, 2.6) * np.std(y)
            y = np.clip(y, -level, level)
        if s.around.ac_hz:
            y = signal.sosfilt(signal.butter(1, s.around.ac_hz, "high", fs=s.rate_hz, output="sos"), y)
        count = 1.5 * np.abs(y).max() / 2 ** (s.around.bits - 1)
        out[name] = np.round(y / count) * count
    if s.tacho:
        passed = np.remainder(angle, 2 * np.pi)
        out["tacho"] = np.where(passed < 0.15 * 2 * np.pi, 5.0, 0.0) + 0.02 * rng.standard_normal(n)
    if s.mistake == "swapped":
        out["b1y"], out["b2x"] = out["b2x"], out["b1y"]
    if s.mistake == "inverted":
        out["b2x"] = -out["b2x"]
    return out


def _sway(machine: Machine, angle: Array, direction: str) -> Array:
    """Velocity or acceleration, SI, of the machine as a whole; the speed wanders too little to change the amplitude."""
    late, y = (np.pi / 2 if direction == "y" else 0.0), np.zeros(len(angle))
    for order, velocity in machine.sway.items():
        of_sensor = 1.0 if machine.scene.sensor == "velocity" else order * machine.turn
        y += np.sqrt(2) * velocity * of_sensor * np.cos(order * angle - late)
    return y


def _mounted(y: Array, s: Scene) -> Array:
    """Behind the resonance of the sensor's mounting, exact at its frequency; one above the inner band is not felt."""
    hz, quality = s.around.mount
    rate = s.rate_hz * s.keep
    if not 0 < hz < 0.4 * rate:
        return y
    warped = 2 * rate * np.tan(np.pi * hz / rate)
    return np.asarray(signal.lfilter(*signal.bilinear([warped**2], [1.0, warped / quality, warped**2], rate), y))


def _filtered(y: Array, s: Scene) -> Array:
    """Behind the recorder's filter, at the inner rate."""
    kind, order, hz = s.around.filter
    if kind == "none":
        return y
    if kind == "mean":
        return np.asarray(signal.lfilter(np.full(s.keep, 1.0 / s.keep), [1.0], y))
    cut = hz / (s.rate_hz * s.keep / 2)
    if kind == "fir":
        taps = signal.firwin(60 * s.keep + 1, cut, window=("kaiser", 9.0))
        return np.asarray(signal.oaconvolve(y, taps, mode="same"))
    sos = {
        "butterworth": lambda: signal.butter(order, cut, output="sos"),
        "bessel": lambda: signal.bessel(order, cut, norm="mag", output="sos"),
        "chebyshev1": lambda: signal.cheby1(order, 0.1, cut, output="sos"),
        "chebyshev2": lambda: signal.cheby2(order, 60.0, 1.15 * cut, output="sos"),
    }[kind]()
    return np.asarray(signal.sosfilt(sos, y))


def _pink(n: int, rng: np.random.Generator) -> Array:
    """(n,) noise of rms 1 whose power falls as 1 / f."""
    spectrum = np.fft.rfft(rng.standard_normal(n)) / np.sqrt(np.maximum(np.arange(n // 2 + 1), 1))
    y = np.fft.irfft(spectrum, n)
    return np.asarray(y / np.std(y))


def given_rate(s: Scene) -> float:
    """Hz that the user believes."""
    return s.rate_hz * (s.factor if s.mistake == "rate" else 1.0)


def rig_file(s: Scene, filters: bool) -> str:
    """What the user knows, and believes. filters : whether a rig file can give the recorder's filter."""
    off = {name: s.factor if s.mistake == name else 1.0 for name in ("cap_mass", "disc_mass", "shaft_spring", "speed")}
    lines = ["schema = 1", "[rig]", f'name = "{s.kind}_{s.seed}"', f'shaft = "{s.shaft}"']
    if s.speed_known and not s.tacho:
        lines.append(f"speed_rpm = {s.rpm * off['speed']:.1f}")
    if s.masses_known:
        masses = {"disc": s.disc * off["disc_mass"]} if s.shaft != "none" else {}
        masses |= {b: m * (off["cap_mass"] if b == "bearing1" else 1.0) for b, m in s.m.items()}
        lines += ["[rig.mass]", *(f"{name} = {m!r}" for name, m in masses.items())]
    elif s.shaft != "none":
        lines += ["[rig.mass]", f"disc = {s.disc!r}"]
    if s.shaft != "none":
        lines += ["[rig.shaft_spring]", f"stiffness = {s.ks * off['shaft_spring']!r}", f"damping = {s.cs!r}"]
    ball = s.ratio * PITCH_MM
    lines += [
        "[rig.bearing]", f"balls = {s.balls}", f"ball_diameter_mm = {ball:.6f}", f"pitch_diameter_mm = {PITCH_MM}",
        f"groove_radius_mm = {GROOVE * ball:.6f}", "[band]", f"low = {s.band[0]:.4g}", f"high = {s.band[1]:.4g}",
        "[acquisition]", f"rate_hz = {given_rate(s)!r}",
    ]  # fmt: skip
    kind, order, hz = s.around.filter
    if filters and s.around.filter_given and kind in GIVEN_FILTERS:
        lines.append(f'anti_alias = {{ kind = "{kind}", order = {order}, cutoff_hz = {hz!r} }}')
    lines += ["[model]", f"effects = {['cubic'] if s.cubic else []}"]
    for c in s.channels:
        lines += ["[[channel]]", f'name = "{c}"', f'node = "bearing{c[1]}"', f'direction = "{c[2]}"',
                  f'kind = "{s.sensor}"', f'unit = "{s.unit}"']  # fmt: skip
    if s.tacho:
        lines += ["[[channel]]", 'name = "tacho"', 'kind = "tacho"', 'unit = "V"']
    return "\n".join(lines) + "\n"
