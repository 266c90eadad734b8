"""Regressors of the black box with their tangents, and second-order corrections where the stiffness fluctuates."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.likelihood.response.fluctuation import Fluctuation

Float32Series = NDArray[np.float32]
Derived = tuple[Float32Series, *tuple[Float32Series | float, ...]]  # a regressor (n,) and its derivatives


def level_regressors(u: Float32Series, w: Float32Series) -> list[Derived]:
    """Products of u and w, and of each with r = |(u, w)|, with their derivatives by u and w."""
    r = np.asarray(np.maximum(np.hypot(u, w), 1e-6), u.dtype)
    return [
        (u * w, w, u), (u * u * w, 2 * u * w, u * u), (u * w * w, w * w, 2 * u * w),
        (r * u, r + u * u / r, u * w / r), (r * w, u * w / r, r + w * w / r),
    ]  # fmt: skip


def legendre_in_time(t: Array, first: float, last: float) -> tuple[Array, Array]:
    """Legendre polynomials of degree 1 and 2 of time t (n,) s, from first to last."""
    tau = 2 * (t - first) / max(last - first, 1e-9) - 1
    return tau, 1.5 * tau**2 - 0.5


def shaft_waves(phase: Array, orders: tuple[float, ...]) -> list[NDArray[np.float32]]:
    """Cosine and sine of each order of the shaft angle (n,) rad."""
    turns = phase / (2 * np.pi)
    angles = [2 * np.pi * (k * turns - np.floor(k * turns)) for k in orders]
    return [wave(z.astype(np.float32)) for z in angles for wave in (np.cos, np.sin)]


def second_order_tangents(
    name: str, here: Fluctuation, sizes: Array, knots: Array | None, orders: tuple[float, ...],
    times: tuple[float, float],
) -> Iterator[Complexes]:  # fmt: skip
    """(bins,) N/m correction of each regressor of a group, in its order; nothing for groups without a correction.

    sizes : (2,) rms of displacement and velocity. knots : of a group of hat functions. orders, times : of groups that
    vary with shaft angle or time.
    """
    x, v = (
        (here.data.denoised_displacement if knots is None else here.data.displacement)(here.place),
        here.data.v[here.place],
    )
    if knots is not None:
        which = 0 if name == "displacement" else 1
        step, last = float(knots[1] - knots[0]), knots.size - 2
        cell = np.clip(((x, v)[which] - knots[0]) // step, 0, last).astype(np.int8)
        inside = np.zeros((2, x.size), np.float32)
        below: Complexes | float = 0.0
        for k in range(knots.size):
            own: Complexes | float = 0.0
            if k <= last:
                np.equal(cell, k, out=inside[which])
                own = here.of(inside) / step
            yield np.asarray(below - own)
            below = own
    elif name == "level":
        for _, *by in level_regressors(x / sizes[0], v / sizes[1]):
            yield here.of(np.stack([z / size for z, size in zip(by, sizes, strict=True)]))
    elif name == "time":
        none = np.zeros(x.size)
        for z in legendre_in_time(here.data.t, *times):
            yield here.of(np.stack([z / sizes[0], none]))
            yield here.of(np.stack([none, z / sizes[1]]))
    elif name == "shaft_angle":
        for wave in shaft_waves(here.data.phase, orders):
            yield here.of(np.stack([wave / sizes[0], np.zeros(x.size)]))
