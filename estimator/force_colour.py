"""The spectrum of the inferred force: not white, shaped by a sensor, by a pedestal, or shared by the two bearings.

Nothing here depends on the state of the rotor, so nothing here can be a force law. The mean power of the inferred
force in narrow cells is compared, by the Whittle likelihood, with what each cause would give, k and c refitted for
each (a shape near the resonance can hide in them).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from . import pedestal_form
from .effects import CATALOGUE
from .estimate import Parameter
from .model import MOTION, Model
from .noise_paths import LEAST_NOISE, beyond, heard_of_all
from .roll_off import images
from .suspect import Suspect
from .working_point import WorkingPoint

Array = NDArray[np.float64]
CELLS = 260
LEVEL = 1e-3
LEAST_DEPTH = 0.015  # rms of ln(power / model): less is within what filters and integrators leave behind
EXPLAINED = 0.5  # of the misfit beyond chance: a cause that leaves more is not the cause
DARKEST = 0.985  # of S, that the gain of a colour may take away at low frequencies
BROADENED = 0.75  # of a damping: what one resonance has too much in place of two, of a rotor and a strong pedestal
PEAKED = 1.0  # quality of a sensor's resonance: below it filters look alike
FOLDED = 0.01  # of what sampling folds back, that noise of a sensor has to be NOISE_RATIO times as strong as
LEAST_SHARE = 1e-3  # of the noise of the noisiest sensor, in power, that every one is given
SMALL = 1e-8  # change of a number, in its scale, for a derivative
NOISE_RATIO = 6.0  # in power, of one sensor's noise over its neighbours', to call it faulty


@dataclass(frozen=True, slots=True)
class Cells:
    """Mean spectra of one place. power : (cells,) N^2/Hz mean |F|^2; n : bins; A : (cells,) tangent, the other caps
    answering; w : rad/s; colour : shape of the force that the model has; heard : force that the noise of the
    sensors at all caps makes, over that of its own; others : (m/s^2)^2/Hz that the forces at the other caps move this
    one by; back : over S, the force that what sampling folds back at all caps makes; echoes : (images, cells) of that
    the own sensor's, by image; images : (images, cells) Hz of these."""

    power: Array
    n: Array
    w: Array
    A: NDArray[np.complex128]
    colour: Array
    heard: Array
    others: Array
    back: Array
    echoes: Array
    images: Array

    def at(self, keep: NDArray[np.bool_]) -> Cells:
        """Some of them."""
        return Cells(*(getattr(self, f.name)[..., keep] for f in fields(self)))

    def tangent(self, u: Array) -> NDArray[np.complex128]:
        """A with u[2:4], changes of k and c. Here and below u may be (numbers, m, 1), for (m, cells) at once."""
        return np.asarray(self.A - u[2] / self.w**2 + u[3] / (1j * self.w))

    def spectrum(self, u: Array, A: NDArray[np.complex128], factor: float | Array = 1.0) -> Array:
        """Of the inferred force, if A is the rotor's. u : ln S, ln of the noise; factor : of the force spectrum.

        Inferred is F - d a, d = A - self.A, of a = (F + self.A o) / A, where o is the motion by the other forces alone.
        What is no motion comes into it as the model infers it, whatever the rotor's A.
        """
        S, noise = _exp(u[0]), _exp(u[1])
        force = S * self.colour * factor + np.abs(A - self.A) ** 2 * self.others
        return np.asarray(force * np.abs(self.A / A) ** 2 + noise * self.heard + S * self.back)


def _heard(point: WorkingPoint, i: int) -> Array:
    """(bins,) as Cells.heard: sensors are as noisy to each other as the fit has them, alike where it has none."""
    N = point.nu * point.S
    N = np.maximum(N, LEAST_SHARE * N.max()) if N.any() else np.ones(N.size)
    return np.asarray(heard_of_all(point.data, point.A, N)[i] / N[i])


