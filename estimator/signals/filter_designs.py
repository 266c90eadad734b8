"""Poles of the low-pass filters that are built: |H|^2 = 1 / (1 + b1 x^2 + b2 x^4 + ...), x the frequency by the cutoff.

As scipy.signal.bessel, butter and cheby1, which take 0.5 s to import.
"""

from __future__ import annotations

from functools import cache
from math import factorial

import numpy as np


def designs() -> dict[str, tuple[float, ...]]:
    """b1, b2, ... by name, 3 dB down at the cutoff."""
    made = {f"Bessel filter of order {n}": bessel(n) for n in (2, 3, 4, 5, 6, 8, 10)}
    return made | {f"Butterworth filter of order {n}": (0.0,) * (n - 1) + (1.0,) for n in (1, 2, 3, 4, 5, 6, 8)}


def chebyshev(order: int, ripple: float) -> tuple[float, ...]:
    """b1, b2, ... of type I: 1 + ripple T(x)^2 over its value at zero, T the polynomial. The cutoff is the end of the
    ripples, of 10 log10(1 + ripple) dB."""
    square = _chebyshev(order)
    return tuple(ripple * own / (1 + ripple * square[0]) for own in square[1:])


@cache
def _chebyshev(order: int) -> tuple[float, ...]:
    """Of x^0, x^2, x^4, ... in the square of Chebyshev's polynomial."""
    T = np.polynomial.chebyshev.cheb2poly([0.0] * order + [1.0])
    return tuple(np.convolve(T, T)[::2].tolist())


def bessel(order: int) -> tuple[float, ...]:
    """b1, b2, ...: the reverse Bessel polynomial of i x, squared."""
    n = order
    theta = [factorial(2 * n - k) / (2 ** (n - k) * factorial(k) * factorial(n - k)) for k in range(n + 1)]
    signed = [a * (-1) ** (k // 2) for k, a in enumerate(theta)]
    even, odd = signed[::2], signed[1::2]  # in x^2: the real part, and the imaginary part over x
    square = np.zeros(n + 1)
    square[: 2 * len(even) - 1] += np.convolve(even, even)
    square[1 : 2 * len(odd)] += np.convolve(odd, odd)
    square /= square[0]
    half = np.roots([*square[:0:-1], -1.0])  # where |H|^2 is a half: one root is positive, as every b is
    cutoff = float(half.real[(np.abs(half.imag) < 1e-9 * np.abs(half.real)) & (half.real > 0.0)][0])
    return tuple((square[1:] * cutoff ** np.arange(1, n + 1)).tolist())
