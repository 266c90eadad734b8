"""What bends the path from a measured force to a measured motion: a pedestal, or a sensor that is wrong.

Each is tried as the A' of transfer.py, stiffness and damping fitted beside it. The known mass is what tells a gain:
measured with the gain 1 + error, the rotor's mass seems to be m / (1 + error), and nothing else changes that.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from . import pedestal_form
from .effects import CATALOGUE
from .effects.places import at, written
from .estimate import Parameter
from .folded_force import images
from .force_shapes import resonance_hz
from .missing_force import NEGLIGIBLE
from .model import MOTION, Model
from .noise_floor import NOISE_RATIO
from .periodic import known_lines
from .sensor_response import LINEAR, forced, response
from .suspect import UNKNOWN, Suspect
from .transfer import Peak, Response, exp, expected, highest, left, linear, noises, plain, response_of
from .working_point import WorkingPoint

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]
EXPLAINED = 0.5  # of what a free response explains, for a cause to be the cause
LEVEL = 1e-2  # p-value above which nothing is said
HALVED = 0.5  # of what the best cause leaves, in power, that two together leave at most
OWN = slice(4, None)  # of the numbers of a peak, those of a cause
BEYOND_CHANCE = 8.0  # standard deviations of what a free response gains, for the path to be bent by who knows what
FEWEST = 100  # cells that are to be left
MATTERS = 1e-3  # of the force, in power: less noise than that bends nothing that would be claimed
# nats, for a cause to be likelier than none: a gain makes a wrong reading likelier than the right one by half of p in
# each cell, as |f|^2 is noisy there: 14 to 197 nats in records with 2 to 30 % of noise, whatever their length
WORTH = 250.0
ALIKE = 10.0  # nats, within which what is left is noise of the sensor
AS_WELL = 0.99  # of the nats of the likeliest cause, that a delay brings where it is one
CALIBRATED = 2e-3  # error of a gain that no calibration, and no weighing of a cap, would show to be one
CARRIED, SETTLED = 8, 0.1  # times at most that what is folded goes through a sensor as found; standard deviations
UNEVEN = 0.3  # rms of ln(power / model) of noise beyond its scatter, above which it is no noise of a sensor
NOTES = {
    "pedestal": CATALOGUE["pedestal"].distinguish,
    "sensor_gain": "a cap mass in the rig file that is off by as much, or a force channel by the inverse, is the same",
    "sensor_skew": "a force channel that is early by as much is the same: only the two against each other are told",
    "sensor_resonance": CATALOGUE["sensor_resonance"].distinguish,
}


@dataclass(frozen=True, slots=True, eq=False)
class Cause:
    """What may bend a tangent. values : parameters in SI of their free form, and `free` the other way; starts : in it.

    bend : A' of a response, the tangent (cells,) without the cause, kL and c, and the parameters. sensor : of a
    sensor's fault, its response at w (..., cells) over what is undone; what is folded went through it at the image."""

    effect: str
    starts: tuple[tuple[float, ...], ...]
    values: Callable[[Array], Array]
    free: Callable[[Array], Array]
    bend: Callable[[Response, Complexes, float, float, Array], Complexes]
    sensor: Callable[[Array, Array], Complexes] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(q.name for q in CATALOGUE[self.effect].parameters)


def _pedestal(mass: float, peak: float) -> Cause:
    def bend(r: Response, A: Complexes, k: float, c: float, p: Array) -> Complexes:
        return np.asarray(A + pedestal_form.lost(r.w, k, c, p) / r.w**2)

    values, free = partial(pedestal_form.values, cap_mass=mass), partial(pedestal_form.free, cap_mass=mass)
    return Cause("pedestal", pedestal_form.starts(peak), values, free, bend)


def _sensor(effect: str, starts: tuple[tuple[float, ...], ...], unit: float, now: Mapping[str, float | None]) -> Cause:
    """A fault that is a response. now : its numbers that have been undone. unit : of the free form; 0: logarithms."""
    names = [q.name for q in CATALOGUE[effect].parameters]
    limits = np.array([(3.0, 13.0), (-1.5, 6.0)]).T

    def bend(r: Response, A: Complexes, k: float, c: float, p: Array) -> Complexes:
        return np.asarray(A / sensor(r.w, p))

    def sensor(w: Array, p: Array) -> Complexes:
        return response(effect, dict(zip(names, p, strict=True)), w) / response(effect, now, w)

    if unit == 0.0:
        return Cause(effect, starts, lambda z: np.exp(np.clip(z, *limits)), np.log, bend, sensor)
    return Cause(effect, starts, lambda z: unit * z, lambda p: p / unit, bend, sensor)