def cells_of(point: WorkingPoint, i: int) -> Cells:
    """Cells about evenly spread in log frequency, fine at the resonance."""
    data, power = point.data, _power(point, i)
    edges = np.unique(np.round(np.geomspace(12, power.size, CELLS)).astype(int))
    first = np.concatenate([[0], edges[:-1]])
    width = np.diff(np.append(first, power.size)).astype(np.float64)

    def mean(z: Array) -> Array:
        return np.asarray(np.add.reduceat(z, first, axis=-1) / width)

    w = 2 * np.pi * data.f_hz
    A, others = answered(point.A, point.S, i)
    echoes = np.abs(point.A[:, i, i]) ** 2 * data.echoes[:, i]
    return Cells(
        mean(power), width * data.blocks, mean(w), mean(A.real) + 1j * mean(A.imag), mean(data.colour[i]),
        mean(_heard(point, i)), mean(others), mean(beyond(data, point.A, point.S)[i]), mean(echoes),
        mean(images(data.rate_hz, data.f_hz)[: len(echoes)]),
    )  # fmt: skip


def answered(A: NDArray[np.complex128], S: Array, i: int) -> tuple[NDArray[np.complex128], Array]:
    """(f,) force per acceleration of place i while the others answer, and (f,) PSD of the acceleration that the forces
    S (places,) at the others give it. A : (f, places, places)."""
    H = np.asarray(np.linalg.inv(A)[:, i], dtype=np.complex128)
    others = np.delete(np.arange(len(S)), i)
    return 1.0 / H[:, i], np.asarray(np.abs(H[:, others]) ** 2 @ S[others], dtype=np.float64)


def _power(point: WorkingPoint, i: int) -> Array:
    """(bins,) mean |F|^2 of the force at a place, N^2/Hz."""
    Z = point.spectra[i].reshape(point.data.blocks, -1, 2)
    power = np.einsum("bkc,bkc->k", Z, Z).astype(np.float64) / point.data.blocks / point.weighing.weight[i]
    return np.asarray(power if point.weighing.rings is None else power / point.weighing.rings.kept[i])


def _exp(z: Array) -> Array:
    """exp, kept finite on the way to the maximum."""
    return np.asarray(np.exp(np.clip(z, -80.0, 20.0)))


def base_model(c: Cells, u: Array) -> Array:
    """u : ln S, ln(noise share), relative changes of k and c in units of 1 / w^2 and 1 / (i w)."""
    return c.spectrum(u, c.tangent(u))


@dataclass(frozen=True, slots=True)
class Shape:
    """A cause: multiplier of the whole measured power, or of S, by its parameters in free form; starts in that form.

    idle : N s/m, the damping that starts are tried without as well.
    """

    effect: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    starts: tuple[tuple[float, ...], ...]
    model: Callable[[Cells, Array], Array]
    values: Callable[[Array], Array]
    idle: float = 0.0


def _coloured(place_peak: float) -> Shape:
    def values(z: Array) -> Array:
        return np.array([np.exp(np.clip(z[0], -6, 7)) - DARKEST, np.exp(np.clip(z[1], 2, 12))])

    def model(c: Cells, u: Array) -> Array:
        return c.spectrum(u, c.tangent(u), coloured(c.w / (2 * np.pi), *values(u[4:])))

    starts = tuple((g, float(np.log(place_peak * f))) for g in (0.6, 1.5, -0.5) for f in (0.4, 1.0, 2.5))
    return Shape("coloured_excitation", ("gain", "corner"), ("1", "Hz"), starts, model, values)


def _resonance(top: float) -> Shape:
    def values(z: Array) -> Array:
        return np.array([np.exp(np.clip(z[0], 3, 13)), np.exp(np.clip(z[1], -0.5, 5))])

    def model(c: Cells, u: Array) -> Array:
        numbers = values(u[4:])
        out = c.spectrum(u, c.tangent(u), resonant(c.w / (2 * np.pi), *numbers))
        beyond = c.echoes[:, None] * (resonant(c.images[:, None], *numbers) - 1.0)
        return np.asarray(out + (_exp(u[0]) * beyond.sum(axis=0)).reshape(out.shape))

    starts = tuple((float(np.log(top * f)), float(np.log(q))) for f in (0.25, 0.45, 0.7, 1.0, 1.4) for q in (4, 25))
    return Shape("sensor_resonance", ("frequency", "quality"), ("Hz", "1"), starts, model, values)


