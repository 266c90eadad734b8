"""Periodic forces of a model: what they add to the force balance of the caps, and their numbers from what is left.

Imbalance, bow, misalignment, a line and a local defect are forces of time alone: they move no tangent and no
determinant, and the motion that they cause stays in the displacement that the laws see. A force is written by its
harmonics, sum_k Re F_k exp(i k theta), with theta the shaft angle, the defect's angle or 2 pi f t; on the disc it
reaches a cap through the shaft. Near the right numbers the inferred force, demodulated in pieces of time, is linear in
what they are wrong by (a wrong frequency turns the phase from piece to piece): one weighted least-squares step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .bandlimit import passband
from .effect import Effect
from .effects import CATALOGUE
from .effects.compiled import force_array
from .effects.places import at, kinematic, values, written
from .errors import ModelError
from .estimate import Parameter
from .model import Model, Setting
from .rotor import shaft_at_caps

if TYPE_CHECKING:
    from .motion_blocks import MotionBlocks

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]
PERIODIC = ("imbalance", "bow", "misalignment", "local_defect", "line")
TURN = 1 << 14  # points of one period
UNTOLD = "not told from zero by this record"
LEAST = 1e-4  # gain of the band filter, below which nothing comes through
LINES = 399  # harmonics that are looked at
PIECES = 16  # of the record, to see a phase that turns
FREQUENCY = {"line": 2, "local_defect": 1}  # number of the parameter that the angle is proportional to


@dataclass(frozen=True, slots=True)
class Periodic:
    """One periodic effect with parameters p at a canonical place. hz : its fundamental."""

    effect: Effect
    key: str
    p: Array
    free: tuple[bool, ...]
    hz: float

    def angle(self, t: Array, phase: Array) -> Array:
        """(n,) theta, rad."""
        if self.effect.name == "line":
            return np.asarray(2 * np.pi * self.hz * t)
        return phase * self.p[1] if self.effect.name == "local_defect" else phase

    def harmonics(self, model: Model, place: str, count: int, p: Array | None = None) -> Complexes:
        """(count,) F_1, F_2, ... in N of the force on a cap; the mean is of no interest."""
        p = self.p if p is None else p
        theta = 2 * np.pi * (np.arange(TURN) + 0.5) / TURN
        f = FREQUENCY.get(self.effect.name)
        own = p.copy()
        if f is not None:
            own[f] = 1.0  # the law over one turn does not depend on it
        t = theta / (2 * np.pi)
        law = force_array(self.effect, own, np.zeros(TURN), t=t, phase=theta, s=1.0 if place.endswith("x") else -1.0)
        k = np.arange(1.0, count + 1)
        F = -2.0 / TURN * np.fft.rfft(law)[1 : count + 1] * np.exp(-0.5j * k * 2 * np.pi / TURN)
        if self.effect.kind in ("disc", "shaft"):
            F *= to_cap(model, place, np.asarray(2 * np.pi * self.hz * k)) - (0.5 if self.effect.name == "bow" else 0.0)
        return np.asarray(F)

    def sounding(self, count: int) -> NDArray[np.bool_]:
        """(count,) which harmonics its law has."""
        return sounding(self.effect.name, count)


def sounding(name: str, count: int) -> NDArray[np.bool_]:
    """(count,) which harmonics a periodic effect has."""
    if name == "local_defect":
        return np.ones(count, bool)
    return np.asarray(np.arange(1, count + 1) == (2 if name == "misalignment" else 1))


def fundamental(effect: Effect, own: Mapping[str, Setting], model: Model) -> float:
    """Hz at which the angle of a periodic effect with these settings turns; 0 where that is not known."""
    rotation, k = (model.speed_rpm or 0.0) / 60.0, FREQUENCY.get(effect.name)
    if k is None:
        return rotation
    q = effect.parameters[k]
    value = own.get(q.name, Setting()).value or kinematic(q.scale, model) or 0.0
    return value if effect.name == "line" else rotation * value


def known_lines(model: Model) -> list[float]:
    """Hz of the lines that the model's own effects make, whether their strength is known or not."""
    out: dict[float, None] = {}
    for use in model.effects:
        if use.name in PERIODIC:
            effect = CATALOGUE[use.name]
            orders = 1 + np.flatnonzero(sounding(use.name, LINES))
            for key in at(effect, use, model):
                hz = fundamental(effect, written(effect, use, model, key), model)
                out |= dict.fromkeys((hz * orders).tolist() if hz > 0.0 else ())
    return list(out)


