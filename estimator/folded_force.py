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
answer the force no more as the mass does, and apart: two numbers more, odd in f, for M(rate - f) - M(rate + f). Taken
for what a sensor in time folds it left 22 % of a force.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from .transfer import Response

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]
WORTH = 40.0  # of chi square, that a fold is to explain
LEFT = 0.1  # of chi square beyond chance, that it may leave


def alike(hz: Array, rate_hz: float, mass: float, k: float, c: float) -> Complexes:
    """(f,) A(w')*, force per acceleration of what is folded."""
    was = 2 * np.pi * (rate_hz - hz)
    return np.asarray(mass - k / was**2 - c / (1j * was))


@dataclass(frozen=True, slots=True)
class Folded:
    """density : (cells,) PSD of the acceleration, 0 where none is seen. force : (cells,) that goes with it. likely :
    whether it is seen, or less sure than is asked for and likelier than noise of the sensor."""

    density: Array
    force: Complexes
    likely: bool


def folded(r: Response, back: Complexes, passed: Complexes, rate_hz: float) -> Folded:
    """back : (cells,) as `alike` gives it. passed : (2, cells) H(w')* / H(w) and H(w'') / H(w)."""
    from scipy.optimize import lsq_linear

    x, through = r.w / (2 * np.pi * rate_hz), np.abs(passed) ** 2
    even, odd = [(x**p, x**p) for p in (0, 2)], [(x**p, -(x**p)) for p in (1, 3)]
    sides = np.array(even if np.allclose(passed, 1.0) else even + odd)  # (numbers, 2, cells)

    def noise(density: Array) -> Complexes:
        return np.asarray(np.sum((r.A * through - back * passed.conj()) * density, axis=-2))

    weight = np.sqrt(r.n / (r.rr * r.aa))

    rotor = [r.aa / r.w**2, r.aa / (1j * r.w), r.A * r.aa, 1j * r.w * r.A * r.aa]  # of wrong k, c, gain and delay

    def fitted(*noise: Complexes) -> tuple[float, Array]:
        X = np.stack([*rotor, *noise], axis=1) * weight[:, None]
        X, y = np.concatenate([X.real, X.imag]), r.ra * weight
        scale = np.linalg.norm(X, axis=0)
        low = np.where(np.arange(scale.size) < len(rotor), -np.inf, 0.0)
        found = lsq_linear(X / scale, np.concatenate([y.real, y.imag]), bounds=(low, np.inf))
        return 2 * float(found.cost), found.x / scale

    before, _ = fitted()
    sensor, _ = fitted(r.A * r.noise)
    after, numbers = fitted(*noise(sides))
    if sensor - after < WORTH or after - 2 * r.n.size > LEFT * before:
        return Folded(np.zeros_like(r.w), back, bool(sensor > after and before - after > WORTH))
    density = np.maximum(np.tensordot(numbers[len(rotor) :], sides, 1), 0.0)
    seen = np.sum(through * density, axis=0)
    with np.errstate(invalid="ignore"):
        force = back * np.sum(passed.conj() * density, axis=0) / seen
    return Folded(seen, np.where(seen > 0.0, force, back), True)