def coloured(f_hz: Array, gain: float | Array, corner: float | Array) -> Array:
    """Power that a colour of the force multiplies that at f_hz by."""
    return np.asarray(1 + gain / (1 + (f_hz / corner) ** 2))


def resonant(f_hz: Array, f0: float | Array, quality: float | Array) -> Array:
    """Power that a sensor's resonance multiplies that at f_hz by."""
    r2 = (f_hz / f0) ** 2
    return np.asarray(1.0 / ((1 - r2) ** 2 + r2 / quality**2))


def _pedestal(mass: float, kL: float, c0: float, peak: float) -> Shape:
    values = partial(pedestal_form.values, cap_mass=mass)

    def model(c: Cells, u: Array) -> Array:
        lost = pedestal_form.lost(c.w, kL + u[2], c0 + u[3], values(u[4:]))
        return c.spectrum(u, c.tangent(u) + lost / c.w**2)

    names, units = ("mass", "frequency", "damping"), ("kg", "Hz", "1")
    return Shape("pedestal", names, units, pedestal_form.starts(peak), model, values, BROADENED * c0)


def deviance(root: Array, ratio: Array) -> Array:
    """Residuals whose squares add up to the Whittle likelihood ratio. root : of the bins of a cell; ratio : its power
    over a model's."""
    return np.asarray(np.sign(ratio - 1) * root * np.sqrt(np.maximum(2 * (ratio - 1 - np.log(ratio)), 0.0)))


def _maximum(
    c: Cells, model: Callable[[Cells, Array], Array], starts: list[Array], scale: Array
) -> tuple[float, Array, Array]:
    """Largest Whittle likelihood, where, and the standard deviations there. Once a start leads to what chance leaves of
    a true model, no other is tried."""
    from scipy.optimize import least_squares

    root, df = np.sqrt(c.n), c.n.size - scale.size

    def residual(z: Array) -> Array:
        return deviance(root, c.power / np.maximum(model(c, (z * scale).T), 1e-300))

    def slopes(z: Array) -> Array:
        step = SMALL * np.maximum(1.0, np.abs(z))
        here, *there = residual(np.vstack([z, z + np.diag(step)])[None])
        return np.asarray((there - here).T / step)

    best: tuple[float, Array, Array] | None = None
    for start in starts:
        found = least_squares(residual, start / scale, slopes, method="lm", max_nfev=60)
        if best is None or found.cost < best[0]:
            J = np.asarray(found.jac)
            H = J.T @ J
            sd = np.sqrt(np.maximum(np.diag(np.linalg.pinv(H, rcond=1e-12)), 0.0))
            best = (float(found.cost), found.x * scale, sd * scale)
        if 2 * found.cost < df + np.sqrt(2.0 * df):
            break
    if best is None:
        raise ValueError("no start")
    return -best[0], best[1], best[2]


def find(model: Model, point: WorkingPoint) -> list[Suspect]:
    """Shaped excitation, sensor resonance, pedestal and a noisy sensor, by place; and forces shared by the bearings."""
    data = point.data
    taken = {(u.name, place) for u in model.effects for place in u.parameters}
    out: list[Suspect] = []
    noise = np.zeros(len(data.places))
    shaped: set[int] = set()
    white: list[tuple[int, Cells, float, Array, Array]] = []
    for i, place in enumerate(data.places):
        if data.driven[i] > 0.0:  # what is left of a known force is noise: bent_path.py
            shaped.add(i)
            continue
        if point.kL[i] <= 0.0:  # a fit far from the rotor: no resonance to begin from
            continue
        c = cells_of(point, i)
        level, u, scale = plain(point, i, c)
        noise[i] = _exp(u[1])
        df = float(c.n.size - 4)
        off = np.average(np.log(c.power / base_model(c, u)) ** 2 - 1.0 / c.n, weights=c.n)  # without its own scatter
        depth = float(np.sqrt(max(float(off), 0.0)))
        if chdtrc(df, -2 * level) * len(data.places) > LEVEL or depth < LEAST_DEPTH:
            white.append((i, c, level, u, scale))
            continue
        shaped.add(i)
        out += _shapes(point, i, c, u, level, scale, {e for e, p in taken if p in (place, place.split(".")[0])})
    out += _alike(point, out, white, taken, shaped)
    out += [s for s in noisy(model, point, noise) if data.places.index(s.at[0]) not in shaped]
    return out + _shared(model, point)


