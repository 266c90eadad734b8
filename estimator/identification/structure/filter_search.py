"""The recorder's filter that explains the spectra of some places best: Fisher's scoring of the Whittle likelihood, over
the numbers of the filter and, at each place, S, the noise of its sensor, k and c.

A mean over a sample leaves a white acceleration white: what it takes towards the end of the band is what it folds back
there, and all that is seen of it low in the band may pass for noise. A sensor that resonates lets nothing through at
the images: its channel alone falls, and it is taken for another resonance than it is (5567 Hz and 11.3 for 5600 and 12,
c 9 % off). So what is undone of it is sought anew behind the filter. So is a colour of the force, which takes over most
of a slow fall (behind a Bessel filter a gain of 12 was 14.6 and S 17 % low); and pedestals at all caps (one of 0.45 kg
had 0.58). With them designs differ by few nats, and a number costs as many as Schwarz asks: by Akaike's two, ripples of
1.5 dB were found behind a filter without any. So does the noise of each sensor where all of it may be folded back:
behind a Bessel filter, what comes from about the rate passed for 4000 times the power of the noise that there was, and
of a common force it was not in common then.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.model.recorder import POWERS, Filter, images
from estimator.parallel import map_processes
from estimator.signals.filter_designs import chebyshev, designs

from . import pedestal_form
from .spectral_cells import SpectralCells
from .spectral_models import MAX_DIMMING_SHARE, coloured_power, resonant_power

MOST_MEANS = 8.0
FALLS_DB = (0.03, 0.1, 0.3, 1.0, 2.0, 4.0, 8.0, 16.0)  # at the end of the band, that searches for a design begin with
CHEBYSHEV_ORDERS, RIPPLES_DB, BAND_END_REL = (
    range(3, 9),
    (0.1, 0.7),
    np.linspace(0.55, 1.1, 12),
)  # of Chebyshev filters; top by cutoff
MOST_RIPPLE = 0.41  # 1.5 dB
CUTOFF_RANGE_REL = (0.1, 100.0)  # over the end of the band: what lies beyond is no recorder, or no filter
MOST_ECHO = 2.0  # of what a design folds back
MOST_FLAT = 1.0  # white, of what is folded back
MOST_KEPT = 0.25  # of the samples that poles worked on: beside a colour, half of them are like means over a sample
MIN_LIKELIHOOD_REL = 1e-3  # of a filter, over that of the best, to count in what is in doubt
DIGITAL_DESIGNS = 4  # designs, the likeliest, that are also tried on more samples than are kept
MOST_MOVED = 1.0  # of the logarithm of a number of a shape
DERIVATIVE_STEP = 1e-5  # change of a filter's number, for its derivative
MAX_STEPS, MIN_STEP_DEVIANCE = 60, 0.01  # at most; in deviance, that a step is to bring
NUMBERS_PER_PLACE = 4  # numbers of a place: ln S, noise, k and c
NO_NUMBERS: Array = np.zeros(0)


class Standing(NamedTuple):
    """A bearing on a pedestal, in the tangent: kL and c, and kg, Hz and damping of the pedestal."""

    kL: float
    c: float
    pedestal: tuple[float, float, float]

    def moved(self, w: Array, k: float, c: float, now: Array) -> tuple[Complexes, Complexes]:
        """(cells,) N/m that changes of kL and c and other numbers of the pedestal take from the bearing's stiffness
        beside these changes themselves, and the share of a change that is left of it."""
        D = self.kL + k + 1j * w * (self.c + c)
        lost = pedestal_form.stiffness_lost(w, self.kL + k, self.c + c, now)
        before = pedestal_form.stiffness_lost(w, self.kL, self.c, np.array(self.pedestal))
        return lost - before, np.asarray((1.0 - lost / D) ** 2)


@dataclass(frozen=True, slots=True)
class Seen:
    """Cells of a place, of the same frequencies at all. undone : Hz and quality of a resonance of the sensor that has
    been taken back; colour : gain and corner of that of the force. What these and the pedestal are behind the filter is
    found with it."""

    cells: SpectralCells
    kind: str
    undone: tuple[float, float] | None = None
    colour: tuple[float, float] | None = None
    standing: Standing | None = None

    @property
    def shapes(self) -> int:
        """How many numbers these have."""
        return 2 * (self.undone is not None) + 2 * (self.colour is not None) + 3 * (self.standing is not None)


@dataclass(frozen=True, slots=True)
class Way:
    """A kind of filter. made : of its numbers. first : where to begin. least, most : of each number. quiet : what looks
    like noise of the sensors is folded back."""

    made: Callable[[Array], Filter]
    first: tuple[tuple[float, ...], ...]
    least: tuple[float, ...]
    most: tuple[float, ...]
    quiet: bool = False


@dataclass(frozen=True, slots=True)
class Tried:
    """A way at the numbers where it explains most, those of Seen's shapes after them: as logarithms, over what they are
    thought to be. information : deviance, and what the way's own numbers cost. u : (places, OWN), those of the places.
    variance : of ln S, mean over the places, that the numbers of the filter and the shapes add."""

    information: float
    way: Way
    z: Array
    u: Array
    variance: float

    @property
    def noisy(self) -> int:
        """Places with noise."""
        return int(np.count_nonzero(self.u[:, 1]))

    @property
    def numbers(self) -> Array:
        """The way's own."""
        return self.z[: len(self.way.least)]

    def more(self, name: str, first: float, least: float, most: float, quiet: bool = False) -> Way:
        """The way with a number of Filter more."""
        way = self.way

        def made(z: Array) -> Filter:
            own: dict[str, Any] = {name: float(z[-1])}
            return replace(way.made(z[:-1]), **own)

        return Way(
            made=made,
            first=((*self.numbers.tolist(), first),),
            least=(*way.least, least),
            most=(*way.most, most),
            quiet=quiet,
        )


