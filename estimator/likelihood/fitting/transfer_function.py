"""The path from a measured force to a measured motion, by frequency, and the likelihood of a biased transfer function.

Where the force f on a cap is measured, the residual force R = A a - f of the fitted tangent A is coherent with the
motion if the true tangent A' differs from A. With noise n of the motion and q of the force, A' a - f = A' n - q in
every bin. Both noises are white, of densities N and Q. The likelihood of the motion given the measured force is
Whittle's,

    -sum n [P / s + ln s - ln |A'|^2],   P = mean |A' a - (1 - p) f|^2,   s = |A'|^2 N + (1 - p) Q,   p = Q / mean |f|^2

(1 - p) f is the expected true force given the measured one. The last term is the Jacobian: it keeps the noise of a from
pulling A' towards zero, as p keeps the noise of f from pushing it up. Where a shaft couples the places, A' a stands for
the sum over all, and the Jacobian is that of their matrix: |1 + (A' - A) H|^2, H = (A^-1)_ii, for a change at one
place. Q may also be an unmeasured force beside f. Then f is exact, and p = 0; or it is partly both. Amplitude and phase
of every bin count, so a thousandth of the force is detected.

References
----------
P. Whittle, "Estimation and information in stationary time series", Arkiv for Matematik 2, 1953, 423-434.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.signals.band_limit import noise_shape

if TYPE_CHECKING:
    from estimator.likelihood.path.working_point import WorkingPoint

MAX_CELLS = 900  # of the band; their width grows with the frequency
INDEPENDENT_PER_BIN = 0.439  # numbers per bin of a block: Hann windows every half block, 1.944 (1 + 2 / 11.7)
LINE_HALF_WIDTH_BINS = 2.5  # left out on either side of a tone
MAX_STEPS, MIN_STEP_GAIN_NATS = 60, 1e-4  # of the scoring


@dataclass(frozen=True, slots=True, kw_only=True)
class PathSpectra:
    """Residual force R, acceleration a and measured force f of one place, by cells of the band.

    w : (cells,) rad/s. n : (cells,) independent numbers. rr, ra, aa, rf, af, ff : (cells,) mean |R|^2, R a*, |a|^2, R
    f*, a f* and |f|^2, one-sided PSD. A : (cells,) kg, tangent. H : (cells,) acceleration per force, the other places
    free; 1 / A of a place that is not coupled. noise : (cells,) PSD of acceleration of white sensor noise. hz :
    (cells,) width. unmeasured : share of the noise Q of the force that is an unmeasured force, not sensor noise. across
    : (cells,) PSD in R of sensor noise of other places.
    """

    w: Array
    n: Array
    rr: Array
    ra: Complexes
    aa: Array
    rf: Complexes
    af: Complexes
    ff: Array
    A: Complexes
    H: Complexes
    noise: Array
    hz: Array
    unmeasured: float = 0.0
    across: Array | float = 0.0

    def share(self, Q: float) -> Array:
        """(cells,) share of noise in the power of the measured force. Q : N^2/Hz, its density."""
        return np.minimum((1.0 - self.unmeasured) * Q / self.ff, 0.5)

    def answer(self, A: Complexes) -> Complexes:
        """(cells,) acceleration per force at another tangent A (cells,)."""
        return np.asarray(self.H / (1 + (A - self.A) * self.H))


def path_spectra_of(point: WorkingPoint, i: int, lines: Collection[float] = ()) -> PathSpectra:
    """The spectra of place i. lines : Hz, tones whose bins are left out."""
    data = point.data
    w = 2 * np.pi * data.f_hz

    def blocks(z: NDArray[Any]) -> NDArray[np.complex64]:
        return _spectra(z.reshape(-1, data.block), data.block, data.start)[:, data.bins]

    R, a = blocks(point.force[i]), 1j * w * blocks(data.v[i])
    f = point.A[:, i, i] * a - R
    others = np.arange(len(data.places)) != i
    for j in np.flatnonzero(others & point.A[:, i].any(axis=0)):
        f += point.A[:, i, j] * (1j * w) * blocks(data.v[j])
    spacing = data.rate_hz / data.block
    keep = np.ones(w.size, bool)
    for hz in lines:
        keep &= np.abs(data.f_hz - hz) > LINE_HALF_WIDTH_BINS * spacing
    scale = 2.0 / (data.rate_hz * 0.375 * data.block)
    pairs = ((R, R), (R, a), (a, a), (R, f), (a, f), (f, f))
    power = [scale * np.mean(one * other.conj(), axis=0) for one, other in pairs]
    single = min(20, int(keep.sum()))  # cells of one bin at the lower end of the band
    edges = np.unique(np.round(np.geomspace(single, keep.sum(), MAX_CELLS)).astype(int))
    first = np.concatenate([np.arange(single), edges[:-1]])
    width = np.diff(np.append(first, keep.sum())).astype(np.float64)

    def mean(z: NDArray[np.generic]) -> Complexes:
        return np.asarray(np.add.reduceat(z[keep], first) / width)

    rr, ra, aa, rf, af, ff, A, H, ww = (mean(z) for z in (*power, point.A[:, i, i], np.linalg.inv(point.A)[:, i, i], w))
    shape = noise_shape(data.kinds[i : i + 1], w)[0] * data.undone_noise_gain[i]
    noise_psd = data.noise_shape * (point.nu * point.S)[:, None]
    across = np.sum(np.abs(point.A[:, i]) ** 2 * noise_psd.T, axis=1, where=others)
    return PathSpectra(
        w=ww.real, n=INDEPENDENT_PER_BIN * width * len(R), rr=rr.real, ra=ra, aa=aa.real, rf=rf, af=af, ff=ff.real, A=A,
        H=H, noise=mean(shape).real, hz=spacing * width, across=mean(across).real,
    )  # fmt: skip


def _spectra(z: Array, block: int, start: NDArray[np.int64]) -> NDArray[np.complex64]:
    """(blocks, bins) spectra under Hann windows of a series z (n,) of blocks laid end to end.

    start : (blocks,) first row of each block. Windows overlap by half where the record is contiguous.
    """
    from scipy.fft import rfft

    rows = z.reshape(-1, block).astype(np.float32)
    on = np.flatnonzero(np.diff(start) == block)
    half = block // 2
    between = np.concatenate([rows[on, half:], rows[on + 1, :half]], axis=1)
    window = (0.5 - 0.5 * np.cos(2 * np.pi * np.arange(block) / block)).astype(np.float32)
    return np.asarray(rfft(np.concatenate([rows, between]) * window, axis=1))


@dataclass(frozen=True, slots=True)
class Peak:
    """The maximum of a likelihood of the path.

    nats : log-likelihood. u : ln Q, ln N, changes of k, c (and m), then the parameters of a cause of bias. covariance :
    that of u. A : (cells,) kg, tangent A'.
    """

    nats: float
    u: Array
    covariance: Array
    A: Complexes


def maximise_path(
    r: PathSpectra, bend: Callable[[Array], Complexes], start: Array, scale: Array, held: int | None = None
) -> Peak:
    """The maximum of the likelihood from a start (numbers,), by damped Fisher scoring.

    bend : (cells,) tangent A' of the numbers after ln Q and ln N. scale : (numbers,) unit of each. held : number of one
    that stays at its start; None: all move.
    """

    def at(u: Array) -> tuple[float, Complexes, Complexes, Array]:
        A = bend(u[2:])
        P, rest, s = residual_and_noise(r, A, u)
        return float(r.n @ (P / s + np.log(s) - 2 * np.log(np.abs(1 + (A - r.A) * r.H)))), A, rest, s

    def slopes(u: Array, A: Complexes, rest: Complexes, s: Array) -> tuple[Array, Array]:
        P = residual_power(r, A, clipped_exp(u[0]))
        own = clipped_exp(u[1]) * r.noise
        dA = np.zeros((u.size, r.w.size), complex)
        for j in range(2, u.size):
            up, down = u[2:].copy(), u[2:].copy()
            up[j - 2] += 1e-4 * scale[j]
            down[j - 2] -= 1e-4 * scale[j]
            dA[j] = (bend(up) - bend(down)) / 2e-4
        ds = 2 * np.real((A * own).conj() * dA)
        ds[0], ds[1] = clipped_exp(u[0]) * scale[0], np.abs(A) ** 2 * own * scale[1]
        g = (2 * np.real(dA.conj() * rest) / s + ds * (1 / s - P / s**2) - 2 * np.real(dA * r.answer(A))) @ r.n
        H = 2 * np.real((dA.conj() * (r.n * r.aa / s)) @ dA.T) + (ds * (r.n / s**2)) @ ds.T
        return g, H

    u, damping = start.copy(), 1e-3
    cost, A, rest, s = at(u)
    if held is None:  # the noise at first what makes up for a start that is far off
        u[:2] += np.log(np.average(residual_power(r, A) / s, weights=r.n))
        cost, A, rest, s = at(u)
    H = np.eye(u.size)
    for _ in range(MAX_STEPS):
        g, H = slopes(u, A, rest, s)
        if held is not None:
            g[held], H[held], H[:, held], H[held, held] = 0.0, 0.0, 0.0, 1.0
        moved = False
        while damping < 1e8:
            step = -np.linalg.solve(H + np.diag(damping * np.diag(H) + 1e-9), g)
            new = at(u + step * scale)
            if np.isfinite(new[0]) and new[0] < cost:
                moved = True
                break
            damping *= 6.0
        if not moved:
            break
        gained = cost - new[0]
        u = u + step * scale
        cost, A, rest, s = new
        damping = max(damping / 6.0, 1e-9)
        if gained < MIN_STEP_GAIN_NATS:
            break
    covariance: Array = np.asarray(np.linalg.pinv(H, rcond=1e-12) * np.multiply.outer(scale, scale), np.float64)
    return Peak(-cost, u, covariance, A)


def clipped_exp(z: float) -> float:
    """exp z, with z between -90 and 30."""
    return float(np.exp(np.clip(z, -90.0, 30.0)))


def fit_linear_path(point: WorkingPoint, i: int, r: PathSpectra) -> tuple[Peak, Array]:
    """The maximum without a cause of bias, and the scales of its numbers: ln Q, ln N, changes of k and c."""
    scale = np.array([1.0, 1.0, 1e-3 * point.kL[i], 1e-2 * point.c[i] + 1e-9])
    tried = [
        maximise_path(r, partial(linear_tangent, r), np.array([*noise, 0.0, 0.0]), scale)
        for noise in noise_starts(r, r.A)
    ]
    return max(tried, key=lambda peak: peak.nats), scale


def noise_starts(r: PathSpectra, A: Complexes) -> list[tuple[float, float]]:
    """Start values of ln Q and ln N at a tangent A (cells,): mostly one noise, mostly the other."""
    referred = float(np.mean(r.noise * np.abs(A) ** 2))
    S = float(np.exp(np.average(np.log(residual_power(r, A)), weights=r.n)))
    return [(float(np.log(S * q)), float(np.log(S * n / referred))) for q, n in ((1.0, 0.1), (0.1, 1.0), (1.0, 1e-4))]


def linear_tangent(r: PathSpectra, d: Array) -> Complexes:
    """(cells,) kg: the tangent with changes d of k and c, N/m and N s/m."""
    return np.asarray(r.A - d[0] / r.w**2 + d[1] / (1j * r.w))


def residual_power(r: PathSpectra, A: Complexes, Q: float = 0.0) -> Array:
    """(cells,) mean |A a - (1 - p) f|^2, with p the share of noise of density Q in the measured force."""
    p, d = r.share(Q), A - r.A
    P = r.rr + np.abs(d) ** 2 * r.aa + p**2 * r.ff + 2 * np.real(d.conj() * r.ra + p * (r.rf + d * r.af))
    return np.asarray(np.maximum(P, 1e-300))


def residual_and_noise(r: PathSpectra, A: Complexes, u: Array) -> tuple[Array, Complexes, Array]:
    """(cells,) each: mean |A a - (1 - p) f|^2, mean (A a - (1 - p) f) a*, and the expectation of the first at u."""
    Q = clipped_exp(u[0])
    p = r.share(Q)
    rest = r.ra + (A - r.A) * r.aa + p * r.af.conj()
    own = r.unmeasured * Q + (1 - p) * (1 - r.unmeasured) * Q
    s = np.abs(A) ** 2 * clipped_exp(u[1]) * r.noise + own + r.across
    return residual_power(r, A, Q), rest, s
