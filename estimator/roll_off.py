"""What a recorder takes of every channel alike towards the end of the band: anti-alias filters, means over samples.

All channels fall, the more the higher the frequency, and none rises on the way as behind a resonance. Of the inferred
force that is a colour that no rotor has: it goes into the shape of its spectrum (motion_blocks.colours), and nothing is
said to be missing.

A filter that falls slowly (means over a sample, sigma-delta, Bessel) also lets through what is above half the rate, and
sampling folds it into the band: above all resonances the acceleration is that of a free mass, F / m, and as the unknown
force is white its level is known. Towards the end of the band that fills up again what the filter took; below a
resonance, where the inferred force is the acceleration times its k / w^2, it is many times more than the force.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
POWERS = np.array([2, 4, 8, 16, 32])  # of frequency: a mean of samples falls by the first
FROM = 2.0  # times the highest resonance, from where laws and damping shape the inferred force no more
SURE, STEEP = 4.0, 0.004  # standard deviations, and nepers of power to the top, of a fall worth a look
SAID = 0.1  # dB at the end of the band
IMAGES = 16  # multiples of the rate about which something is folded back
POWER_OF_W = {"acceleration": 0, "velocity": -1, "displacement": -2}  # from acceleration to what is measured


@dataclass(frozen=True, slots=True)
class RollOff:
    """nepers : (5,) of power at the end of the band, each by its power of frequency. means : how many means over a
    sample, one after the other, fall as the recorder does; what they fold back comes with them. rate_hz : of the
    samples. free : place -> (kL / m, c / m) of its resonance, for what is folded. apart : place -> its own, where the
    bearings have devices of different ones."""

    nepers: tuple[float, ...] = ()
    means: float = 0.0
    rate_hz: float = 0.0
    free: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    apart: Mapping[str, RollOff] = field(default_factory=dict)

    def at(self, place: str) -> RollOff:
        """That of a place."""
        return self.apart.get(place, RollOff()) if self.apart else self

    def passed(self, f_hz: Array, top_hz: float) -> Array:
        """(f,) of power, 1 at zero."""
        mean = averaged(f_hz, self.means, self.rate_hz) if self.means else 1.0
        return np.asarray(gain(self.nepers, f_hz, top_hz) * mean)

    def folded(self, f_hz: Array, kind: str) -> Array:
        """(f,) PSD, as acceleration of a sensor of this kind, of what is folded back, over that of a free mass."""
        return folded(f_hz, self.means, self.rate_hz, kind) if self.means else np.zeros_like(f_hz)

    def colour(self, place: str, f_hz: Array, top_hz: float, kind: str) -> Array:
        """(f,) of the inferred force at a place, 1 at zero without a fold."""
        if self.apart:
            return self.at(place).colour(place, f_hz, top_hz, kind)
        out = self.passed(f_hz, top_hz)
        if self.means and place in self.free:
            stiff, loss = self.free[place]
            w = 2 * np.pi * f_hz
            out = out + self.folded(f_hz, kind) * ((1.0 - stiff / w**2) ** 2 + (loss / w) ** 2)
        return out


def averaged(f_hz: Array, means: float, rate_hz: float) -> Array:
    """(f,) of power that means over a sample let through."""
    return np.asarray(np.abs(np.sinc(f_hz / rate_hz)) ** (2.0 * means))


def folded(f_hz: Array, means: float, rate_hz: float, kind: str) -> Array:
    """(f,) what sampling folds back behind these means, as RollOff.folded."""
    out = np.zeros_like(f_hz)
    for k in range(1, IMAGES + 1):
        for image in (k * rate_hz - f_hz, k * rate_hz + f_hz):
            out += averaged(image, means, rate_hz) * (image / f_hz) ** (2.0 * POWER_OF_W[kind])
    return out


def gain(roll_off: tuple[float, ...], f_hz: Array, top_hz: float) -> Array:
    """(f,) of power, 1 at zero. roll_off : (5,) nepers of power at the end of the band, each by its power of f."""
    if not roll_off:
        return np.ones_like(f_hz)
    return np.asarray(np.exp(-((f_hz[:, None] / top_hz) ** POWERS) @ np.array(roll_off)))


def said(off: RollOff | None, top_hz: float) -> tuple[str, ...]:
    """What to tell the user of it."""
    if off is None:
        return ()
    if off.apart:
        nodes = {place.split(".")[0]: own for place, own in off.apart.items()}
        return tuple(f"{node}: {text}" for node, own in nodes.items() for text in said(own, top_hz))
    fall = float(-10 * np.log10(off.passed(np.array([top_hz]), top_hz)[0]))
    if off.means:
        return (
            f"the recorder's filter takes {fall:.1f} dB at {top_hz:g} Hz of all channels alike, and what is above "
            f"half of the rate is folded into the band, as behind {off.means:.1f} means over a sample: that is counted "
            "in, and is not the rotor's",
        )
    if fall < SAID:
        return ()
    return (
        f"all channels fall alike towards the end of the band, by {fall:.1f} dB at {top_hz:g} Hz: taken for the "
        "recorder's filter, not for the rotor's (a colour of the forces with its corner above the band looks the same)",
    )


def devices(places: tuple[str, ...]) -> list[list[int]]:
    """Numbers of the places that a recorder of their own may have: those of each bearing, where there are two bearings
    of two channels each, as one channel that falls is its sensor's."""
    nodes = dict.fromkeys(place.split(".")[0] for place in places)
    own = [[i for i, place in enumerate(places) if place.split(".")[0] == node] for node in nodes]
    return own if len(own) > 1 and min(map(len, own)) > 1 else []


def suspected(power: Array, f_hz: Array, count: Array, resonance_hz: float) -> bool:
    """Whether all places seem to fall: a cheap look before common_fall.find. power : (cells, places) of the inferred
    force over the model's; f_hz, count : (cells,) mean frequency, and number of independent values."""
    above = f_hz > FROM * resonance_hz
    if above.sum() < 3:
        return False
    x, n = (f_hz[above] / f_hz[-1]) ** 8, count[above]
    x -= np.average(x, weights=n)
    slope, sd = (n * x) @ np.log(power[above]) / (n @ x**2), 1 / np.sqrt(n @ x**2)
    return bool(np.all(slope < -np.maximum(SURE * sd, STEEP)))
