"""A rig to test the estimators on, integrated by a scheme that shares nothing with the package: RK4 at 10 steps a
sample, force held over a step, Kaiser decimation, quantised counts."""

from __future__ import annotations

from functools import cache

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.signal import firwin, oaconvolve

from estimator.model.rig import Channel, EffectUse, Model, Shaft
from estimator.model.rotor import shaft_matrix

PLACES = ("bearing1.x", "bearing1.y", "bearing2.x", "bearing2.y")
RATE = 25600.0
MASS, DISC, SHAFT, SHAFT_DAMPING = 0.2, 0.515, 155e3, 0.5
TRUTH = {
    "kL": np.array([10e6, 9.2e6, 11e6, 10.4e6]),
    "c": np.array([60.0, 55.0, 65.0, 58.0]),
    "S": np.array([9e-5, 9e-5, 8e-5, 8e-5]),
}
# columns of the hidden forces: kNL x^3, fc sgn v, cq v|v|, cx x^2 v, k (|x| - g)_+ sgn x (two), kc (-+ other x)
CUBIC, COULOMB, QUADRATIC_DAMPING, DISPLACEMENT_DAMPING, CLEARANCE, GAP, CROSS = range(7)


def rig_model(*effects: str, band: tuple[float, float] = (150.0, 8000.0), **changes: object) -> Model:
    """The model with the given catalogue effects at every place, nothing known but masses and shaft."""
    channels = tuple(Channel(f"b{p[7]}{p[-1]}", *p.split(".")) for p in PLACES)
    uses = tuple(EffectUse(e, {p: {} for p in PLACES}) for e in effects)
    fields: dict[str, object] = {
        "shaft": "chain",
        "mass": {"disc": DISC, "bearing1": MASS, "bearing2": MASS},
        "shaft_stiffness": SHAFT,
        "shaft_damping": SHAFT_DAMPING,
        "effects": uses,
    }
    return Model(channels, band, **(fields | changes))  # type: ignore[arg-type]


@njit(cache=True)
def _accelerate(x, v, F, k, c, H, a):  # type: ignore[no-untyped-def]
    for i in range(4):
        d, o, s = 4 + i % 2, i ^ 1, 1.0 - 2.0 * (i % 2)
        r = F[i] - k[i] * x[i] - c[i] * v[i] - H[i, 0] * x[i] ** 3 - H[i, 2] * v[i] * abs(v[i])
        r -= H[i, 3] * x[i] * x[i] * v[i] + H[i, 1] * np.sign(v[i]) + s * H[i, 6] * x[o]
        r -= H[i, 4] * max(abs(x[i]) - H[i, 5], 0.0) * np.sign(x[i])
        a[i] = (r - SHAFT * (x[i] - x[d]) - SHAFT_DAMPING * (v[i] - v[d])) / MASS
    for q in range(2):
        f = 0.0
        for i in (q, q + 2):
            f += SHAFT * (x[i] - x[4 + q]) + SHAFT_DAMPING * (v[i] - v[4 + q])
        a[4 + q] = f / DISC


@njit(cache=True)
def _integrate(F, x, v, h, k, c, H, out):  # type: ignore[no-untyped-def]
    a1, a2, a3, a4 = np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6)
    for n in range(F.shape[0]):
        _accelerate(x, v, F[n], k, c, H, a1)
        v2 = v + 0.5 * h * a1
        _accelerate(x + 0.5 * h * v, v2, F[n], k, c, H, a2)
        v3 = v + 0.5 * h * a2
        _accelerate(x + 0.5 * h * v2, v3, F[n], k, c, H, a3)
        v4 = v + h * a3
        _accelerate(x + h * v3, v4, F[n], k, c, H, a4)
        for i in range(4):
            out[n, i] = (a1[i] + 2 * a2[i] + 2 * a3[i] + a4[i]) / 6
        x += h / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)


@cache
def _taps(steps: int) -> NDArray[np.float64]:
    return np.asarray(firwin(40 * steps + 1, 11300.0, fs=RATE * steps, window=("kaiser", 9.0)))


def rig_record(
    seconds: float,
    seed: int,
    kNL: float = 1.3e18,
    hidden: NDArray[np.float64] | None = None,
    level: float = 1.0,
    growth: float = 1.0,
    noise: float = 0.02,
    step: float = 490.5 / 32768,
    steps: int = 10,
    change: tuple[float, NDArray[np.float64]] | None = None,
    tones: tuple[tuple[float, float], ...] = (),
    run_up: tuple[float, float, float] | None = None,
) -> NDArray[np.float64]:
    """(n, 4) m/s^2. hidden : (4, 7) see above; level : factor on the force; step : of the quantiser.

    growth : of the force's rms, at the end over the start, steadily.
    change : (s, (4,) N/m) when the stiffnesses change, and to what. tones : (Hz, N) of forces at every place.
    run_up : Hz at the start, Hz at the end, N of one more such force whose frequency rises steadily.
    """
    rng = np.random.default_rng(seed)
    H = np.zeros((4, 7)) if hidden is None else hidden.copy()
    H[:, CUBIC] += kNL
    fs = RATE * steps
    taps = _taps(steps)
    x, v = np.zeros(6), np.zeros(6)
    wanted, done = int(seconds * RATE), 0
    tail, pieces, count, chunk = np.empty((0, 4)), [], 0, 8192
    while count < wanted:
        F = rng.normal(size=(chunk * steps, 4)) * level * np.sqrt(TRUTH["S"] / 2 * fs)
        at = (done + np.arange(len(F))) / fs
        if growth != 1.0:
            F *= 1.0 + (growth - 1.0) * at[:, None] / seconds
        done += len(F)
        for hz, amplitude in tones:
            F += amplitude * np.cos(2 * np.pi * hz * at[:, None] + np.arange(4))
        if run_up is not None:
            F += run_up[2] * np.cos(run_up_angle(run_up, seconds, at)[:, None] + np.arange(4))
        out = np.empty_like(F)
        k = change[1] if change is not None and count >= change[0] * RATE else TRUTH["kL"]
        _integrate(F, x, v, 1 / fs, k, TRUTH["c"], H, out)
        joined = np.concatenate([tail, out])
        if not len(tail):  # the first chunk is the run-up
            tail = joined[-(taps.size - 1) :]
            continue
        tail = joined[-(taps.size - 1) :]
        pieces.append(oaconvolve(joined, taps[:, None], mode="valid", axes=0)[::steps])
        count += chunk
    y = np.concatenate(pieces)[:wanted]
    y = y + noise * rng.normal(size=y.shape)
    return np.round(y / step) * step if step else y


def run_up_angle(run_up: tuple[float, float, float], seconds: float, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) rad at the times `at`, s."""
    return 2 * np.pi * (run_up[0] * at + 0.5 * (run_up[1] - run_up[0]) / seconds * at**2)


def shaft_at_caps(shaft: Shaft, stiffness: float, damping: float, disc: float, w: np.ndarray) -> np.ndarray:
    """(f, 2, 2) N/m that shaft and disc add to the dynamic stiffness of two caps, no force on the disc; w in rad/s."""
    K, C = shaft_matrix(shaft, stiffness), shaft_matrix(shaft, damping)
    D = K + 1j * w[:, None, None] * C - w[:, None, None] ** 2 * np.diag([0.0, 0.0, disc])
    return np.asarray(D[:, :2, :2] - D[:, :2, 2:] @ D[:, 2:, :2] / D[:, 2:, 2:])