def to_cap(model: Model, place: str, omega: Array) -> Complexes:
    """(f,) force on a cap per force on the disc, by reciprocity the disc's displacement per cap displacement."""
    disc = model.mass.get("disc", 0.0)
    _, follow = shaft_at_caps(model.shaft, model.shaft_stiffness, model.shaft_damping, disc, omega)
    return np.asarray(follow[:, int(place[7]) - 1])


def periodic_of(model: Model) -> list[Periodic]:
    """The model's periodic effects whose numbers are all known, by place."""
    out = []
    for use in model.effects:
        if use.name not in PERIODIC:
            continue
        effect = CATALOGUE[use.name]
        for key in at(effect, use, model):
            try:
                p = values(effect, use, model, key)
            except ModelError:
                continue
            own = written(effect, use, model, key)
            hz = fundamental(effect, own, model)
            if hz > 0.0:
                free = tuple(not own.get(q.name, Setting()).fixed for q in effect.parameters)
                out.append(Periodic(effect, key, p, free, hz))
    return out


def series(
    model: Model, places: tuple[str, ...], t: Array, phase: Array, rate_hz: float, band: tuple[float, float]
) -> Array | None:
    """(places, n) N that the periodic effects put on the caps, as far as the band lets it through; None without any.

    t, phase : (n,) s and rad.
    """
    out: Array | None = None
    for one in periodic_of(model):
        count = int(min(0.5 * rate_hz / one.hz, TURN // 8))
        gain = passband(np.asarray(one.hz * np.arange(1.0, count + 1)), rate_hz, band)
        if not ((gain > LEAST) & one.sounding(count)).any():
            continue
        turn = (one.angle(t, phase) / (2 * np.pi)) % 1.0
        for i, place in enumerate(places):
            if not _acts(one, place):
                continue
            spectrum = np.zeros(TURN // 2 + 1, complex)
            spectrum[1 : count + 1] = 0.5 * TURN * gain * one.harmonics(model, place, count)
            wave = np.fft.irfft(spectrum, TURN)
            out = np.zeros((len(places), t.size)) if out is None else out
            out[i] += np.interp(turn * TURN, np.arange(TURN + 1), np.append(wave, wave[0]))
    return out


def _acts(one: Periodic, place: str) -> bool:
    return one.key in ("disc", place, place.split(".")[0])


def refined(model: Model, data: MotionBlocks, force: Array, S: Array) -> tuple[Model, dict[str, Parameter]]:
    """The model with the numbers of its periodic effects one step nearer, and these with their standard deviations.

    force : (places, n) N inferred with the effects as they are; S : (places,). Only what lies in the band is moved.
    """
    found: dict[str, Parameter] = {}
    uses = {use.name: dict(use.parameters) for use in model.effects}
    for one in periodic_of(model):
        stepped = _step(model, one, data, force, S)
        if stepped is None:
            continue
        p, sd = stepped
        old = written(one.effect, next(u for u in model.effects if u.name == one.effect.name), model, one.key)
        uses[one.effect.name][one.key] = {
            q.name: replace(old.get(q.name, Setting()), value=float(v))
            for q, v in zip(one.effect.parameters, p, strict=True)
        }
        told = _told(one, p, sd)
        for k, q in enumerate(one.effect.parameters):
            value, spread = float(p[k]), float(sd[k])
            found[f"{one.key}.{one.effect.name}.{q.name}"] = (
                Parameter(value, 0.0, q.unit, True, "given") if not one.free[k]
                else Parameter(value, spread, q.unit) if told[k]
                else Parameter(None, None, q.unit, False, f"{value:.3g} +- {spread:.2g}: {UNTOLD}")
            )  # fmt: skip
    effects = tuple(replace(u, parameters=uses[u.name]) for u in model.effects)
    return replace(model, effects=effects), found


def _told(one: Periodic, p: Array, sd: Array) -> list[bool]:
    """Whether each number is known: the two components of a phasor together, an angle whatever its value."""
    names = [q.name for q in one.effect.parameters]
    amplitude = [k for k, q in enumerate(one.effect.parameters) if q.linear]
    there = bool(np.hypot.reduce(p[amplitude]) > 2.0 * sd[amplitude].max())
    return [there and (name == "angle" or k in amplitude or s <= 0.5 * abs(v))
            for k, (name, v, s) in enumerate(zip(names, p, sd, strict=True))]  # fmt: skip


def _step(model: Model, one: Periodic, data: MotionBlocks, force: Array, S: Array) -> tuple[Array, Array] | None:
    """(k,) numbers after the step and their standard deviations; None if none is free, or no harmonic in the band."""
    count = int(min(data.band[1] / one.hz, TURN // 8))
    inside = np.flatnonzero((one.hz * np.arange(1, count + 1) >= data.band[0]) & one.sounding(count))
    loose = [k for k, free in enumerate(one.free) if free]
    if inside.size == 0 or not loose:
        return None
    tau = data.t - data.t.mean()
    pieces = np.minimum((np.arange(tau.size) * PIECES) // tau.size, PIECES - 1)
    middle = np.bincount(pieces, tau) / np.bincount(pieces)
    rate = 2 * np.pi if one.effect.name == "line" else data.speed  # d theta / dt per unit of the frequency parameter
    rows, right = [], []
    for i, place in enumerate(data.places):
        if not _acts(one, place):
            continue
        seen = _demodulated(force[i], one.angle(data.t, data.phase), pieces, count)[:, inside]
        slopes = np.zeros((len(loose), *seen.shape), complex)
        for j, k in enumerate(loose):
            if k == FREQUENCY.get(one.effect.name):
                F = one.harmonics(model, place, count)[inside]
                slopes[j] = 1j * rate * (1 + inside) * F * middle[:, None]
            else:
                slopes[j] = _slope(model, one, place, count, k)[inside]
        scale = np.sqrt(data.t.size / PIECES / (S[i] * data.rate_hz))  # 1 / sd of a real part
        rows.append(slopes.reshape(len(loose), -1) * scale)
        right.append(seen.ravel() * scale)
    J, d = np.concatenate(rows, axis=1), np.concatenate(right)
    J, d = np.concatenate([J.real, J.imag], axis=1), np.concatenate([d.real, d.imag])
    size = np.sqrt(np.sum(J * J, axis=1))
    size[size == 0] = 1.0
    information = (J @ J.T) / np.multiply.outer(size, size)
    step = np.linalg.lstsq(information, J @ d / size, rcond=1e-10)[0] / size
    spread = np.sqrt(np.diag(np.linalg.pinv(information, rcond=1e-10))) / size
    p, sd = one.p.copy(), np.zeros(one.p.size)
    for j, k in enumerate(loose):
        q = one.effect.parameters[k]
        limit = np.inf if q.linear else 0.5 if q.name == "angle" else 0.3 * abs(p[k])
        p[k] += np.clip(step[j], -limit, limit)
        if q.name == "angle":
            p[k] %= 2 * np.pi
        sd[k] = spread[j]
    return p, sd


def _slope(model: Model, one: Periodic, place: str, count: int, k: int) -> Complexes:
    """(count,) change of the harmonics with parameter k."""
    q = one.effect.parameters[k]
    h = 1.0 if q.linear else 0.01 if q.name == "angle" else 0.01 * abs(one.p[k])
    up, down = one.p.copy(), one.p.copy()
    up[k] += h
    down[k] -= h
    both = (one.harmonics(model, place, count, p) for p in (up, down))
    return np.asarray((next(both) - next(both)) / (2 * h))


def _demodulated(force: Array, angle: Array, pieces: NDArray[np.int64], count: int) -> Complexes:
    """(pieces, count) harmonics of a force (n,) over an angle, by folding each piece."""
    bins = 1 << int(np.ceil(np.log2(8 * count)))
    cell = ((angle / (2 * np.pi)) % 1.0 * bins).astype(np.int64) % bins
    folded = np.bincount(pieces * bins + cell, force, PIECES * bins).reshape(PIECES, bins)
    k = np.arange(1, count + 1)
    F = np.fft.rfft(folded, axis=1)[:, 1 : count + 1] * np.exp(-1j * np.pi * k / bins) / np.sinc(k / bins)
    return np.asarray(2 * F / np.bincount(pieces)[:, None])
