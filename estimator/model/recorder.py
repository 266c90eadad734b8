"""What a recorder takes of every channel alike towards the end of the band: anti-alias filters, means over samples.

All channels fall, the more the higher the frequency, and none rises on the way as behind a resonance. Of the inferred
force that is a colour that no rotor has, and nothing is said to be missing: it is undone in the record
(channel_response.py), as laws depend on the motion that there was.

A filter that falls slowly (means over a sample, sigma-delta, Bessel) also lets through what is above half the rate, and
sampling folds it into the band: above all resonances the acceleration is that of a free mass, F / m, and as the unknown
force is white its level is known. Towards the end of the band that fills up again what the filter took; below a
resonance, where the inferred force is the acceleration times its k / w^2, it is many times more than the force. It is
noise of every sensor: sensor_noise.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.results import Message, Parameter

POWERS = np.array([2, 4, 8, 16, 32])  # of frequency, of a fall of any form: a mean of samples falls by the first
FROM = 2.0  # times the highest resonance, from where laws and damping shape the inferred force no more
SURE, STEEP = 4.0, 0.004  # standard deviations, and nepers of power to the top, of a fall worth a look
SAID = 0.1  # dB at the end of the band
LATE = 3  # power of frequency of a phase: the first that is no delay
LEAST_MEANS = 0.05  # that are spoken of
HEARD = -40.0  # dB over that of a free mass, of what is folded back at the end of the band
BEYOND = 1e6  # times the rate, where no filter lets anything through
IMAGES = 16  # multiples of the rate about which something is folded back
POWER_OF_W = {"acceleration": 0, "velocity": -1, "displacement": -2}  # from acceleration to what is measured


@dataclass(frozen=True, slots=True)
class Filter:
    """Means over a sample, one after the other; poles before the samples (filter_designs.py); or a fall of any form
    where nothing is folded back, as behind a filter that is steep at half the rate.

    nepers : (5,) of power at the end of the band, each by its power of frequency. name : of the design of the poles.
    echo : what is folded back, over what is by the design: recorders have more stages than one. late : rad at the end
    of the band, growing by LATE powers of frequency, that the phase is behind that of the poles: recorder_phase.py.
    flat : of what is folded back, what is white as acceleration: that about the rate, which means shut out, and others
    do not (a Bessel filter of order 6 at 0.45 of the rate lets 0.013 of it through). kept : of the samples that the
    poles worked on, as in a recorder that oversamples, by the bilinear transform, after which nothing is above half of
    their rate; 0 of poles before any sample. doubt : relative standard deviation of S by what filters fit as well.
    """

    rate_hz: float
    top_hz: float
    means: float = 0.0
    poles: tuple[float, ...] = ()
    cutoff_hz: float = 1.0
    name: str = ""
    nepers: tuple[float, ...] = ()
    echo: float = 1.0
    late: float = 0.0
    flat: float = 0.0
    kept: float = 0.0
    doubt: float = 0.0

    def passed(self, f_hz: Array) -> Array:
        """(..., f) of power, 1 at zero."""
        out = gain(self.nepers, f_hz, self.top_hz)
        if self.means:
            out = out * np.abs(np.sinc(f_hz / self.rate_hz)) ** (2.0 * self.means)
        if self.poles:
            out = out / np.polyval([*self.poles[::-1], 1.0], (self._warped(f_hz) / self.cutoff_hz) ** 2)
        return np.asarray(out)

    def _warped(self, f_hz: Array) -> Array:
        """Hz at which poles before the samples take what these take at f_hz; far off where there is nothing."""
        if not self.kept:
            return f_hz
        x = np.pi * self.kept / self.rate_hz * f_hz
        return np.where(x < np.pi / 2, np.tan(x) * (self.rate_hz / np.pi / self.kept), BEYOND * self.rate_hz)

    def response(self, f_hz: Array) -> NDArray[np.complex128]:
        """(f,) measured over true, its delay left out."""
        return np.asarray(np.sqrt(self.passed(f_hz)) * np.exp(-1j * self.lag(f_hz)))

    def lag(self, f_hz: Array) -> Array:
        """(f,) rad that the phase is behind that of its delay: the poles' is of minimum phase, means have none."""
        s = np.zeros(0, complex)
        if self.poles:
            s = np.sqrt(-np.roots([*self.poles[::-1], 1.0]).astype(complex))  # of H(s) H(-s)
            s = np.where(s.real > 0.0, -s, s)
        x = f_hz[..., None] / self.cutoff_hz
        y = self._warped(f_hz)[..., None] / self.cutoff_hz
        own = np.sum(np.angle(1.0 - 1j * y / s) - x * np.imag(-1j / s), axis=-1)
        return np.asarray(own + self.late * (f_hz / self.top_hz) ** LATE)

    def folded(self, f_hz: Array, kind: str) -> Array:
        """(f,) PSD, as acceleration of a sensor of this kind, of what is folded back, over that of a free mass."""
        return np.asarray(self.echoes(f_hz, kind).sum(axis=0))

    def echoes(self, f_hz: Array, kind: str) -> Array:
        """(images, f) the same from each of its images."""
        if self.nepers:
            return np.zeros((0, f_hz.size))
        through = self.echo * self.passed(images(self.rate_hz, f_hz))
        through[[0, IMAGES]] += self.flat / 2  # those about the rate
        if power := POWER_OF_W[kind]:
            through *= (images(self.rate_hz, f_hz) / f_hz) ** (2.0 * power)
        return np.asarray(through)

    def message(self) -> Message | None:
        """What to tell the user of it; None for one that is too weak."""
        end = np.array([self.top_hz])
        change = float(np.abs(10 * np.log10(self.passed(np.linspace(0.0, self.top_hz, 200)))).max())
        if 10 * np.log10(self.folded(end, "acceleration")[0] + 1e-30) > HEARD or self.poles:
            means = f"{self.means:.1f} means over a sample" if self.means > LEAST_MEANS else ""
            turn = np.pi * self.kept / self.rate_hz
            cutoff_hz = np.arctan(turn * self.cutoff_hz) / turn if self.kept else self.cutoff_hz
            poles = f"a {self.name} at {cutoff_hz:.0f} Hz" if self.poles else ""
            behind = " and ".join(filter(None, (poles, means)))
            text = (
                f"the recorder's filter changes all channels by up to {change:.1f} dB below {self.top_hz:g} Hz, and "
                f"what is above half of the sampling rate is aliased into the band, as behind {behind}: the fit "
                "accounts for both, and neither is a property of the rotor"
            )
            return Message("recorder_folds", text)
        if change < SAID and not self.late:
            return None
        if change < SAID:
            us = 1e6 * LATE * self.late / (2 * np.pi * self.top_hz)
            text = (
                f"all channels delay {self.top_hz:g} Hz by {us:.0f} us more than the low end of the band: this is "
                "taken as the phase of the recorder's filter and removed"
            )
            return Message("recorder_delays", text)
        text = (
            f"all channels roll off alike towards the end of the band, by {change:.1f} dB at {self.top_hz:g} Hz: this "
            "is taken as the recorder's filter and not as the rotor (excitation with a corner above the band would "
            "look the same)"
        )
        return Message("recorder_rolls_off", text)