def _alike(
    point: WorkingPoint,
    found: list[Suspect],
    white: list[tuple[int, Cells, float, Array, Array]],
    taken: set[tuple[str, str]],
    shaped: set[int],
) -> list[Suspect]:
    """What is found at a place is tried at those whose spectrum, of many cells, does not stand out by itself: bearings
    are alike. `shaped` takes up the places where it is."""
    best = max((s for s in found if s.effect == "pedestal"), key=lambda s: s.gain, default=None)
    if best is None or best.gain < max(s.gain for s in found):
        return []
    out = []
    for i, c, level, u, scale in white:
        place = point.data.places[i]
        others = {shape.effect for shape in _causes(point, i)} - {best.effect}
        have = {e for e, p in taken if p in (place, place.split(".")[0])}
        own = [s for s in _shapes(point, i, c, u, level, scale, others | have) if s.p_value < LEVEL]
        shaped.update(i for s in own)
        out += own
    return out


def plain(point: WorkingPoint, i: int, c: Cells) -> tuple[float, Array, Array]:
    """Likelihood and numbers of the base model at a place, and their scales."""
    scale = np.array([1.0, 1.0, point.kL[i] * 0.01, point.c[i] * 0.1 + 1e-9])
    least = point.S[i] * LEAST_NOISE / np.mean(c.heard)
    quiet = np.array([np.log(point.S[i]), np.log(least), 0.0, 0.0])
    u0 = quiet.copy()
    u0[1] = np.log(point.nu[i] * point.S[i]) if point.nu[i] > 0.0 else quiet[1] - 10.0
    level, u, _ = _maximum(c, base_model, [u0, quiet], scale)
    return level, u, scale


def otherwise(point: WorkingPoint, i: int, c: Cells, level: float, u: Array, scale: Array) -> float:
    """Least deviance of a place by a cause that is no roll-off: a colour with its corner in the band, a resonance with
    a peak, a pedestal."""
    least, top = -2 * level, point.data.band[1]
    for shape in _causes(point, i):
        found, z, _ = _shaped(c, shape, u, scale)
        values = shape.values(z[4:])
        if _peakless(shape.effect, values, top) or (shape.effect == "coloured_excitation" and values[1] > top):
            continue
        least = min(least, -2 * found)
    return least


def _causes(point: WorkingPoint, i: int) -> tuple[Shape, ...]:
    data, peak = point.data, resonance_hz(point, i)
    return (
        _coloured(peak), _resonance(data.band[1]), _pedestal(data.mass[i], point.kL[i], point.c[i], peak)
    )  # fmt: skip


def pedestal(point: WorkingPoint, i: int) -> tuple[Array, float, float]:
    """(3,) mass, frequency and damping that the spectrum at a place suggests to a model without one, likely or not, and
    kL and c beside it."""
    c = cells_of(point, i)
    _, u, scale = plain(point, i, c)
    shape = _pedestal(point.data.mass[i], point.kL[i], point.c[i], resonance_hz(point, i))
    found = _shaped(c, shape, u, scale)[1]
    return shape.values(found[4:]), float(point.kL[i] + found[2]), float(point.c[i] + found[3])


