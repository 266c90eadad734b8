"""What sampling folds back into a measured force and into its motion alike.

What is seen at w was force and motion at w' = 2 pi rate - w, backwards, behind the same filter. What is folded into
the force is A(w')* n, about m n, n what is into the acceleration, and the inferred force is left with B n,
B = A(w) - A(w')*. Little of it is seen where only the mass answers; below the resonance it is k / w^2 times n, and
rules what is left of the force.

It is told from all that may bend the path by its coherence with the motion that was measured, E[r a*] = B M, M the
density of n: what a wrong k, c or A leaves there is as the motion is, w^4 at low frequencies, and a law under Gaussian
motion leaves nothing that follows it (Bussgang). From both sides of the rate comes M(rate - f) + M(rate + f), which is
even in f: two numbers are enough, behind any filter.
"""

from __future__ import annotations

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


def folded(r: Response, back: Complexes, rate_hz: float) -> Array:
    """(cells,) PSD of the acceleration that is folded, 0 where none is seen. back : (cells,) as `alike` gives it."""
    from scipy.optimize import lsq_linear

    B, x2 = r.A - back, (r.w / (2 * np.pi * rate_hz)) ** 2
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
    after, numbers = fitted(B, B * x2)
    if sensor - after < WORTH or after - 2 * r.n.size > LEFT * before:
        return np.zeros_like(r.w)
    return np.asarray(numbers[-2] + numbers[-1] * x2)