def likeliest(seen: Sequence[Seen], blank: Filter) -> tuple[float, Filter]:
    """Deviance, with what the numbers of the filter cost, behind the one that explains all best, and that filter: means
    over a sample, the poles of a design, before the samples or on more of them, means and poles, with what they fold
    back, more or less of it, also white, or a fall of any form that folds nothing back."""
    count = POWERS.size
    any_form = Way(
        made=lambda z: replace(blank, nepers=tuple(z.tolist())),
        first=((0.01,) * count,),
        least=(0.0,) * count,
        most=(np.inf,) * count,
    )
    ways = [any_form, *_ways(blank)]
    tried = sorted(map_processes([partial(_tried, seen, way) for way in ways], ways), key=lambda one: one.information)
    digital = [one.more("kept", 0.1, 0.0, MOST_KEPT) for one in tried if one.way.made(one.numbers).poles][
        :DIGITAL_DESIGNS
    ]
    tried += map_processes([partial(_tried, seen, way) for way in digital], digital)
    for further in _further(min(tried, key=lambda one: one.information)):
        tried.append(_tried(seen, further))
    best = min(tried, key=lambda one: one.information)
    off = best.way.made(best.numbers)
    if not off.nepers and best.noisy == len(seen):  # all that looks like noise may be folded back
        white = _tried(seen, best.more("flat", 0.01, 0.0, MOST_FLAT, quiet=True))
        tried.append(white)
        if white.information < best.information + _schwarz(seen) * (best.noisy - 1):
            best, off = white, white.way.made(white.numbers)
    return best.information, replace(off, doubt=_doubt(best, tried))


def mean_or_none(seen: Sequence[Seen], blank: Filter) -> tuple[float, float]:
    """Deviance that a mean over a sample explains of what is behind no filter, and the relative standard deviation that
    S has about that behind none, by what both are worth: low in the band such a mean looks like noise of the sensors.
    """
    none = _tried(seen, Way(made=lambda z: replace(blank, nepers=(0.0,) * POWERS.size), first=((),), least=(), most=()))
    mean = _tried(seen, next(_ways(blank)))
    return none.information - mean.information, _doubt(none, (none, mean))


def _doubt(taken: Tried, tried: Sequence[Tried]) -> float:
    """Relative standard deviation that S has about that of one filter, by what all are worth, and by their numbers."""
    total, doubt, least = 0.0, 0.0, min(one.information for one in tried)
    for one in tried:
        worth = float(np.exp(0.5 * (least - one.information)))
        if worth > MIN_LIKELIHOOD_REL:
            total += worth
            doubt += worth * (float(np.mean(one.u[:, 0] - taken.u[:, 0])) ** 2 + one.variance)
    return float(np.sqrt(doubt / total))


def _ways(blank: Filter) -> Iterator[Way]:
    """Filters of one or two numbers."""

    lowest, highest = np.log(np.array(CUTOFF_RANGE_REL) * blank.top_hz).tolist()

    def poles(name: str, own: tuple[float, ...], z: Array) -> Filter:
        return replace(blank, poles=own, name=name, cutoff_hz=float(np.exp(z[0])))

    def rippled(order: int, z: Array) -> Filter:
        return poles(f"Chebyshev filter of order {order}", chebyshev(order, float(z[1])), z)

    yield Way(
        made=lambda z: replace(blank, means=float(z[0])), first=((1.0,), (3.0,)), least=(0.0,), most=(MOST_MEANS,)
    )
    for name, own in designs().items():
        cutoffs = np.log(blank.top_hz) - 0.5 * np.log(_squares(own))
        yield Way(
            made=partial(poles, name, own),
            first=tuple((z,) for z in cutoffs.tolist()),
            least=(lowest,),
            most=(highest,),
        )
    for order in CHEBYSHEV_ORDERS:
        first = [(float(np.log(blank.top_hz / x)), 10 ** (dB / 10) - 1) for x in BAND_END_REL for dB in RIPPLES_DB]
        yield Way(made=partial(rippled, order), first=tuple(first), least=(lowest, 0.0), most=(highest, MOST_RIPPLE))