def causes(point: WorkingPoint, i: int, have: Mapping[str, Mapping[str, float | None]]) -> list[Cause]:
    """Those that a place may have. have : numbers of those that the model has there."""
    data = point.data
    peak = resonance_hz(point, i)
    top = data.band[1]
    resonances = tuple(
        (float(np.log(top * f)), float(np.log(q))) for f in (0.25, 0.45, 0.7, 1.0, 1.4, 2.5) for q in (4, 25)
    ) + ((float(np.log(30 * top)), 0.0),)
    return [
        _pedestal(float(data.mass[i]), peak),
        _sensor("sensor_gain", ((0.0,), (0.1,), (-0.1,), (1.0,), (-0.5,), (-2.0,)), 1.0, have.get("sensor_gain", {})),
        _sensor("sensor_skew", ((0.0,), (-3.0,), (-1.0,), (1.0,), (3.0,)), 1.0 / data.rate_hz,
                have.get("sensor_skew", {})),
        _sensor("sensor_resonance", resonances, 0.0, have.get("sensor_resonance", {})),
    ]  # fmt: skip


def bent(
    point: WorkingPoint, i: int, r: Response, cause: Cause, base: Peak, scale: Array, starts: list[Array]
) -> Peak:  # fmt: skip
    """The likeliest numbers of a cause beside k and c."""
    k, c = float(point.kL[i]), float(point.c[i])

    def bend(d: Array) -> Complexes:
        return cause.bend(r, linear(r, d), k + d[0], c + d[1], cause.values(d[2:]))

    wide = np.concatenate([scale, np.full(starts[0].size, 0.1)])
    peaks = [highest(r, bend, np.concatenate([base.u[:4], z]), wide) for z in starts]
    best = max(peaks, key=lambda peak: peak.nats)

    def again(r: Response) -> list[Peak]:
        return [highest(r, bend, np.concatenate([noise, best.u[2:]]), wide) for noise in noises(r, best.A)]

    best = max([best, *again(r)], key=lambda peak: peak.nats)
    if cause.sensor is None or r.bare is None:
        return best
    for _ in range(CARRIED):
        was, further = best.u[OWN], cause.sensor(images(r.w, point.data.rate_hz), cause.values(best.u[OWN]))
        best = max(again(r.through(further)), key=lambda peak: peak.nats)
        if np.all(np.abs(best.u[OWN] - was) < SETTLED * np.sqrt(np.diag(best.covariance)[OWN])):
            break
    return best


def _settings(cause: Cause, peak: Peak, part: slice = OWN) -> dict[str, Parameter]:
    """Parameters of a cause with their standard deviations. part : where its free form is in the peak."""
    z, q = peak.u[part], len(cause.names)
    values = cause.values(z)
    slopes = np.stack([(cause.values(z + 1e-5 * e) - values) / 1e-5 for e in np.eye(q)])
    sd = np.sqrt(np.maximum(np.diag(slopes.T @ peak.covariance[part, part] @ slopes), 0.0))
    return {
        p.name: Parameter(float(v), float(s), p.unit)
        for p, v, s in zip(CATALOGUE[cause.effect].parameters, values, sd, strict=True)
    }


def find(model: Model, point: WorkingPoint, lines: Collection[float] = ()) -> list[Suspect]:
    """Pedestals and faulty sensors that the model does not have, at places whose force is measured.

    lines : Hz of what is periodic in the residual, which is left out.
    """
    out: list[Suspect] = []
    heard: dict[int, tuple[Response, Peak, Array]] = {}
    for i, place in enumerate(point.data.places):
        if place not in forced(model) or point.kL[i] <= 0.0:
            continue
        r = response_of(point, i, lines)
        if r.n.size < FEWEST:
            continue
        tried = _likeliest(model, point, i, r)
        if late := r.late(point.data.rate_hz):
            delayed = _likeliest(model, point, i, late)
            tried = delayed if delayed.late and delayed.nats > tried.nats else tried
        found = _found(model, point, i, tried)
        if not found:
            heard[i] = tried.response, tried.base, tried.scale
        out += found
    return out + _noisy(model, point, heard)


