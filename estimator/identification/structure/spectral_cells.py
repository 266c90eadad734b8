"""Mean spectra of the residual force at one location in narrow cells, and their model for another tangent."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.likelihood.whitening.sensor_noise import referred_psd

MIN_NOISE_SHARE = 1e-3  # of the power of the noisiest sensor's noise, that every sensor is given
MAX_CELLS = 260  # over the band
MIN_KEPT_SHARE = 0.01  # of a bin, beside what lines leak into it


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

    def at(self, keep: NDArray[np.bool_]) -> SpectralCells:
        """The cells where keep (cells,) is true."""
        return SpectralCells(**{f.name: getattr(self, f.name)[..., keep] for f in fields(self)})

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
    N = np.maximum(N, MIN_NOISE_SHARE * N.max()) if N.any() else np.ones(N.size)
    return np.asarray(referred_psd(point.data, point.A, N)[i] / N[i])


def cells_of(point: WorkingPoint, i: int) -> SpectralCells:
    """Spectral cells of location i, about evenly spaced in log frequency, fine at the resonance."""
    data, power = point.data, mean_power(point, i)
    edges = np.unique(np.round(np.geomspace(12, power.size, MAX_CELLS)).astype(int))
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
    bins = np.flatnonzero(kept > MIN_KEPT_SHARE)
    return np.asarray(np.interp(np.arange(kept.size), bins, power[bins] / kept[bins]), np.float64)


def finite_exp(z: Array) -> Array:
    """exp of z, kept finite on the way to a maximum."""
    return np.asarray(np.exp(np.clip(z, -80.0, 20.0)))
