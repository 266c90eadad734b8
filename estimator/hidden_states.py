"""Forces with memory along a motion, and what they answer to it in the mean."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .effect import Effect
from .effects.compiled import memory_array

Array = NDArray[np.float64]


def remember(effect: Effect, p: Array, lin: Array, x: Array, v: Array, rate_hz: float) -> Array:
    """(n,) N of a force with memory, its states integrated at four times the rate (slip is faster than the samples)."""
    return memory_array(effect, p, lin, np.ascontiguousarray(x), np.ascontiguousarray(v), rate_hz, finer=4)


def mean_response(
    effect: Effect, p: Array, lin: Array, x: Array, v: Array, f: Array, rate_hz: float, f_hz: Array
) -> NDArray[np.complex128]:
    """(bins,) N/m at f_hz, ascending over the band: mean linear response of a force f (n,) with memory to a small
    motion added to x and v.

    A small white displacement e is added and the change of the force regressed on e passed through causal first-order
    lags: T = b0 + b1 i w + sum b_k i w / (i w + 1 / tau_k). It is what F and the force share under the model (Novikov),
    whatever the amplitude distribution.
    """
    n = min(x.size, 1 << 17)
    x, v, f = x[:n], v[:n], f[:n]
    w = 2 * np.pi * np.fft.rfftfreq(n, 1 / rate_hz)
    spectrum = np.random.default_rng(1).standard_normal((2, w.size))
    inside = (w > np.pi * f_hz[0]) & (w < 2 * np.pi * f_hz[-1])
    e = np.where(inside, spectrum[0] + 1j * spectrum[1], 0.0) / np.sqrt(1 + (w / _peak(x, v)) ** 2)
    size = 0.05 * float(x.std()) / float(np.fft.irfft(e, n).std())
    e *= size
    df = remember(effect, p, lin, x + np.fft.irfft(e, n), v + np.fft.irfft(1j * w * e, n), rate_hz) - f
    taus = np.array([0.1, 0.4, 1.6, 6.4]) / _peak(x, v)

    def basis(w: NDArray[np.floating]) -> NDArray[np.complex128]:
        return np.stack([np.ones(w.size), 1j * w, *(1j * w / (1j * w + 1 / tau) for tau in taus)])

    skip = n // 20  # the two runs start alike
    B = np.stack([np.fft.irfft(b * e, n)[skip:] for b in basis(w)])
    d = np.sqrt(np.sum(B * B, axis=1))
    weights = np.linalg.lstsq((B @ B.T) / np.multiply.outer(d, d), (B @ df[skip:]) / d, rcond=1e-8)[0] / d
    return np.asarray(weights @ basis(2 * np.pi * f_hz))


def _peak(x: Array, v: Array) -> float:
    return float(v.std() / x.std())