@dataclass(frozen=True, slots=True)
class Tried:
    """A place without a cause, `base`, and with each. likely : nats of the best, less what it is to bring."""

    response: Response
    base: Peak
    scale: Array
    causes: dict[Cause, Peak]

    @property
    def nats(self) -> float:
        """Of the best."""
        return max(self.base.nats, *(peak.nats for peak in self.causes.values()), -np.inf)

    @property
    def late(self) -> bool:
        """Whether a delay is as likely as any cause; a resonance far above the band is hardly likelier."""
        gains = {cause.effect: peak.nats - self.base.nats for cause, peak in self.causes.items()}
        return gains.get("sensor_skew", 0.0) > AS_WELL * max(gains.values(), default=0.0)

    @property
    def likely(self) -> float:
        best = max(self.base.nats, *(peak.nats - WORTH for peak in self.causes.values()), -np.inf)
        return best - ALIKE * (self.response.unmeasured > 0.0)


def _likeliest(model: Model, point: WorkingPoint, i: int, r: Response) -> Tried:
    """What is left of the force at a place, where it is enough to matter, read as noise of its sensor, as a force that
    acts beside it, or as both. The first makes the rotor seem lighter and softer by its share of the force, in power.
    """
    noise = _tried(model, point, i, r)
    if float(np.average(r.share(exp(noise.base.u[0])), weights=r.n)) < MATTERS:
        return noise
    either = noise, _tried(model, point, i, replace(r, unmeasured=1.0))
    share = _share(point, i, r)
    both = plain(point, i, replace(r, unmeasured=share))[0].nats
    if both < max(tried.base.nats for tried in either) + ALIKE:
        return max(either, key=lambda tried: tried.likely)
    return max(*either, _tried(model, point, i, replace(r, unmeasured=share)), key=lambda tried: tried.likely)


def _share(point: WorkingPoint, i: int, r: Response) -> float:
    """Of what is left, the likeliest share that acts beside the measured force; the rest is noise of its sensor."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(
        lambda share: -plain(point, i, replace(r, unmeasured=float(share)))[0].nats, bounds=(0.0, 1.0),
        method="bounded", options={"xatol": 1e-3},
    )  # fmt: skip
    return float(found.x)


def pushed(model: Model, point: WorkingPoint) -> bool:
    """Whether somewhere more of what is left acts beside the measured force than is noise of its sensor, as far as the
    known mass tells."""
    lines = known_lines(model)
    for i, place in enumerate(point.data.places):
        if place not in forced(model) or model.cap_mass(place) is None or point.kL[i] <= 0.0:
            continue
        r = response_of(point, i, lines)
        if r.n.size >= FEWEST and _likeliest(model, point, i, r).response.unmeasured > 0.5:
            return True
    return False


def pedestal(point: WorkingPoint, i: int) -> tuple[Array, float, float]:
    """(3,) mass, frequency and damping that the motion under a measured force suggests, likely or not; kL and c."""
    r = response_of(point, i)
    base, scale = plain(point, i, r)
    cause = causes(point, i, {})[0]
    u = bent(point, i, r, cause, base, scale, [np.array(z) for z in cause.starts]).u
    return cause.values(u[4:]), float(point.kL[i] + u[2]), float(point.c[i] + u[3])


def refined(model: Model, point: WorkingPoint) -> tuple[Model, dict[str, Parameter]]:
    """The model with the numbers of its sensors' faults, those undone in the record of the point, one step nearer, and
    these as parameters. Of two faults of a sensor one after the other."""
    found: dict[str, Parameter] = {}
    lines = known_lines(model)
    uses = []
    for use in model.effects:
        new = {key: dict(own) for key, own in use.parameters.items()}
        for key in at(CATALOGUE[use.name], use, model) if use.name in LINEAR else ():
            own = written(CATALOGUE[use.name], use, model, key)
            now = {n: s.value for n, s in own.items()}
            i = point.data.places.index(key)
            if key not in forced(model) or all(s.fixed for s in own.values()) or None in now.values():
                continue
            if point.kL[i] <= 0.0:
                continue
            (cause,) = (c for c in causes(point, i, {use.name: now}) if c.effect == use.name)
            starts = [cause.free(np.array([now[n] for n in cause.names])), *map(np.array, cause.starts)]
            r = response_of(point, i, lines)
            late = r.late(point.data.rate_hz) if use.name == "sensor_skew" else None
            peaks = [bent(point, i, z, cause, *plain(point, i, z), starts) for z in (r, late) if z]
            best = _settings(cause, max(peaks, key=lambda peak: peak.nats))
            new.pop(key.split(".")[0], None)
            new[key] = {n: s if s.fixed else replace(s, value=best[n].value) for n, s in own.items()}
            for n, q in best.items():
                judged = Parameter.judged(q.value or 0.0, q.sd or 0.0, q.unit)
                found[f"{key}.{use.name}.{n}"] = Parameter(own[n].value, 0.0, q.unit) if own[n].fixed else judged
        uses.append(replace(use, parameters=new))
    return replace(model, effects=tuple(uses)), found


def _density(r: Response, peak: Peak) -> float:
    """PSD of the noise of a sensor of motion, with the least of what is folded into it."""
    return exp(peak.u[1]) + float(np.min(r.folded))


def _noisy(model: Model, point: WorkingPoint, heard: Mapping[int, tuple[Response, Peak, Array]]) -> list[Suspect]:
    """A sensor whose noise stands out of its neighbours', where white noise of force and motion is all that is left."""
    data = point.data
    have = {place for u in model.effects if u.name == "sensor_noise" for place in u.parameters}
    out = []
    for i, (r, base, scale) in heard.items():
        place = data.places[i]
        P, _, s = expected(r, base.A, base.u)
        off = np.log(P / s)
        others = [_density(*own[:2]) for j, own in heard.items() if j != i and data.kinds[j] == data.kinds[i]]
        depth = np.average(off**2 - 1.0 / r.n, weights=r.n)
        if not others or place in have or depth > UNEVEN**2:
            continue
        density, floor = _density(r, base), float(np.median(others))
        if density < NOISE_RATIO * floor:
            continue
        own = np.log(floor - min(float(np.min(r.folded)), 0.9 * floor))
        quiet = highest(r, partial(linear, r), np.array([base.u[0], own, *base.u[2:]]), scale, held=1)
        gain = base.nats - quiet.nats
        if 2 * gain < NOISE_RATIO:
            continue
        rms = float(np.sqrt(density * data.rate_hz / 2))
        name, unit = next(c.name for c in model.channels if c.place == place), MOTION[data.kinds[i]]
        power = float((density * r.noise * np.abs(r.A) ** 2) @ r.hz)
        out.append(
            Suspect(
                "sensor_noise", (place,), gain, 1, float(chdtrc(1, 2 * gain)) * len(heard), {i: power}, "frequency",
                f"noise floor of {name}: {rms:.2g} {unit} rms, {np.sqrt(density / floor):.1f} times its neighbours'",
                {place: {"rms": Parameter(rms, 0.5 * rms * float(np.sqrt(base.covariance[1, 1])), unit)}},
                "the model is not wrong: a simulation cannot follow what the sensor adds",
            )
        )  # fmt: skip
    return out


