"""Periodic forces of a model: what they add to the force balance of the caps.

Imbalance, bow, misalignment, a line and a local defect are forces of time alone: they move no tangent and no
determinant, and the motion that they cause stays in the displacement that the laws see. A force is written by its
harmonics, sum_k Re F_k exp(i k theta), with theta the shaft angle, the defect's angle or 2 pi f t; on the disc it
reaches a cap through the shaft.

Numbers are those at the mean speed of the record.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes, Series
from estimator.effects import NAMED
from estimator.effects.engine.law_loop import force_array
from estimator.effects.places import at, kinematic, values, written
from estimator.errors import ModelError
from estimator.likelihood.thresholds import LIMITS
from estimator.model.effect import Effect
from estimator.model.rig import Model, Setting
from estimator.model.rotor import rotor_of
from estimator.signals.band_limit import passband

PERIODIC_EFFECTS = tuple(name for name, effect in NAMED.items() if effect.found_by == "harmonics")
NOT_IDENTIFIABLE_TEXT = "not distinguishable from zero in this record"


@dataclass(frozen=True, slots=True, kw_only=True)
class PeriodicEffect:
    """One periodic effect at a place.

    effect : the effect. key : canonical place of its parameters. p : (k,) parameters, SI. free : (k,) whether each is
    fitted. hz : its fundamental frequency, Hz.
    """

    effect: Effect
    key: str
    p: Array
    free: tuple[bool, ...]
    hz: float

    def angle(self, t: Array, phase: Array) -> Array:
        """(n,) theta, rad."""
        if self.effect.state == "time":
            return np.asarray(2 * np.pi * self.hz * t)
        k = frequency_index(self.effect)
        return phase if k is None else phase * self.p[k]

    def harmonics(self, model: Model, place: str, count: int, p: Array | None = None) -> Complexes:
        """(count,) N, harmonics F_1, F_2, ... of the force on a cap."""
        if self.effect.kind not in ("disc", "shaft"):
            return self._of_law(place[-1], count, p)
        on_caps = 0.5 if self.effect.kind == "shaft" else 0.0  # half of what a shaft's force puts on the disc
        through = cap_force_per_shaft_force(model, self.key, place, 2 * np.pi * self.hz * np.arange(1.0, count + 1))
        through[:, "xy".index(place[-1])] -= on_caps
        return np.asarray(sum(z * self._of_law(d, count, p) for d, z in zip("xy", through.T, strict=True) if z.any()))

    def _of_law(self, direction: str, count: int, p: Array | None) -> Complexes:
        """(count,) N, harmonics of the force of the law in a direction where it acts."""
        p = self.p if p is None else p
        theta = 2 * np.pi * (np.arange(LIMITS.points_per_turn) + 0.5) / LIMITS.points_per_turn
        f = frequency_index(self.effect)
        own = p.copy()
        if f is not None:
            own[f] = 1.0  # the law over one turn does not depend on it
        t = theta / (2 * np.pi)
        law = force_array(
            self.effect, own, np.zeros(LIMITS.points_per_turn), t=t, phase=theta, s=1.0 if direction == "x" else -1.0
        )
        k = np.arange(1.0, count + 1)
        return np.asarray(
            -2.0
            / LIMITS.points_per_turn
            * np.fft.rfft(law)[1 : count + 1]
            * np.exp(-0.5j * k * 2 * np.pi / LIMITS.points_per_turn)
        )

    def highest(self, band: tuple[float, float]) -> int:
        """Highest order of its angle below the upper edge of a band, Hz."""
        return int(min(band[1] / self.hz, LIMITS.points_per_turn // 8))

    def within(self, band: tuple[float, float]) -> NDArray[np.int64]:
        """The orders that its law has in a band, Hz."""
        k = np.arange(1, self.highest(band) + 1)
        return k[(self.hz * k >= band[0]) & present_harmonics(self.effect, k.size)]


def present_harmonics(effect: Effect, count: int) -> NDArray[np.bool_]:
    """(count,) which harmonics of its angle, from the first, a periodic effect has."""
    if effect.harmonics == "all":
        return np.ones(count, bool)
    return np.isin(np.arange(1, count + 1), effect.harmonics or ())


def frequency_index(effect: Effect) -> int | None:
    """Number of the parameter that turns the angle of a periodic effect; None where that is the shaft's angle."""
    numbers = (k for k, q in enumerate(effect.parameters) if not q.linear and q.scale in ("bpfo", "hz_peak"))
    return next(numbers, None)