def level(point: WorkingPoint, i: int, gain: float, corner: float) -> Parameter:
    """S of a place whose excitation has a colour by these numbers, found in the same spectrum: they leave S many times
    more uncertain than its number of bins says."""
    own = 1 + gain / (1 + (point.data.f_hz / corner) ** 2)
    flat = replace(point, data=replace(point.data, colour=point.data.colour / own))
    c, shape = cells_of(flat, i), _coloured(resonance_hz(point, i))
    _, u, scale = plain(flat, i, c)
    u[0] = np.log(point.S[i])
    begun = replace(shape, starts=((float(np.log(gain + DARKEST)), float(np.log(corner))),))
    sd = _shaped(c, begun, u, scale)[2][0]  # of ln S
    return Parameter.judged(float(point.S[i]), float(point.S[i] * sd), "N^2/Hz")


def resonance_hz(point: WorkingPoint, i: int) -> float:
    """Hz of the resonance at a place."""
    return float(np.sqrt(point.kL[i] / point.data.mass[i]) / (2 * np.pi))


def _shaped(c: Cells, shape: Shape, u: Array, scale: Array) -> tuple[float, Array, Array]:
    """Largest likelihood of the base model, at u, with a cause beside it; where, and the standard deviations there.

    Without the cause there may have been no noise, ln 0, and from there a search finds none."""
    begun = np.array([u[0], max(u[1], u[0] + float(np.log(LEAST_NOISE / np.mean(c.heard)))), *u[2:]])
    starts = [np.concatenate([begun, s]) for s in shape.starts]
    if shape.idle:
        starts += [start - shape.idle * np.eye(start.size)[3] for start in starts]
    return _maximum(c, shape.model, starts, np.concatenate([scale, np.full(len(shape.names), 0.3)]))


def _shapes(
    point: WorkingPoint, i: int, c: Cells, u: Array, level: float, scale: Array, taken: set[str]
) -> list[Suspect]:
    data = point.data
    place = data.places[i]
    out = []
    r = c.power / base_model(c, u)
    weight = c.n / c.n.sum()
    # one-step prediction error of a process with spectrum r: what of it is predictable from its own past
    predictable = float(1 - np.exp(weight @ np.log(r)) / (weight @ r)) * _variance(point, i)
    for shape in _causes(point, i):
        if shape.effect in taken:
            continue
        found, z, sd = _shaped(c, shape, u, scale)
        gain = found - level
        if gain < EXPLAINED * (-level - 0.5 * (c.n.size - 4)):
            continue
        q = len(shape.names)
        values = shape.values(z[4:])
        spread = np.abs(shape.values(z[4:] + 1e-3) - values) / 1e-3 * sd[4:]
        settings = {
            n: replace(Parameter.judged(float(v), float(s), unit), value=float(v), sd=float(s))
            for n, v, s, unit in zip(shape.names, values, spread, shape.units, strict=True)
        }
        p = float(min(1.0, chdtrc(q, 2 * max(gain, 0.0)) * 3 * len(data.places) * len(shape.starts)))
        out.append(
            Suspect(
                shape.effect, (place,), gain, q + 2, p, {i: predictable}, "frequency", _where(c, r), {place: settings},
                _falls(shape.effect, values, data.band[1]),
            )
        )  # fmt: skip
    return out


def _peakless(effect: str, values: Array, top_hz: float) -> bool:
    """Whether a sensor's resonance is above the band and has no peak: a filter looks the same."""
    return effect == "sensor_resonance" and bool(values[0] > top_hz and values[1] < PEAKED)


def _falls(effect: str, values: Array, top_hz: float) -> str:
    """What to say of a resonance above the band that has no peak."""
    if not _peakless(effect, values, top_hz):
        return ""
    return (
        "the channel falls towards the end of the band as behind an anti-alias filter: a lower band.high leaves it out"
    )


def _variance(point: WorkingPoint, i: int) -> float:
    """N^2 of the force at a place, within the bins looked at."""
    return float(_power(point, i).sum()) * point.data.rate_hz / point.data.block


def _where(c: Cells, r: Array) -> str:
    k = int(np.argmax(np.abs(np.log(r)) * np.sqrt(c.n)))
    return f"force spectrum {'above' if r[k] > 1 else 'below'} the model about {c.w[k] / 2 / np.pi:.0f} Hz"