def _tried(model: Model, point: WorkingPoint, i: int, r: Response) -> Tried:
    """Every cause that the model does not have at a place."""
    place = point.data.places[i]
    base, scale = plain(point, i, r)
    taken = {u.name for u in model.effects if place in u.parameters or place.split(".")[0] in u.parameters}
    taken |= {"sensor_gain"} if model.cap_mass(place) is None else set()
    tried = {
        cause: bent(point, i, r, cause, base, scale, [np.array(z) for z in cause.starts])
        for cause in causes(point, i, {})
        if cause.effect not in taken
    }
    return Tried(r, base, scale, tried)


def _found(model: Model, point: WorkingPoint, i: int, at_place: Tried) -> list[Suspect]:
    """What bends the path at a place: one cause, two together where one leaves much, or who knows what."""
    data, place = point.data, point.data.places[i]
    r, base, scale, tried = at_place.response, at_place.base, at_place.scale, at_place.causes
    least = (NEGLIGIBLE * point.bearing_force[i]) ** 2
    before = left(r, base.A)
    coherent = float(r.n @ (_odd(r, base)[0] / before)) - r.n.size  # beyond chance, in units of what is left

    def suspect(cause: Cause, part: slice, peak: Peak, without: Peak) -> list[Suspect]:
        power = float(np.maximum(before - left(r, peak.A), 0.0) @ r.hz)
        explained = float(r.n @ (1 - left(r, peak.A) / before))
        if explained < EXPLAINED * coherent or power < least:
            return []
        gain, q = peak.nats - without.nats, len(cause.names)
        p = float(min(1.0, chdtrc(q, 2 * max(gain, 0.0)) * 4 * len(data.places) * len(cause.starts)))
        if p > LEVEL:
            return []
        where = _where(r, before, peak.A)
        settings = {place: _settings(cause, peak, part)}
        return [Suspect(cause.effect, (place,), gain, q, p, {i: power}, "frequency", where, settings,
                        NOTES[cause.effect])]  # fmt: skip

    out = [s for cause, peak in tried.items() for s in suspect(cause, OWN, peak, base)]
    late = next((peak for cause, peak in tried.items() if cause.effect == "sensor_skew"), base)
    if at_place.late and not _bent_still(r, late, least):
        out = [s for s in out if s.effect != "sensor_resonance"]
    best = max(tried.values(), key=lambda peak: peak.nats, default=base)
    if not _bent_still(r, best, least):
        slight = any(c.effect == "sensor_gain" and abs(peak.u[4]) < CALIBRATED and not _bent_still(r, peak, least)
                     for c, peak in tried.items())  # fmt: skip
        return [] if slight else out
    pairs = [(a, b, _both(point, i, r, a, b, tried, scale)) for a, b in combinations(tried, 2)]
    if pairs:
        a, b, peak = max(pairs, key=lambda pair: pair[2].nats)
        k = 4 + len(a.names)
        two = suspect(a, slice(4, k), peak, tried[b]) + suspect(b, slice(k, None), peak, tried[a])
        if two and float(left(r, peak.A) @ r.hz) < HALVED * float(left(r, best.A) @ r.hz):
            return two
    if out or not _bent_still(r, base, least):
        return out
    power, z = _rest(r, base)
    where = _where(r, before, r.A - r.ra / r.aa)
    return [Suspect(UNKNOWN, (place,), z * z / 2, r.n.size, float(np.exp(-z * z / 2)), {i: power}, "frequency", where)]