RollOff = Mapping[str, Filter]  # by place: one for all, or of some


def doubted(doubt: Mapping[str, float], found: Mapping[str, Parameter]) -> dict[str, Parameter]:
    """Numbers by full name with the standard deviations that the choice of a filter adds: of S, and of the gain of a
    colour, whose force S (1 + gain) low in the band is what it is behind any filter. doubt : of S by place, relative.
    """
    out = dict(found)
    for place, own in doubt.items():
        for name, more in ((f"{place}.S", 0.0), (f"{place}.coloured_excitation.gain", 1.0)):
            p = out.get(name)
            if p is not None and p.value is not None and p.sd is not None:
                out[name] = replace(p, sd=float(np.hypot(p.sd, own * (p.value + more))))
    return out


def images(rate_hz: float, f_hz: Array) -> Array:
    """(images, f) Hz of what sampling folds to f (f,)."""
    return _images(rate_hz, np.ascontiguousarray(f_hz, np.float64).tobytes())


@lru_cache(maxsize=8)  # searches ask for those of the same cells some thousand times
def _images(rate_hz: float, f_hz: bytes) -> Array:
    f, rates = np.frombuffer(f_hz), rate_hz * np.arange(1.0, IMAGES + 1)[:, None]
    out = np.concatenate([rates - f, rates + f])
    out.flags.writeable = False
    return out


def gain(nepers: tuple[float, ...], f_hz: Array, top_hz: float) -> Array:
    """(f,) of power, 1 at zero. nepers : (5,) of power at the end of the band, each by its power of frequency."""
    if not nepers:
        return np.ones_like(f_hz)
    return np.asarray(np.exp(-((f_hz[:, None] / top_hz) ** POWERS) @ np.array(nepers)))


def recorder_messages(off: RollOff | None, places: tuple[str, ...]) -> tuple[Message, ...]:
    """What to tell the user of it."""
    if not off:
        return ()
    if len(off) == len(places) and len(set(off.values())) == 1:
        return tuple(filter(None, [off[places[0]].message()]))
    nodes = {place.split(".")[0]: own for place, own in off.items()}
    return tuple(
        replace(m, text=f"{node}: {m.text}", place=node) for node, own in nodes.items() if (m := own.message())
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