def _further(found: Tried) -> Iterator[Way]:
    """The filter found with a number more: means behind its poles; another share of what it folds back."""
    off = found.way.made(found.numbers)
    if off.poles:
        yield found.more("means", 0.5, 0.0, MOST_MEANS)
    if not off.nepers:
        yield found.more("echo", 1.0, 1 / MOST_ECHO, MOST_ECHO)


def _squares(poles: tuple[float, ...]) -> Array:
    """Squares of frequency over cutoff at which a design takes each of FALLS_DB."""
    x2 = np.geomspace(1e-4, 1e2, 600)
    return np.asarray(np.interp(FALLS_DB, 10 * np.log10(np.polyval([*poles[::-1], 1.0], x2)), x2))


def _tried(seen: Sequence[Seen], way: Way) -> Tried:
    shapes = sum(own.shapes for own in seen)
    price = _schwarz(seen) if shapes else 2.0
    still = [0.0] * shapes
    first = [np.array([*z, *still]) for z in way.first]
    begun = [_begun(seen, way, z) for z in first]
    k = min(range(len(begun)), key=lambda k: begun[k][0])
    deviance, z, u, variance = _scored(seen, way, first[k], begun[k][1])
    return Tried(information=deviance + price * len(way.least), way=way, z=z, u=u, variance=variance)


def _schwarz(seen: Sequence[Seen]) -> float:
    """What a number costs in deviance."""
    return float(np.log(sum(own.cells.n.size for own in seen)))


def _begun(seen: Sequence[Seen], way: Way, z: Array) -> tuple[float, Array]:
    """Deviance and numbers (places, OWN) at the model's own k and c."""
    deviance, out = 0.0, np.zeros((len(seen), NUMBERS_PER_PLACE))
    for own, at, (passed, back, _) in zip(seen, out, _effects(seen, way, z), strict=True):
        c = own.cells
        X, m = np.stack([c.force_shape * passed + back, c.noise_gain]), c.power
        S = N = 0.0
        for _ in range(3):
            W = c.n / m**2
            (a, b), (_, d) = (X * W) @ X.T
            e, f = (X * W) @ c.power
            S, N = (d * e - b * f) / (a * d - b * b), (a * f - b * e) / (a * d - b * b)
            if N <= 0.0 or way.quiet:
                S, N = e / a, 0.0
            elif S <= 0.0:
                S, N = 1e-6 * e / a, f / d
            m = S * X[0] + N * X[1]
        at[:2] = np.log(S), N
        deviance += _deviance(c, m)
    return deviance, out


def _effects(seen: Sequence[Seen], way: Way, z: Array) -> list[tuple[Array, Array, Array]]:
    """By place (cells,) of power that a filter lets through, PSD over S of the force that it folds back, and numbers of
    its pedestal."""
    count = len(way.least)
    off, factors = way.made(z[:count]), iter(np.exp(z[count:]).tolist())
    hz = seen[0].cells.w / (2 * np.pi)
    passed, echoes = off.passed(hz), {kind: off.echoes(hz, kind) for kind in {own.kind for own in seen}}

    def moved(*numbers: float) -> Array:
        return np.array([number * next(factors) for number in numbers])

    out = []
    for own in seen:
        through, beyond = passed, echoes[own.kind]
        if own.undone is not None:
            now, was = moved(*own.undone), resonant_power(hz, *own.undone)
            through = through * resonant_power(hz, *now) / was
            beyond = beyond * resonant_power(images(off.rate_hz, hz)[: len(beyond)], *now) / was
        if own.colour is not None:
            gain, corner = own.colour
            now = moved(gain + MAX_DIMMING_SHARE, corner) - [MAX_DIMMING_SHARE, 0.0]
            through = through * coloured_power(hz, *now) / coloured_power(hz, gain, corner)
        pedestal = NO_NUMBERS if own.standing is None else moved(*own.standing.pedestal)
        here, others = own.cells.white
        out.append((through, beyond.sum(axis=0) * here + echoes[own.kind].sum(axis=0) * others, pedestal))
    return out


def _deviance(c: SpectralCells, m: Array) -> float:
    ratio = c.power / m
    return float(2 * c.n @ (ratio - 1 - np.log(ratio)))


