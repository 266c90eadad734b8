"""What sampling folds back into a measured force and into its motion alike.

What is seen at w was force and motion at w' = 2 pi rate - w, backwards, behind the same filter. What is folded into
the force is A(w')* n, about m n, n what is into the acceleration, and the inferred force is left with B n,
B = A(w) - A(w')*. Little of it is seen where only the mass answers; below the resonance it is k / w^2 times n, and
rules what is left of the force.

It is told from all that may bend the path by its coherence with the motion that was measured, E[r a*] = B M, M the
density of n: what a wrong k, c or A leaves there is as the motion is, w^4 at low frequencies, and a law under Gaussian
motion leaves nothing that follows it (Bussgang). From both sides of the rate comes M(rate - f) + M(rate + f), which is
even in f: two numbers are enough, behind any filter.

Of a sensor of motion whose response H is undone, what is folded went through it at the image: n = H(w')* / H(w) a(w')*
and, from beyond the rate, H(w'') / H(w) a(w''). A delay of 0.8 samples turns the two by +-293 degrees, so that they
answer the force no more as the mass does, and apart: three numbers, for the two to differ as behind a filter that
falls, sums of M(rate + u) = u^p (1 - 2 u)^k, positive on either side. Taken for what a sensor in time folds it left
22 % of a force. H of a velocity is 1 / iw: the two have other signs, and what of the force is in neither (Folded.apart)
is noise of its sensor.

A delay that nobody knows of turns them as well, by 18 degrees for 0.05 samples, and the path to the motion by 6 at the
end of the band: a = e^-iws a' + n, E[r a*] = A (1 - e^iws) |a|^2 + e^iws A M - E[f n*]. Where one in time does not
explain what is left, the delay is the one by which it is explained best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.arrays import Array, Complexes

from .path_spectra import Folded, PathSpectra

MIN_CHI2 = 40.0  # of chi square, that a fold is to explain, or a delay of it
MIN_CHI2_LIKELIER = 10.0  # of chi square
MAX_CHI2_LEFT_SHARE = 0.1  # of chi square beyond chance, that it may leave
MAX_LATE_SAMPLES, LATE_STEP_SAMPLES, LATE_TOLERANCE_SAMPLES = (
    3.0,
    0.25,
    1e-3,
)  # samples by which a sensor is sought to be late, either way, and how near
DENSITY_IN_TIME = (
    ((0, 0), (2, 0)),
)  # p, k of the density, one set of several: from both sides of the rate alike; and not,
DENSITIES_APART = (((0, 2), (0, 4), (0, 6)), ((2, 0), (2, 1), (2, 3)))  # behind poles, and behind a mean over a sample


def aliased_tangent(hz: Array, rate_hz: float, mass: float, k: float, c: float) -> Complexes:
    """(f,) A(w')*, force per acceleration of what is folded."""
    was = 2 * np.pi * (rate_hz - hz)
    return np.asarray(mass - k / was**2 - c / (1j * was))


def images(w: Array, rate_hz: float) -> Array:
    """(2, cells) rad/s of what is folded to w (cells,), from below and from beyond the rate."""
    return np.asarray(2 * np.pi * rate_hz + np.stack([-w, w]))


@dataclass(frozen=True, slots=True)
class Coherence:
    """What of E[r a*] may be explained, by sensors that are late by so much, s. back, passed : as `folded` has them.

    x : (cells,) frequency over the rate; beyond : (2, cells) rad/s by which a delay turns what was below the rate, and
    beyond; rotor : (4, cells) by a wrong k, c, gain and delay."""

    r: PathSpectra
    back: Complexes
    passed: Complexes
    rate_hz: float
    x: Array
    beyond: Array
    rotor: Complexes

    def weight(self, late: float) -> Array:
        """Where the delay is undone; with one that is not, what is left is nothing but that at high frequencies."""
        r = self.r
        off = r.A * (np.exp(1j * r.w * late) - 1)
        left = r.rr + 2 * np.real(off.conj() * r.ra) + np.abs(off) ** 2 * r.aa
        return np.asarray(np.sqrt(r.n / (np.maximum(left, 1e-9 * r.rr) * r.aa)))

    def by(self, late: float, weight: Array, *noise: Complexes) -> tuple[float, Array]:
        """Chi square that the rotor and noises, (cells,) each and none negative, leave; how much there is of these."""
        from scipy.optimize import nnls

        r = self.r
        turn, free = np.exp(1j * r.w * late), self.rotor[:3] if late else self.rotor  # what is late is all as late
        X = np.stack([*(turn * free), *noise, r.ra - r.A * (1 - turn) * r.aa], axis=1) * weight[:, None]
        X = np.concatenate([X.real, X.imag])
        scale = np.linalg.norm(X, axis=0)
        R = np.asarray(np.linalg.qr(X / scale, mode="r"))[len(free) :, len(free) :]
        x, off = nnls(R[:, :-1], R[:, -1]) if noise else (np.zeros(0), float(np.linalg.norm(R)))
        return (off * scale[-1]) ** 2, x * scale[-1] / scale[len(free) : -1]

    def by_sensor(self, late: float, weight: Array) -> float:
        """Chi square that noise of the sensor leaves."""
        return self.by(late, weight, self.r.A * np.exp(1j * self.r.w * late) * self.r.noise)[0]

    def by_fold(
        self, late: float, weight: Array, sets: Sequence[Sequence[tuple[int, int]]] = DENSITIES_APART
    ) -> tuple[float, Folded]:  # fmt: skip
        """Chi square that what is folded back leaves, and that: of the first set, unless another is much likelier."""
        first, *others = (self._by_fold(late, weight, shapes) for shapes in sets)
        other = min(others, key=lambda found: found[0], default=first)
        return other if other[0] < first[0] - MIN_CHI2_LIKELIER else first

    def _by_fold(self, late: float, weight: Array, shapes: Sequence[tuple[int, int]]) -> tuple[float, Folded]:
        r, x, back = self.r, self.x, self.back
        through = self.passed * np.exp(1j * late * self.beyond) if late else self.passed
        sides = np.array([(x**p * (1 + 2 * x) ** k, x**p * (1 - 2 * x) ** k) for p, k in shapes])
        path = r.A * np.exp(1j * r.w * late) * np.abs(through) ** 2 - back * through.conj()
        left, numbers = self.by(late, weight, *np.sum(path * sides, axis=1))
        density = np.abs(through) ** 2 * np.tensordot(numbers, sides, 1)
        return left, Folded(density=density, passed=through, undone=self.passed, back=back, likely=True)

    def likeliest(self, about: float, weight: Array) -> float:
        """s by which a sensor is late, near one that is about right."""
        from scipy.optimize import minimize_scalar

        step = LATE_STEP_SAMPLES / self.rate_hz
        found = minimize_scalar(
            lambda late: self.by_fold(late, weight)[0], bounds=(about - step, about + step),
            method="bounded", options={"xatol": LATE_TOLERANCE_SAMPLES / self.rate_hz},
        )  # fmt: skip
        return float(found.x)


def folded(r: PathSpectra, back: Complexes, passed: Complexes, rate_hz: float, late: bool = False) -> Folded:
    """back : (cells,) as `alike` gives it. passed : (2, cells) H(w')* / H(w) and H(w'') / H(w). late : of a sensor that
    is late by more than is undone; nothing where that explains no more."""
    rotor = np.stack([r.aa / r.w**2, r.aa / (1j * r.w), r.A * r.aa, 1j * r.w * r.A * r.aa])
    beyond = images(r.w, rate_hz) * [[1], [-1]]
    c = Coherence(r, back, passed, rate_hz, r.w / (2 * np.pi * rate_hz), beyond, rotor)

    def told(before: float, sensor: float, after: float) -> bool:
        return sensor - after >= MIN_CHI2 and after - 2 * r.n.size <= MAX_CHI2_LEFT_SHARE * before

    now = c.weight(0.0)
    before, sensor = c.by(0.0, now)[0], c.by_sensor(0.0, now)
    after, fold = c.by_fold(0.0, now, DENSITY_IN_TIME if np.allclose(passed, 1.0) else DENSITIES_APART)
    likely, rival = sensor > after and before - after > MIN_CHI2, None
    if (
        abs(sensor - after) < MIN_CHI2
        and before - after > MIN_CHI2_LIKELIER
        and after - 2 * r.n.size <= MAX_CHI2_LEFT_SHARE * before
    ):
        rival = fold.density
    nothing = replace(fold, density=np.zeros_like(fold.density), likely=likely, rival=rival)
    if not late:
        return fold if told(before, sensor, after) else nothing
    if before - min(sensor, after) < MIN_CHI2:
        return nothing
    grid = np.arange(-MAX_LATE_SAMPLES, MAX_LATE_SAMPLES + LATE_STEP_SAMPLES, LATE_STEP_SAMPLES) / rate_hz
    about = c.likeliest(min(grid, key=lambda late: c.by_fold(late, now)[0]), now)
    then = c.weight(about)
    by = c.likeliest(about, then)
    left, turned = c.by_fold(by, then)
    more = after - c.by_fold(by, now)[0] >= MIN_CHI2
    return turned if more and told(c.by(by, then)[0], c.by_sensor(by, then), left) else nothing


def of_late_sensor(r: PathSpectra, rate_hz: float) -> PathSpectra | None:
    """The spectra for a sensor with a further delay, which is fitted; None where a delay explains no more."""
    if r.fold is None:
        return None
    bare = r.bare or r
    fold = folded(bare, r.fold.back, r.fold.undone, rate_hz, late=True)
    return bare.less(fold) if fold.density.any() else None