def _both(
    point: WorkingPoint, i: int, r: Response, a: Cause, b: Cause, alone: Mapping[Cause, Peak], scale: Array
) -> Peak:  # fmt: skip
    """The likeliest numbers of two causes together, each begun where it is by itself and the other at its starts."""
    k = len(a.names)

    def apart(of_a: Callable[[Array], Array], of_b: Callable[[Array], Array]) -> Callable[[Array], Array]:
        return lambda z: np.concatenate([of_a(z[:k]), of_b(z[k:])])

    def bend(r: Response, A: Complexes, kL: float, c: float, p: Array) -> Complexes:
        return b.bend(r, a.bend(r, A, kL, c, p[:k]), kL, c, p[k:])

    pair = Cause(a.effect, (), apart(a.values, b.values), apart(a.free, b.free), bend)
    after = [np.concatenate([alone[a].u[4:], z]) for z in b.starts]
    return max(
        bent(point, i, r, pair, alone[a], scale, after),
        bent(point, i, r, pair, alone[b], scale, [np.concatenate([z, alone[b].u[4:]]) for z in a.starts]),
        key=lambda peak: peak.nats,
    )


def _odd(r: Response, peak: Peak) -> tuple[Array, Array]:
    """(cells,) of the power that is left what is coherent with the motion beyond the noise in both, and what is not."""
    P, rest, s = expected(r, peak.A, peak.u)
    N, Q = exp(peak.u[1]) * r.noise, exp(peak.u[0])
    own = r.unmeasured * Q / np.abs(peak.A) ** 2 + r.share(Q) * (r.aa - N)  # motion that Q makes, or stands for
    odd = rest - peak.A * (N + own) - np.abs(peak.A - r.alike) ** 2 * r.folded / peak.A.conj()
    return np.asarray(np.abs(odd) ** 2 / r.aa), np.maximum(s, P - np.abs(rest) ** 2 / r.aa)


def _rest(r: Response, peak: Peak) -> tuple[float, float]:
    """N^2 that is coherent with the motion still, and by how many standard deviations it is more than chance."""
    odd, noise = _odd(r, peak)
    z = float((r.n @ (odd / noise) - r.n.size) / np.sqrt(r.n.size))  # each an exponential variable of mean 1
    return float((odd - noise / r.n) @ r.hz), z


def _bent_still(r: Response, peak: Peak, least: float) -> bool:
    power, z = _rest(r, peak)
    return power > least and z > BEYOND_CHANCE


def _where(r: Response, before: Array, A: Complexes) -> str:
    k = int(np.argmax(r.n * np.log(before / left(r, A))))
    return f"the motion does not follow the measured force as the model says about {r.w[k] / 2 / np.pi:.0f} Hz"
