"""A cap under a known force, made bin by bin in the frequency domain: no integrator, no filter, no start."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from estimator.model.rig import Channel, Model

Array = NDArray[np.float64]
RATE, MASS, KL, C, S = 25600.0, 0.2, 1e7, 60.0, 9e-5
RIG = Model(
    (Channel("a", "bearing1", "x"), Channel("f", "bearing1", "x", "force")), (150.0, 8000.0), "none", {"bearing1": MASS}
)


def record(
    seconds: float = 6.0,
    seed: int = 0,
    *,
    pedestal: tuple[float, float, float] | None = None,
    sensor: Callable[[Array], Array] = lambda y: y,
    noise: tuple[float, float] = (0.02, 1e-3),
    force: Callable[[Array], Array] | None = None,
    unseen: Callable[[Array], Array] | None = None,
) -> Array:
    """(n, 2) acceleration and force. pedestal : mass, Hz, damping ratio. sensor : of the samples of the acceleration.

    noise : rms of both. force, unseen : N at t (n,), added to the white force, and to what the channel does not see.
    """
    rng = np.random.default_rng(seed)
    n = round(seconds * RATE)
    t = np.arange(n) / RATE
    f = rng.normal(size=n) * np.sqrt(S * RATE / 2) + (0.0 if force is None else force(t))
    w = 2 * np.pi * np.fft.rfftfreq(n, 1 / RATE)
    D = KL + 1j * w * C
    if pedestal is not None:
        M, w0, zeta = pedestal[0], 2 * np.pi * pedestal[1], pedestal[2]
        below = M * (w0**2 - w**2 + 2j * zeta * w * w0)
        D = D * below / (D + below)  # in series
    whole = f + (0.0 if unseen is None else unseen(t))
    a = np.fft.irfft(-(w**2) / (D - MASS * w**2) * np.fft.rfft(whole), n)
    return np.stack([sensor(a), f], axis=1) + rng.normal(size=(n, 2)) * noise