def _spectrum(own: Seen, u: Array, passed: Array, back: Array, pedestal: Array = NO_NUMBERS) -> tuple[Array, Array]:
    """(cells,) model, as Cells.spectrum, and (OWN, cells) its derivatives. pedestal : its numbers, if there is one."""
    c, S, (noise, k, d) = own.cells, np.exp(u[0]), u[1:]
    A, left = c.tangent(np.concatenate([u[:2], [k, d]])), np.ones(c.w.size, np.complex128)
    if own.standing is not None:
        lost, left = own.standing.moved(c.w, k, d, pedestal)
        A = A + lost / c.w**2
    inferred, of = np.abs(c.A) ** 2, np.abs(A) ** 2
    force = S * c.force_shape * passed + np.abs(A - c.A) ** 2 * c.others
    white = S * (c.force_shape * passed * inferred / of + back)

    def slope(dA: Array | Complexes) -> Array:
        off = c.others * np.real((A - c.A).conj() * dA) - force * np.real(A.conj() * dA) / of
        return np.asarray(2 * off * inferred / of)

    m = white + (force - S * c.force_shape * passed) * inferred / of + noise * c.noise_gain
    return m, np.stack([white, c.noise_gain, slope(-left / c.w**2), slope(left / (1j * c.w))])


def _scored(seen: Sequence[Seen], way: Way, z: Array, u: Array) -> tuple[float, Array, Array, float]:
    """Least deviance and the numbers of the filter and of the places (places, OWN) there, from some start: Levenberg
    and Marquardt's steps in Fisher's information; and the variance of Tried."""
    q, size = len(z), len(z) + u.size
    far = np.full(q - len(way.least), MOST_MOVED)
    least = np.concatenate([way.least, -far, np.tile([-np.inf, 0.0, -np.inf, -np.inf], len(seen))])
    most = np.concatenate([way.most, far, np.tile([np.inf, 0.0 if way.quiet else np.inf, np.inf, np.inf], len(seen))])

    def of(x: Array) -> float:
        total = 0.0
        for own, at, there in zip(seen, x[q:].reshape(-1, NUMBERS_PER_PLACE), _effects(seen, way, x[:q]), strict=True):
            total += _deviance(own.cells, np.maximum(_spectrum(own, at, *there)[0], 1e-300))
        return total

    x, cautious = np.concatenate([z, u.ravel()]), 1e-3
    now = of(x)
    for _ in range(MAX_STEPS):
        H, g = np.zeros((size, size)), np.zeros(size)
        here, *moved = (_effects(seen, way, x[:q] + DERIVATIVE_STEP * one) for one in np.eye(q + 1, q, -1))
        for i, own in enumerate(seen):
            c, at = own.cells, q + NUMBERS_PER_PLACE * i + np.arange(NUMBERS_PER_PLACE)
            m, J = _spectrum(own, x[at], *here[i])
            whole = np.zeros((q + NUMBERS_PER_PLACE, m.size))
            whole[q:] = J
            for row, other in zip(whole, moved, strict=False):
                row[:] = (_spectrum(own, x[at], *other[i])[0] - m) / DERIVATIVE_STEP
            index = np.concatenate([np.arange(q), at])
            whole /= np.maximum(m, 1e-300)
            H[index[:, None], index] += (whole * c.n) @ whole.T
            g[index] += whole @ (c.n * (c.power / np.maximum(m, 1e-300) - 1))
        free = ~(((x <= least) & (g < 0)) | ((x >= most) & (g > 0)))
        scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        scaled = H * np.multiply.outer(scale, scale)
        gained = -np.inf
        while cautious < 1e6:
            step = np.zeros(size)
            step[free] = np.linalg.solve((scaled + cautious * np.eye(size))[np.ix_(free, free)], (g * scale)[free])
            new = np.clip(x + step * scale, least, most)
            gained = now - of(new)
            if gained > -1e-9:
                break
            cautious *= 10
        if gained < -1e-9:
            break
        x, now, cautious = new, now - gained, cautious / 10
        if gained < MIN_STEP_DEVIANCE:
            break
    return now, x[:q], x[q:].reshape(-1, NUMBERS_PER_PLACE), _variance(scaled, scale, free, q)


def _variance(scaled: Array, scale: Array, free: NDArray[np.bool_], q: int) -> float:
    """Mean variance of ln S less that of q known numbers. scaled : information about numbers over scale."""
    if not np.isfinite(scaled).all():
        return np.inf

    def variances(known: NDArray[np.bool_]) -> Array:
        told = np.flatnonzero(free & ~known)
        out = np.zeros(free.size)
        out[told] = np.diag(np.linalg.pinv(scaled[np.ix_(told, told)], rcond=1e-12, hermitian=True)) * scale[told] ** 2
        return out[q::NUMBERS_PER_PLACE]

    filters = np.arange(free.size) < q
    return float(np.mean(np.maximum(variances(np.zeros_like(filters)) - variances(filters), 0.0)))