def fundamental_hz(effect: Effect, settings: Mapping[str, Setting], model: Model) -> float:
    """Hz at which the angle of a periodic effect with these settings turns; 0 where that is not known."""
    rotation, k = (model.speed_rpm or 0.0) / 60.0, frequency_index(effect)
    if k is None:
        return rotation
    q = effect.parameters[k]
    value = settings.get(q.name, Setting()).value or kinematic(q.scale, model) or 0.0
    return value if effect.state == "time" else rotation * value


def _fundamentals(model: Model) -> list[tuple[Effect, float]]:
    """The model's periodic effects at each place, and Hz at which their angle turns; 0 where that is not known."""
    return [
        (effect, fundamental_hz(effect, written(effect, use, model, key), model))
        for use in model.effects if use.name in PERIODIC_EFFECTS
        for effect in (NAMED[use.name],) for key in at(effect, use, model)
    ]  # fmt: skip


def known_lines(model: Model) -> list[float]:
    """Hz of the lines that the model's own effects make, whether their strength is known or not."""
    out: dict[float, None] = {}
    for effect, hz in _fundamentals(model):
        orders = 1 + np.flatnonzero(present_harmonics(effect, LIMITS.max_harmonics))
        out |= dict.fromkeys((hz * orders).tolist() if hz > 0.0 else ())
    return list(out)


def has_unknown_line(model: Model) -> bool:
    """Whether a periodic effect of the model has a frequency that is not known."""
    return any(hz == 0.0 for _, hz in _fundamentals(model))


def cap_force_per_shaft_force(model: Model, disc: str, place: str, omega: Array) -> Complexes:
    """(f, 2) force on a cap per force on a disc in x and in y.

    By reciprocity the disc's displacement per cap displacement, of the rotor that turns the other way.
    """
    rotor = rotor_of(model)
    out = np.zeros((omega.size, 2), complex)
    if rotor is None:
        return out
    other_way = replace(rotor, C=rotor.C.T)
    for k, d in enumerate("xy"):
        if f"{disc}.{d}" in rotor.discs:
            out[:, k] = other_way.follows(f"{disc}.{d}", omega)[:, model.places.index(place)]
    return out


def periodic_effects(model: Model) -> list[PeriodicEffect]:
    """The model's periodic effects whose numbers are all known, by place."""
    out = []
    for use in model.effects:
        if use.name not in PERIODIC_EFFECTS:
            continue
        effect = NAMED[use.name]
        for key in at(effect, use, model):
            try:
                p = values(effect, use, model, key)
            except ModelError:
                continue
            settings = written(effect, use, model, key)
            hz = fundamental_hz(effect, settings, model)
            if hz > 0.0:
                free = tuple(not settings.get(q.name, Setting()).fixed for q in effect.parameters)
                out.append(PeriodicEffect(effect=effect, key=key, p=p, free=free, hz=hz))
    return out


@dataclass(frozen=True, slots=True, kw_only=True)
class PeriodicForce:
    """Force of a periodic effect per unit of one amplitude, at the places where the effect acts.

    name : of the amplitude, "bearing1.x.line.a"; empty for the whole force. unit : of the amplitude. one : the effect.
    tables : by place index, (points_per_turn + 1,) N per unit over a turn of the angle, in the band.
    """

    name: str
    unit: str
    one: PeriodicEffect
    tables: dict[int, Array]

    def series(self, t: Array, phase: Array) -> dict[int, Array]:
        """(n,) N per unit by place index, at t in s and phase in rad."""
        return {i: self.at(i, t, phase) for i in self.tables}

    def at(self, i: int, t: Array, phase: Array) -> Array:
        """(n,) N per unit at place i, where the effect acts, at t in s and phase in rad."""
        return np.asarray(_along(self.one.angle(t, phase), self.tables[i]), dtype=np.float64)


