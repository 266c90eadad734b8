"""Stiffness from a measured force by Volterra kernels: the second companion paper (J. Sound Vib. 221(5), 1999).

For m a + c v + k x + kNL x^3 = F the response is a series x = x1 + x3 + ..., and harmonic probing gives its kernels:

    H1(w) = 1 / (k - m w^2 + i w c)
    H3(w1, w2, w3) = -kNL H1(w1) H1(w2) H1(w3) H1(w1 + w2 + w3)

so x1 is F through H1, and x3 is -kNL x1^3 through H1: no three-dimensional array is stored. The series cut after x3
needs 3 kNL E[x^2] / kL well under the relative bandwidth c / sqrt(k m), which the paper's rig does not have. So
`nearest_kernels` puts the measured displacement into the cubic: x is H1 applied to F - kNL x^3, which sums the series
of these two kernels to all orders. kL, c, kNL (and m where the rig does not give it) minimise the output error in the
analysis band; noise on x enters only through the small cubic term. The first Wiener kernel, by correlation with a white
force, is H1 at the stiffness k + 3 kNL E[x^2].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.errors import DataError
from estimator.model.rig import MOTION_UNITS, Model
from estimator.results import Fit, Message, Parameter
from estimator.signals.band_limit import band_limit

from .batch_means import BlockMoments
from .planes import POWER_EFFECTS, Plane, density_band, planes_of

FIT_BLOCKS = 64  # of a record, for the covariance
MIN_ROWS = 8192  # of a fit


@dataclass(frozen=True, slots=True)
class Kernels:
    """The Volterra kernels of a cap on a cubic spring.

    m : mass, kg. c : damping, N s/m. k : stiffness of bearing and shaft, N/m. kNL : cubic stiffness, N/m^3.
    """

    m: float
    c: float
    k: float
    kNL: float

    def h1(self, w: Array) -> Complexes:
        """First-order kernel, m/N, at angular frequency w (rad/s, any shape)."""
        return np.asarray(1.0 / (self.k - self.m * w**2 + 1j * w * self.c))

    def h3(self, w1: Array, w2: Array, w3: Array) -> Complexes:
        """Third-order kernel, m/N^3."""
        return np.asarray(-self.kNL * self.h1(w1) * self.h1(w2) * self.h1(w3) * self.h1(w1 + w2 + w3))

    def response(self, force: Array, rate_hz: float, order: int = 3) -> Array:
        """Displacement (n,) m of the series up to `order` (1 or 3) under force (n,) N, from rest."""
        first = self.linear(force, rate_hz)
        return first if order == 1 else first - self.kNL * self.linear(first**3, rate_hz)

    def linear(self, force: Array, rate_hz: float) -> Array:
        """(n,) displacement, m, of the first order under force (n,), N, from rest."""
        n = len(force)
        size = _fast_length(n + int(min(n, 40.0 * self.m / self.c * rate_hz)))  # room for the tail: no wrap
        w: Array = 2.0 * np.pi * np.arange(size // 2 + 1, dtype=np.float64) * (rate_hz / size)
        return np.asarray(np.fft.irfft(self.h1(w) * np.fft.rfft(force, size), size)[:n])


def _fast_length(n: int) -> int:
    """A length of at least n that a real FFT is fast at."""
    from scipy.fft import next_fast_len

    return int(next_fast_len(n, real=True))


def first_wiener_kernel(x: Array, force: Array, rate_hz: float, segment: int = 4096) -> tuple[Array, Complexes]:
    """Frequencies (Hz) and first-order Wiener kernel (m/N), by cross-spectra of displacement x and force, (n,) each."""
    from scipy.signal import csd, welch

    f, cross = csd(force, x, rate_hz, nperseg=segment)
    _, power = welch(force, rate_hz, nperseg=segment)
    return f, np.asarray(cross / power)


def _start_kernels(x: Array, force: Array, rate_hz: float, band: tuple[float, float], mass: float | None) -> Kernels:
    """Start values: a weighted linear fit to the dynamic stiffness 1/H of the first Wiener kernel.

    x, force : (n,) m and N. band : Hz. mass : kg; None: unknown. Raises DataError if the force does not drive the cap.
    """
    f, h = first_wiener_kernel(x, force, rate_hz)
    inside = (f > band[0]) & (f < band[1])
    w, h = 2.0 * np.pi * f[inside], h[inside]
    weight = np.abs(h)
    stiff = 1.0 / h
    if mass is None:
        k, m = np.linalg.lstsq(np.stack([weight, -(w**2) * weight], axis=1), stiff.real * weight, rcond=None)[0]
    else:
        m, k = mass, float(np.average(stiff.real + mass * w**2, weights=weight**2))
    c = float(np.sum(stiff.imag * w * weight**2) / np.sum(w**2 * weight**2))
    if not (k > 0.0 and m > 0.0 and c > 0.0):
        raise DataError(
            f"the measured force does not drive this cap (k = {k:.3g} N/m, c = {c:.3g} N s/m, m = {m:.3g} kg from the "
            "first kernel): check sign, unit and place of the force channel"
        )
    return Kernels(float(m), c, float(k), 0.0)


def nearest_kernels(
    x: Array, force: Array, rate_hz: float, band: tuple[float, float], mass: float | None, valid: NDArray[np.bool_]
) -> tuple[Kernels, Array, float]:
    """Kernels of least output error, covariance of (k, c, kNL[, m]), and the unexplained share of the rms of x.

    x, force : (n,) band-limited, m and N. mass : kg; None: unknown. valid : (n,) which rows may be used.
    Gauss-Newton; the covariance is the sandwich over blocks, right also for a residual that is not white.
    """
    force = np.where(valid, force, 0.0)
    kernels = _start_kernels(x[valid], force[valid], rate_hz, band, mass)
    after = int(rate_hz * min(1.0, 24.0 * kernels.m / kernels.c))  # what happened before a gap is forgotten by then
    bad = np.concatenate([[True], ~valid])
    last_bad = np.maximum.accumulate(np.where(bad, np.arange(len(bad)), 0))[1:]
    use = valid & (np.arange(1, len(bad)) - last_bad > after)
    if use.sum() < MIN_ROWS:
        raise DataError(f"{int(use.sum())} samples far enough from a gap, {MIN_ROWS} needed: record longer")
    square = float(np.mean(x[use] ** 2))
    theta = np.array([kernels.k, kernels.c, 0.0] + ([kernels.m] if mass is None else []))
    scale = np.array([kernels.k, kernels.c, kernels.k / square] + ([kernels.m] if mass is None else []))

    def built(p: Array) -> Kernels:
        return Kernels(mass if mass is not None else float(p[3]), float(p[1]), float(p[0]), float(p[2]))

    cubed = np.where(valid, x, 0.0) ** 3

    def model(p: Array) -> Array:
        return built(p).linear(force - p[2] * cubed, rate_hz)[use]

    target = x[use]
    for _ in range(12):
        now = model(theta)
        step = 1e-5 * scale
        slope = np.stack([(model(theta + s * e) - now) / 1e-5 for s, e in zip(step, np.eye(len(theta)), strict=True)])
        residual = target - now
        move = np.linalg.solve(slope @ slope.T, slope @ residual)
        theta = theta + np.clip(move, -0.3, 0.3) * scale
        if np.max(np.abs(move)) < 1e-7:
            break
    residual = target - model(theta)
    blocks = BlockMoments(len(theta))
    size = max(1, len(target) // FIT_BLOCKS)
    for at in range(0, len(target), size):
        part = slope[:, at : at + size] * residual[at : at + size]
        blocks.add(part.sum(axis=1), part.shape[1])
    bread = np.linalg.inv(slope @ slope.T / len(target)) * scale[:, None]
    return built(theta), bread @ blocks.covariance() @ bread.T, float(np.sqrt(np.mean(residual**2) / square))


def fit_volterra(model: Model, y: Array, rate_hz: float) -> Fit:
    """kL, c and kNL of every cap with a measured force, from a record y (n, channels), SI, NaN where one is missing.

    Raises DataError if no force is measured at a measured cap, or the record is too short.
    """
    band, _ = density_band(model)
    found: dict[str, Parameter] = {}
    notes: list[Message] = []
    rows = 0
    for plane in planes_of(model):
        for cap in plane.caps:
            at = {c.kind: i for i, c in reversed(list(enumerate(model.channels))) if c.place == cap.place}
            motion = next((k for k in MOTION_UNITS if k in at), None)
            if "force" not in at or motion is None:
                continue
            pair = y[:, [at[motion], at["force"]]]
            part = band_limit(pair, (motion, "force"), rate_hz, band)
            rows = max(rows, int(part.valid.sum()))
            if int(part.valid.sum()) < MIN_ROWS:
                few = f"{int(part.valid.sum())} usable samples at {cap.place}"
                raise DataError(f"{few}, {MIN_ROWS} needed: record longer")
            kernels, cov, left = nearest_kernels(part.x[0], part.a[1], rate_hz, band, cap.mass, part.valid)
            found |= _named_parameters(plane, cap.place, cap.mass, kernels, cov, model.shaft_damping)
            text = f"{cap.place}: {100.0 * left:.2g} % of the rms displacement is not explained by the fit"
            notes.append(Message("motion_unexplained", text, cap.place))
    if not found:
        raise DataError('no channel of kind "force" at a measured cap: volterra needs one; use another method')
    ignored = [e.name for e in model.effects if POWER_EFFECTS.get(e.name, (0,))[0] != 3]
    if ignored:
        text = f"volterra fits only the linear and the cubic law; left out: {', '.join(ignored)}"
        notes.append(Message("effects_ignored", text))
    return Fit(parameters=found, log_likelihood=None, samples=rows, method="volterra", messages=tuple(notes))


def _named_parameters(
    plane: Plane, place: str, mass: float | None, kernels: Kernels, cov: Array, shaft_damping: float
) -> dict[str, Parameter]:
    """Parameters of a cap by full name. kernels, cov : of its fit, bearing and shaft together."""
    sd = np.sqrt(np.diag(cov))
    # the shaft, seen from one cap: its diagonal term; the motion of the other cap enters as noise
    out = {
        f"{place}.kL": Parameter.from_estimate(kernels.k - plane.a * plane.ks, float(sd[0]), "N/m"),
        f"{place}.c": Parameter.from_estimate(kernels.c - plane.a * shaft_damping, float(sd[1]), "N s/m"),
        f"{place}.cubic.kNL": Parameter.from_estimate(kernels.kNL, float(sd[2]), "N/m^3"),
    }
    if mass is None:
        out[f"{place}.m"] = Parameter.from_estimate(kernels.m, float(sd[3]), "kg")
    return out