def noisy(model: Model, point: WorkingPoint, noise: Array) -> list[Suspect]:
    """A sensor whose noise floor stands out of its neighbours' of the same kind: others have another unit."""
    data = point.data
    out, heard = [], data.heard(point.A)
    have = {place for u in model.effects if u.name == "sensor_noise" for place in u.parameters}
    for i, place in enumerate(data.places):
        alike = [k for k, kind in enumerate(data.kinds) if k != i and kind == data.kinds[i] and data.driven[k] == 0.0]
        others = noise[alike]
        if others.size == 0 or place in have:
            continue
        # noise counts where it is loudest: that of an accelerometer low in the band, that of displacement at its top
        white = data.noise_shape[i]
        folded = point.S[i] * float(np.sum(data.folded[i]) / np.sum(white))
        floor = max(float(np.median(others)), 0.2 * point.S[i] / float(heard[i].max()), FOLDED * folded)
        if noise[i] < NOISE_RATIO * floor:
            continue
        rms = float(np.sqrt(noise[i] * data.rate_hz / 2))
        gain = 0.5 * data.blocks * float(np.sum(np.log1p(noise[i] * heard[i] / point.S[i]) ** 2) / 2)
        sd = rms / np.sqrt(2 * max(gain, 1.0))
        name, unit = next(c.name for c in model.channels if c.place == place), MOTION[data.kinds[i]]
        out.append(
            Suspect(
                "sensor_noise", (place,), gain, 1, float(np.exp(-min(gain, 700.0))),
                {i: float(noise[i] * np.mean(heard[i]) * (data.band[1] - data.band[0]))}, "frequency",
                f"noise floor of {name}: {rms:.2g} {unit} rms, {np.sqrt(noise[i] / floor):.1f} times its neighbours'",
                {place: {"rms": Parameter(rms, float(sd), unit)}},
            )
        )  # fmt: skip
    return out


def sensor_noise(point: WorkingPoint, i: int) -> Parameter:
    """rms over the whole band of the noise of a place's sensor, if it is white."""
    data = point.data
    density = point.nu[i] * point.S[i]
    floor = density * data.heard(point.A)[i]
    share = floor / (point.S[i] * data.colour[i] + floor)
    sd = 1.0 / np.sqrt(max(data.blocks * float(np.sum(share**2)), 1e-300))  # of ln(density), by the Whittle likelihood
    rms = float(np.sqrt(density * data.rate_hz / 2))
    return Parameter.judged(rms, 0.5 * rms * sd, MOTION[data.kinds[i]])


def _shared(model: Model, point: WorkingPoint) -> list[Suspect]:
    """Coherence of the inferred forces at the two bearings, direction by direction."""
    data = point.data
    out = []
    have = {p for u in model.effects if u.name == "correlated_force" for p in u.parameters}
    for i, place in enumerate(data.places):
        j = data.opposite(i)
        if j is None or j < i or place in have or data.driven[i] > 0.0 or data.driven[j] > 0.0:
            continue
        a, b = point.spectra[i], point.spectra[j]
        n = float(a.size / 2)
        rho = float(np.vdot(a, b) / np.sqrt(float(np.vdot(a, a)) * float(np.vdot(b, b))))
        rho -= point.weighing.paths.coherent(i, j)
        gain = -n * float(np.log(max(1 - rho**2, 1e-12)))
        p = float(min(1.0, chdtrc(1, 2 * gain) * len(data.places)))
        if p > LEVEL or abs(rho) < 0.02:
            continue
        power = {k: rho**2 * _variance(point, k) for k in (i, j)}
        sd = (1 - rho**2) / np.sqrt(2 * n)
        out.append(
            Suspect(
                "correlated_force", (place,), gain, 1, p, power, "other_bearing",
                f"the forces at {place} and {data.places[j]} share {100 * rho:.0f} %",
                {place: {"rho": Parameter(rho, float(sd), "1")}}, CATALOGUE["correlated_force"].distinguish,
                (float(5 / np.sqrt(2 * n)), "1"),
            )
        )  # fmt: skip
    return out
