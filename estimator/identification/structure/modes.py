"""Modes in the spectrum of a place, by maximum likelihood of an averaged spectrum.

The PSD of the acceleration is that of oscillators under a smooth force, and white noise of the sensor:

    S_a(f) = exp(P(ln f)) sum_m w_m |H_m(f)|^2 + N n(f),    H_m = -f^2 / (f_m^2 - f^2 + 2 j zeta_m f_m f),

with w_1 = 1 and P a cubic spline; without a mode S_a = exp(P) + N n. Averaged spectra are gamma distributed, and Fisher
scoring finds the maximum (Whittle 1953; Brillinger, Time Series, 1981, ch. 5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from estimator.arrays import Array

from .excitation import CellSpectrum, spline_basis
from .thresholds import LIMITS


@dataclass(frozen=True, slots=True, kw_only=True)
class OscillatorFit:
    """The spectrum of a place as oscillators under a smooth force.

    Parameters
    ----------
    f_hz, damping : (modes,) float64
        Frequency and damping ratio.
    f_sd_hz, damping_sd : (modes,) float64
        Standard deviations.
    prominence : (modes,) float64
        Power at the resonance over that of everything else there.
    energy : (modes,) float64
        Share of the kinetic energy in the band: mean square of the velocity.
    force : (cells,) float64
        exp(P): PSD of the force over the squared mass, (m/s^2)^2/Hz.
    knot_octaves : float
        Distance of the knots of P.
    misfit_db : float
        Rms distance of the spectrum from the fit beyond its scatter, dB.
    """

    f_hz: Array
    damping: Array
    f_sd_hz: Array
    damping_sd: Array
    prominence: Array
    energy: Array
    force: Array
    knot_octaves: float
    misfit_db: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Parts:
    """The model at some values: PSD, its logarithmic derivatives (cells, p), and PSD of each mode (modes, cells)."""

    psd: Array
    jacobian: Array
    force: Array
    modes: Array


class _Problem:
    """The likelihood of a cell spectrum. theta: coefficients of P, ln N, then ln f, ln zeta, ln w of each mode."""

    def __init__(self, cells: CellSpectrum, knot_octaves: float) -> None:
        self.cells, self.knot_octaves = cells, knot_octaves
        self.scale = float(np.median(cells.psd))
        self.P = cells.psd / self.scale
        x = np.log(cells.f_hz)
        self.x = x
        self.basis = spline_basis(x, max(1, int((x[-1] - x[0]) / np.log(2.0) / knot_octaves + 0.5)), 3)
        B = cells.block_psd / cells.block_psd.mean(axis=0)
        n_blocks = len(B)
        own = np.mean((B - 1.0) ** 2) * n_blocks / max(n_blocks - 1, 1)
        self.dispersion = max(1.0, float(own / np.mean(n_blocks / cells.shape)))
        self.nu = cells.shape / self.dispersion

    @property
    def k(self) -> int:
        return int(self.basis.shape[1])

    def parts(self, theta: Array) -> _Parts:
        k, f = self.k, self.cells.f_hz
        force = np.exp(np.clip(self.basis @ theta[:k], -80.0, 80.0))
        noise = np.exp(theta[k]) * self.cells.noise
        tail = theta[k + 1 :].reshape(-1, 3)
        columns = []
        modes = np.zeros((len(tail), f.size))
        for m, (u, z, a) in enumerate(tail):
            r = (f / np.exp(u)) ** 2
            zeta2 = np.exp(2.0 * z)
            D = (1.0 - r) ** 2 + 4.0 * zeta2 * r
            H2 = r * r / D
            modes[m] = np.exp(a) * H2
            # d ln H2 / du with dr/du = -2 r; d ln H2 / dz
            dln_du = -4.0 - (-2.0 * (1.0 - r) + 4.0 * zeta2) * (-2.0 * r) / D
            dln_dz = -8.0 * zeta2 * r / D
            columns += [modes[m] * dln_du, modes[m] * dln_dz, modes[m]]
        G = modes.sum(axis=0) if len(tail) else np.ones(f.size)
        psd = force * G + noise
        J = np.empty((f.size, theta.size))
        J[:, :k] = self.basis * (force * G / psd)[:, None]
        J[:, k] = noise / psd
        for j, column in enumerate(columns):
            J[:, k + 1 + j] = force * column / psd
        return _Parts(psd=psd, jacobian=J, force=force, modes=modes * force)

    def log_likelihood(self, psd: Array) -> float:
        return float(-np.sum(self.nu * (self.P / psd + np.log(psd))))

    def free(self, theta: Array) -> NDArray[np.intp]:
        """Parameters that are fitted: the weight of the first mode is 1."""
        return np.delete(np.arange(theta.size), self.k + 3) if theta.size > self.k + 1 else np.arange(theta.size)

    def maximise(self, theta: Array) -> tuple[Array, _Parts, float]:
        """Fisher scoring with damping from a start."""
        free, damping = self.free(theta), 1e-3
        parts = self.parts(theta)
        value = self.log_likelihood(parts.psd)
        for _ in range(LIMITS.max_steps):
            J = parts.jacobian[:, free]
            g = J.T @ (self.nu * (self.P / parts.psd - 1.0))
            F = (J * self.nu[:, None]).T @ J
            gained = 0.0
            for _ in range(6):
                A = F + np.diag(damping * np.diag(F) + 1e-9 * np.trace(F) / len(free) + 1e-12)
                step = np.zeros(theta.size)
                step[free] = np.clip(np.linalg.solve(A, g), -1.0, 1.0)
                new = self._within(theta + step)
                trial = self.parts(new)
                trial_value = self.log_likelihood(trial.psd)
                if trial_value > value:
                    gained = trial_value - value
                    theta, parts, value = new, trial, trial_value
                    damping = max(damping / 5.0, 1e-6)
                    break
                damping *= 6.0
            if gained < 1e-3:
                break
        return theta, parts, value

    def _within(self, theta: Array) -> Array:
        """Values inside their limits."""
        k, f = self.k, self.cells.f_hz
        out = theta.copy()
        out[k] = np.clip(out[k], -60.0, 20.0)
        tail = out[k + 1 :].reshape(-1, 3)
        tail[:, 0] = np.clip(tail[:, 0], np.log(f[0]), np.log(f[-1]))
        tail[:, 1] = np.clip(tail[:, 1], np.log(LIMITS.damping_limits[0]), np.log(LIMITS.damping_limits[1]))
        tail[:, 2] = np.clip(tail[:, 2], -40.0, 40.0)
        return out

    def smooth_start(self) -> Array:
        """P by least squares on the logarithm; noise far below."""
        coefficients = np.linalg.lstsq(self.basis, np.log(self.P), rcond=None)[0]
        return np.append(coefficients, np.log(self.P.min()) - 3.0)

    def hump(self, psd: Array, banned: Sequence[float]) -> tuple[float, float]:
        """ln f and ln zeta of the most significant hump of the spectrum over a fit. banned : ln f that are left out."""
        weight = np.concatenate([[0.0], np.cumsum(self.nu)])
        excess = np.concatenate([[0.0], np.cumsum(self.nu * (self.P / psd - 1.0))])
        x, best = self.x, (-np.inf, 0.0, 0.0)
        for half in LIMITS.widths_rel:
            a, b = np.searchsorted(x, x - half), np.searchsorted(x, x + half, side="right")
            z = (excess[b] - excess[a]) / np.sqrt(weight[b] - weight[a])
            z[(x < x[0] + LIMITS.edge_rel) | (x > x[-1] - LIMITS.edge_rel)] = -np.inf
            for u in banned:
                z[np.abs(x - u) < LIMITS.edge_rel] = -np.inf
            at = int(np.argmax(z))
            if z[at] > best[0]:
                best = (float(z[at]), float(x[at]), float(np.log(0.6 * half)))
        return best[1], best[2]

    def with_mode(self, theta: Array, parts: _Parts, banned: Sequence[float]) -> Array:
        """A start with one mode more, at the largest hump. banned : ln f that are left out."""
        u, z = self.hump(parts.psd, banned)
        z = max(z, float(np.log(2.0 * LIMITS.damping_limits[0])))
        k = self.k
        at = int(np.argmin(np.abs(self.x - u)))
        zeta2 = np.exp(2.0 * z)
        if theta.size == k + 1:
            return self.first_mode(theta, u, z)
        extra = max(float(self.P[at] / parts.psd[at]) - 1.0, 0.1) * parts.psd[at] / parts.force[at]
        return np.concatenate([theta, [u, z, np.log(extra * 4.0 * zeta2)]])

    def first_mode(self, theta: Array, u: float, z: float) -> Array:
        """A start with one mode at ln f = u of ln zeta = z; the smooth force is read off the resonance."""
        r = np.exp(2.0 * (self.x - u))
        H2 = r * r / ((1.0 - r) ** 2 + 4.0 * np.exp(2.0 * z) * r)
        rest = np.log(np.maximum(self.P - np.exp(theta[self.k]) * self.cells.noise, 0.3 * self.P) / H2)
        near = np.sqrt(1.0 / (1.0 + H2))
        c = np.linalg.lstsq(self.basis * near[:, None], rest * near, rcond=None)[0]
        noise = np.log(0.5 * np.quantile(self.P / self.cells.noise, 0.01))
        return np.concatenate([c, [noise], [u, z, 0.0]])

    def standard_deviations(self, parts: _Parts, theta: Array) -> Array:
        """(parameters,) the larger one by the information and by the scores of the blocks; 0 of a fixed parameter."""
        free, sd = self.free(theta), np.zeros(theta.size)
        J = parts.jacobian[:, free]
        C = np.linalg.pinv((J * self.nu[:, None]).T @ J, hermitian=True)
        variance, B = np.diag(C), self.cells.block_psd / self.scale
        if len(B) >= 6:
            scores = ((B - self.P) / parts.psd * (self.nu / len(B))) @ J
            sandwich = C @ (scores.T @ scores * len(B) / (len(B) - 1)) @ C
            variance = np.maximum(variance, np.diag(sandwich))
        sd[free] = np.sqrt(variance.clip(0.0))
        return sd


def fit_oscillators(cells: CellSpectrum) -> list[OscillatorFit]:
    """Fits with 0, 1, 2 ... modes, each one significant; the last one is the answer.

    A further mode is significant at `mode_p_value` over all frequencies and widths searched, lies inside the band, is
    wider than a line, and has at least half of the power at its resonance.
    """
    fits = _with_knots(cells, LIMITS.knot_octaves)
    if len(fits) == 1:
        return _with_broad_mode(cells) or fits
    for _ in range(2):
        top = fits[-1]
        widest = 2.0 * float(top.damping[np.argmax(top.energy)]) if top.f_hz.size else 0.0
        if LIMITS.knot_widths * widest <= np.log(2.0) * top.knot_octaves:
            break
        fits = _with_knots(cells, LIMITS.knot_widths * widest / np.log(2.0))
    return fits


def _with_broad_mode(cells: CellSpectrum) -> list[OscillatorFit]:
    """Fits without and with one mode where P is one cubic over the band; empty where there is no such mode."""
    problem = _Problem(cells, float((np.log(cells.f_hz[-1] / cells.f_hz[0])) / np.log(2.0)))
    theta, parts, value = problem.maximise(problem.smooth_start())
    places = np.linspace(problem.x[0], problem.x[-1], LIMITS.broad_starts + 2)[1:-1]
    tried = [problem.maximise(problem.first_mode(theta, u, float(np.log(LIMITS.broad_damping)))) for u in places]
    best = max(tried, key=lambda fit: fit[2])
    fit = _fit(problem, *best[:2])
    if best[2] - value < _needed_nats(problem) or not _is_sound(cells, fit):
        return []
    return [_fit(problem, theta, parts), fit]


def _needed_nats(problem: _Problem) -> float:
    """Gain of a significant mode, over all frequencies and widths searched."""
    trials = (problem.x[-1] - problem.x[0]) * len(LIMITS.widths_rel) / min(LIMITS.widths_rel)
    return 0.5 * float(chdtri(3, LIMITS.mode_p_value / max(trials, 1.0)))


def _with_knots(cells: CellSpectrum, knot_octaves: float) -> list[OscillatorFit]:
    """Fits with 0, 1, 2 ... modes at one distance of the knots of P."""
    problem = _Problem(cells, knot_octaves)
    theta, parts, value = problem.maximise(problem.smooth_start())
    fits = [_fit(problem, theta, parts)]
    needed = _needed_nats(problem)
    banned: list[float] = []
    while len(fits) <= LIMITS.max_modes and len(banned) < LIMITS.max_refused:
        start = problem.with_mode(theta, parts, banned)
        new, new_parts, new_value = problem.maximise(start)
        if new_value - value < needed:
            break
        fit = _fit(problem, new, new_parts)
        if not _is_sound(cells, fit):
            banned.append(float(start[-3]))
            continue
        theta, parts, value = new, new_parts, new_value
        fits.append(fit)
    return fits


def _is_sound(cells: CellSpectrum, fit: OscillatorFit) -> bool:
    """Whether every mode lies inside the band with its half-power points, is wider than a line, and stands out."""
    low, high = cells.f_hz[0] * (1.0 + LIMITS.edge_rel), cells.f_hz[-1] * (1.0 - LIMITS.edge_rel)
    half = fit.damping * fit.f_hz
    width = 2.0 * half
    return bool(
        np.all((fit.f_hz - half > low) & (fit.f_hz + half < high))
        and np.all(width > LIMITS.min_width_bins * cells.bin_hz)
        and np.all(fit.damping < 0.99 * LIMITS.damping_limits[1])
        and np.all(fit.damping_sd < LIMITS.max_damping_sd_rel * fit.damping)
        and np.all(fit.prominence > LIMITS.min_prominence)
    )


def _fit(problem: _Problem, theta: Array, parts: _Parts) -> OscillatorFit:
    """The fit at a maximum of the likelihood."""
    k, cells = problem.k, problem.cells
    tail = theta[k + 1 :].reshape(-1, 3)
    f, zeta = np.exp(tail[:, 0]), np.exp(tail[:, 1])
    at = [int(np.argmin(np.abs(problem.x - u))) for u in tail[:, 0]]
    own = np.array([parts.modes[m, i] for m, i in enumerate(at)])
    prominence = own / np.maximum(parts.psd[at] - own, 1e-12 * own) if len(at) else own
    ratio = problem.P / parts.psd
    smoothed, scatter = _smoothed(np.log(np.maximum(ratio, 1e-12)), problem)
    misfit = np.sqrt(max(float(np.mean(smoothed**2 - scatter)), 0.0))
    order = np.argsort(f)
    df = np.gradient(cells.f_hz) / cells.f_hz**2
    tail_sd = problem.standard_deviations(parts, theta)[k + 1 :].reshape(-1, 3)
    return OscillatorFit(
        f_hz=f[order],
        damping=zeta[order],
        f_sd_hz=(f * tail_sd[:, 0])[order],
        damping_sd=(zeta * tail_sd[:, 1])[order],
        prominence=prominence[order],
        energy=(parts.modes @ df / (parts.psd @ df))[order],
        force=parts.force * problem.scale,
        knot_octaves=problem.knot_octaves,
        misfit_db=10.0 / np.log(10.0) * misfit,
    )


def _smoothed(log_ratio: Array, problem: _Problem) -> tuple[Array, Array]:
    """Means of the logarithm over 1 % of the frequency, each with its expected square by the scatter of the cells."""
    x = problem.x
    a, b = np.searchsorted(x, x - 0.005), np.searchsorted(x, x + 0.005, side="right")
    w = np.concatenate([[0.0], np.cumsum(problem.nu)])
    s = np.concatenate([[0.0], np.cumsum(problem.nu * log_ratio)])
    weight = w[b] - w[a]
    return np.asarray((s[b] - s[a]) / weight), np.asarray(1.0 / weight)