@njit(cache=True, error_model="numpy", nogil=True)
def _along(theta, table):  # type: ignore[no-untyped-def]
    """(n,) a table over one turn at any angles, straight between its points."""
    out = np.empty(theta.size)
    for i in range(theta.size):
        turn = theta[i] / (2 * np.pi)
        at = (turn - np.floor(turn)) * (table.size - 1)
        k = min(int(at), table.size - 2)
        out[i] = table[k] + (at - k) * (table[k + 1] - table[k])
    return out


def periodic_amplitudes(model: Model, places: tuple[str, ...], rate_hz: float) -> tuple[PeriodicForce, ...]:
    """The free amplitudes of the model's periodic effects with a harmonic in the band."""
    out = []
    for one in periodic_effects(model):
        if one.within(model.band).size == 0:
            continue
        parameters = one.effect.parameters
        for k, q in enumerate(parameters):
            if q.linear and one.free[k]:
                p = np.where([other.linear for other in parameters], 0.0, one.p)
                p[k] = 1.0
                tables = _tables(model, replace(one, p=p), places, rate_hz)
                name = f"{one.key}.{one.effect.name}.{q.name}"
                out.append(PeriodicForce(name=name, unit=q.unit, one=one, tables=tables))
    return tuple(out)


def periodic_series(model: Model, places: tuple[str, ...], t: Array, phase: Array, rate_hz: float) -> Series | None:
    """(places, n) N that the periodic effects put on the caps, as far as the band lets it through; None without any.

    t, phase : (n,) s and rad.
    """
    out: Series | None = None
    for one in periodic_forces(model, places, rate_hz):
        for i, z in one.series(t, phase).items():
            out = np.zeros((len(places), t.size), np.float32) if out is None else out
            out[i] += z
    return out


def periodic_forces(model: Model, places: tuple[str, ...], rate_hz: float) -> tuple[PeriodicForce, ...]:
    """Forces of the model's periodic effects in the band, all amplitudes of an effect together."""
    made = [(one, _tables(model, one, places, rate_hz)) for one in periodic_effects(model)]
    return tuple(PeriodicForce(name="", unit="N", one=one, tables=tables) for one, tables in made if tables)


def _turned(harmonics: Complexes) -> Array:
    """(points_per_turn + 1,) of harmonics (orders,), from the first, over a turn of the angle."""
    spectrum = np.zeros(LIMITS.points_per_turn // 2 + 1, complex)
    spectrum[1 : harmonics.size + 1] = 0.5 * LIMITS.points_per_turn * harmonics
    wave = np.fft.irfft(spectrum, LIMITS.points_per_turn)
    return np.append(wave, wave[0])


def _tables(model: Model, one: PeriodicEffect, places: tuple[str, ...], rate_hz: float) -> dict[int, Array]:
    """(points_per_turn + 1,) N in the band over a turn, by index of the places where the effect acts."""
    count = int(min(0.5 * rate_hz / one.hz, LIMITS.points_per_turn // 8))
    gain = passband(np.asarray(one.hz * np.arange(1.0, count + 1)), rate_hz, model.band)
    tables: dict[int, Array] = {}
    if not ((gain > LIMITS.min_band_gain) & present_harmonics(one.effect, count)).any():
        return tables
    for i, place in enumerate(places):
        if acts_on(one, place):
            tables[i] = _turned(gain * one.harmonics(model, place, count))
    return tables


def acts_on(one: PeriodicEffect, place: str) -> bool:
    """Whether a periodic effect puts a force on the bearing cap at a place."""
    return one.effect.kind in ("disc", "shaft") or one.key in (place, place.split(".")[0])
