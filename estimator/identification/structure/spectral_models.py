"""Mean spectra of the residual force in narrow cells, and causes of their shape, each fitted together with k and c."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array, Complexes
from estimator.effects.excitation import coloured_excitation
from estimator.effects.excitation.pedestal import PEDESTAL
from estimator.effects.sensor import sensor_resonance
from estimator.likelihood.fitting.noise_level import MIN_NOISE_RATIO
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.likelihood.whitening.sensor_noise import referred_psd
from estimator.model.effect import Effect
from estimator.results import Parameter

from .thresholds import LIMITS

# of ln(mass / cap mass), ln(frequency in Hz), ln(damping ratio) of a pedestal
PEDESTAL_LOWER_LIMITS, PEDESTAL_UPPER_LIMITS = np.array([-2.3, 2.0, -6.0]), np.array([3.0, 11.0, -0.36])


@dataclass(frozen=True, slots=True, kw_only=True)
class SpectralCells:
    """Mean spectra of one location in cells of neighbouring frequency bins.

    Attributes
    ----------
    power : (cells,) float64
        Mean |F|^2 of the residual force, N^2/Hz.
    n : (cells,) float64
        Bins over all blocks.
    w : (cells,) float64
        Mean angular frequency, rad/s.
    A : (cells,) complex128
        Tangent with the other caps free to respond, N per m/s^2.
    force_shape : (cells,) float64
        Spectral shape of the excitation that the model has.
    noise_gain : (cells,) float64
        PSD of the noise of all sensors referred to force, over that of the own sensor's noise.
    others : (cells,) float64
        PSD of the acceleration here due to the forces at the other caps, (m/s^2)^2/Hz.
    """

    power: Array
    n: Array
    w: Array
    A: NDArray[np.complex128]
    force_shape: Array
    noise_gain: Array
    others: Array

    def tangent(self, u: Array) -> NDArray[np.complex128]:
        """Tangent with the changes u[2:4] of stiffness and damping; u may be (numbers, m, 1) for (m, cells) at once."""
        return np.asarray(self.A - u[2] / self.w**2 + u[3] / (1j * self.w))

    def spectrum(self, u: Array, A: NDArray[np.complex128], factor: float | Array = 1.0) -> Array:
        """(cells,) PSD of the residual force if A is the true tangent of the rotor, N^2/Hz.

        u : ln S, ln of the noise PSD. factor : of the force spectrum. The residual force is F - d a with d = A - self.A
        and a = (F + self.A o) / A, where o is the motion by the forces at the other caps. Sensor noise is no motion of
        the rotor: its force follows from self.A alone.
        """
        S, noise = finite_exp(u[0]), finite_exp(u[1])
        force = S * self.force_shape * factor + np.abs(A - self.A) ** 2 * self.others
        return np.asarray(force * np.abs(self.A / A) ** 2 + noise * self.noise_gain)


def _noise_gain(point: WorkingPoint, i: int) -> Array:
    """(bins,) PSD of all sensors' noise referred to force over that of the own sensor's noise.

    Relative noise levels are those of the fit, or equal where the fit has none.
    """
    N = point.nu * point.S
    N = np.maximum(N, LIMITS.min_noise_share * N.max()) if N.any() else np.ones(N.size)
    return np.asarray(referred_psd(point.data, point.A, N)[i] / N[i])


def cells_of(point: WorkingPoint, i: int) -> SpectralCells:
    """Spectral cells of location i, about evenly spaced in log frequency, fine at the resonance."""
    data, power = point.data, mean_power(point, i)
    edges = np.unique(np.round(np.geomspace(12, power.size, LIMITS.max_cells)).astype(int))
    first = np.concatenate([[0], edges[:-1]])
    width = np.diff(np.append(first, power.size)).astype(np.float64)

    def mean(z: Array) -> Array:
        return np.asarray(np.add.reduceat(z, first, axis=-1) / width)

    w = 2 * np.pi * data.f_hz
    A, others = with_others_answering(point.A, point.S, i)
    return SpectralCells(
        power=mean(power),
        n=width * data.blocks,
        w=mean(w),
        A=mean(A.real) + 1j * mean(A.imag),
        force_shape=mean(data.excitation_shape[i]),
        noise_gain=mean(_noise_gain(point, i)),
        others=mean(others),
    )


def with_others_answering(A: NDArray[np.complex128], S: Array, i: int) -> tuple[NDArray[np.complex128], Array]:
    """Tangent (f,) of location i while the other caps respond, and PSD (f,) of its acceleration due to them.

    A : (f, places, places) tangent. S : (places,) PSD of the forces, N^2/Hz.
    """
    H = np.asarray(np.linalg.inv(A)[:, i], dtype=np.complex128)
    others = np.delete(np.arange(len(S)), i)
    return 1.0 / H[:, i], np.asarray(np.abs(H[:, others]) ** 2 @ S[others], dtype=np.float64)


def mean_power(point: WorkingPoint, i: int) -> Array:
    """(bins,) mean |F|^2 of the force at location i, N^2/Hz; of its neighbours where a line takes a bin."""
    Z = point.spectra[i].reshape(point.data.blocks, -1, 2)
    power = np.einsum("bkc,bkc->k", Z, Z).astype(np.float64) / point.data.blocks / point.whitening.weight[i]
    if point.whitening.leakage is None:
        return np.asarray(power)
    kept = point.whitening.leakage.kept[i]
    bins = np.flatnonzero(kept > LIMITS.min_kept_share)
    return np.asarray(np.interp(np.arange(kept.size), bins, power[bins] / kept[bins]), np.float64)


def finite_exp(z: Array) -> Array:
    """exp of z, kept finite on the way to a maximum."""
    return np.asarray(np.exp(np.clip(z, -80.0, 20.0)))


def base_model(c: SpectralCells, u: Array) -> Array:
    """(cells,) PSD without a cause. u : ln S, ln of the noise PSD, changes of stiffness and damping."""
    return c.spectrum(u, c.tangent(u))


@dataclass(frozen=True, slots=True, kw_only=True)
class SpectralShape:
    """A cause of a spectral shape, with its parameters z in coordinates in which a search is unbounded.

    Attributes
    ----------
    effect : Effect
        Of the catalogue, with the names and units of its parameters.
    starts : tuple of tuple of float
        Points z from which searches start.
    model : callable
        (cells, (4 + z,)) -> (cells,) N^2/Hz, spectrum with the cause; the first four numbers are the base model's.
    values : callable
        z -> parameters in SI.
    idle : float
        Damping that searches are also started without, N s/m.
    """

    effect: Effect
    starts: tuple[tuple[float, ...], ...]
    model: Callable[[SpectralCells, Array], Array]
    values: Callable[[Array], Array]
    idle: float = 0.0


def _coloured_shape(place_peak: float) -> SpectralShape:
    """Excitation with more or less power below a corner frequency. place_peak : Hz, resonance of the cap."""

    def values(z: Array) -> Array:
        return np.array([np.exp(np.clip(z[0], -6, 7)) - LIMITS.max_dimming_share, np.exp(np.clip(z[1], 2, 12))])

    starts = tuple((g, float(np.log(place_peak * f))) for g in (0.6, 1.5, -0.5) for f in (0.4, 1.0, 2.5))
    return _factor_shape(coloured_excitation.COLOURED_EXCITATION, coloured_excitation.shape, values, starts)


def _resonance_shape(top: float) -> SpectralShape:
    """Resonance of the sensor. top : Hz, end of the band."""

    def values(z: Array) -> Array:
        return np.array([np.exp(np.clip(z[0], 3, 13)), np.exp(np.clip(z[1], -0.5, 5))])

    starts = tuple((float(np.log(top * f)), float(np.log(q))) for f in (0.25, 0.45, 0.7, 1.0, 1.4) for q in (4, 25))
    return _factor_shape(sensor_resonance.SENSOR_RESONANCE, sensor_resonance.spectral_factor, values, starts)


def _factor_shape(
    effect: Effect, factor: Callable[..., Array], values: Callable[[Array], Array],
    starts: tuple[tuple[float, ...], ...],
) -> SpectralShape:  # fmt: skip
    """A cause that multiplies the spectrum of the force by a factor of (Hz, parameters)."""

    def model(c: SpectralCells, u: Array) -> Array:
        return c.spectrum(u, c.tangent(u), factor(c.w / (2 * np.pi), values(u[4:])))

    return SpectralShape(effect=effect, starts=starts, model=model, values=values)


def pedestal_values(z: Array, cap_mass: float) -> Array:
    """(3,) mass in kg, frequency in Hz and damping ratio at a point (3,) of the search, or (3, m, 1) at m points."""
    return np.asarray((np.exp(np.clip(z.T, PEDESTAL_LOWER_LIMITS, PEDESTAL_UPPER_LIMITS)) * [cap_mass, 1.0, 1.0]).T)


def pedestal_at_limit(z: Array) -> bool:
    """Whether a search ended at a limit of the pedestal's range where the pedestal has no effect.

    A pedestal too heavy or too stiff to be identified lies at the other limits.
    """
    return bool(np.any(z[:2] <= PEDESTAL_LOWER_LIMITS[:2]) or z[2] >= PEDESTAL_UPPER_LIMITS[2])


def stiffness_lost(w: Array, k: float, c: float, p: Array) -> Complexes:
    """(f,) N/m that the stiffness of a bearing loses on a pedestal p (3,).

    It is D^2 / (D + P), with D = k + i w c of the bearing and P the dynamic stiffness of the pedestal.
    """
    M, w0, zeta = p[0], 2 * np.pi * p[1], p[2]
    D = k + 1j * w * c
    return np.asarray(D * D / (M * (w0**2 - w**2 + 2j * zeta * w * w0) + D))


def _pedestal_shape(mass: float, kL: float, c0: float, peak: float) -> SpectralShape:
    """A pedestal under the bearing.

    mass : kg of the cap. kL, c0 : stiffness and damping of the fit. peak : Hz, resonance of the cap.
    """
    values = partial(pedestal_values, cap_mass=mass)

    def model(c: SpectralCells, u: Array) -> Array:
        lost = stiffness_lost(c.w, kL + u[2], c0 + u[3], values(u[4:]))
        return c.spectrum(u, c.tangent(u) + lost / c.w**2)

    starts = tuple((m, float(np.log(peak * f)), -3.0) for m in (0.0, 1.5) for f in (0.5, 1.2, 2.0, 3.5))
    idle = LIMITS.broadened_damping_share * c0
    return SpectralShape(effect=PEDESTAL, starts=starts, model=model, values=values, idle=idle)


def deviance_residuals(root: Array, ratio: Array) -> Array:
    """(cells,) residuals whose squares sum to twice the Whittle log-likelihood ratio.

    root : (cells,) root of the number of bins. ratio : (cells,) measured power over the model's.
    """
    return np.asarray(np.sign(ratio - 1) * root * np.sqrt(np.maximum(2 * (ratio - 1 - np.log(ratio)), 0.0)))


def _max_likelihood(
    c: SpectralCells, model: Callable[[SpectralCells, Array], Array], starts: list[Array], scale: Array
) -> tuple[float, Array, Array]:
    """Largest Whittle log-likelihood, the numbers at it and their standard deviations.

    scale : (k,) scales of the numbers. Once the misfit of a start is within chance, no further start is tried.
    """
    from scipy.optimize import least_squares

    root, df = np.sqrt(c.n), c.n.size - scale.size

    def residual(z: Array) -> Array:
        return deviance_residuals(root, c.power / np.maximum(model(c, (z * scale).T), 1e-300))

    def slopes(z: Array) -> Array:
        step = LIMITS.derivative_step_rel * np.maximum(1.0, np.abs(z))
        here, *there = residual(np.vstack([z, z + np.diag(step)])[None])
        return np.asarray((there - here).T / step)

    found = []
    for start in starts:
        # scipy before 1.16 takes steps of one scale unless asked, and ends beside the maximum
        found.append(least_squares(residual, start / scale, slopes, method="lm", x_scale="jac", max_nfev=60))
        if 2 * found[-1].cost < df + np.sqrt(2.0 * df):
            break
    best = min(found, key=lambda one: float(one.cost))
    J: Array = np.asarray(best.jac, np.float64)
    sd = np.sqrt(np.maximum(np.diag(np.linalg.pinv(J.T @ J, rcond=1e-12)), 0.0))
    return -float(best.cost), best.x * scale, sd * scale


def fit_base_model(point: WorkingPoint, i: int, c: SpectralCells) -> tuple[float, Array, Array]:
    """Log-likelihood and numbers (4,) of the base model at location i, and their scales (4,)."""
    scale = np.array([1.0, 1.0, point.kL[i] * 0.01, point.c[i] * 0.1 + 1e-9])
    least = point.S[i] * MIN_NOISE_RATIO / np.mean(c.noise_gain)
    quiet = np.array([np.log(point.S[i]), np.log(least), 0.0, 0.0])
    u0 = quiet.copy()
    u0[1] = np.log(point.nu[i] * point.S[i]) if point.nu[i] > 0.0 else quiet[1] - 10.0
    level, u, _ = _max_likelihood(c, base_model, [u0, quiet], scale)
    return level, u, scale


def spectral_causes(point: WorkingPoint, i: int) -> tuple[SpectralShape, ...]:
    """Shapes that the spectrum at location i may have."""
    data, peak = point.data, resonance_hz(point, i)
    pedestal = _pedestal_shape(data.mass[i], point.kL[i], point.c[i], peak)
    return _coloured_shape(peak), _resonance_shape(data.band[1]), pedestal


def pedestal_from_spectrum(point: WorkingPoint, i: int) -> tuple[Array, float, float]:
    """(3,) mass, frequency and damping of the pedestal that fits location i best, and kL and c beside it."""
    c = cells_of(point, i)
    _, u, scale = fit_base_model(point, i, c)
    shape = _pedestal_shape(point.data.mass[i], point.kL[i], point.c[i], resonance_hz(point, i))
    found = fit_shape(c, shape, u, scale)[1]
    return shape.values(found[4:]), float(point.kL[i] + found[2]), float(point.c[i] + found[3])


def coloured_force_level(point: WorkingPoint, i: int, gain: float, corner: float) -> Parameter:
    """S of a location with a shaped excitation, N^2/Hz.

    Gain and corner are fitted to the same spectrum, so S is far more uncertain than its number of bins suggests.
    """
    factor = coloured_excitation.shape(point.data.f_hz, (gain, corner))
    flat = replace(point, data=replace(point.data, excitation_shape=point.data.excitation_shape / factor))
    c, shape = cells_of(flat, i), _coloured_shape(resonance_hz(point, i))
    _, u, scale = fit_base_model(flat, i, c)
    u[0] = np.log(point.S[i])
    started = replace(shape, starts=((float(np.log(gain + LIMITS.max_dimming_share)), float(np.log(corner))),))
    sd = fit_shape(c, started, u, scale)[2][0]  # of ln S
    return Parameter.from_estimate(float(point.S[i]), float(point.S[i] * sd), "N^2/Hz")


def resonance_hz(point: WorkingPoint, i: int) -> float:
    """Resonance frequency of location i, Hz."""
    return float(np.sqrt(point.kL[i] / point.data.mass[i]) / (2 * np.pi))


def fit_shape(c: SpectralCells, shape: SpectralShape, u: Array, scale: Array) -> tuple[float, Array, Array]:
    """Largest log-likelihood of the base model with a cause, the numbers at it and their standard deviations.

    u : numbers of the base model. Its noise may be 0, so that ln of it is raised to a finite start.
    """
    base = np.array([u[0], max(u[1], u[0] + float(np.log(MIN_NOISE_RATIO / np.mean(c.noise_gain)))), *u[2:]])
    starts = [np.concatenate([base, s]) for s in shape.starts]
    if shape.idle:
        starts += [start - shape.idle * np.eye(start.size)[3] for start in starts]
    return _max_likelihood(c, shape.model, starts, np.concatenate([scale, np.full(len(shape.effect.parameters), 0.3)]))
