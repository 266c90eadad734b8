"""Denoised displacement where the force is measured: the most likely motion given the motion and the force.

In the band the acceleration is measured as y with noise N, and through the rotor by the force with noise S. The
residual force r = A y - f is noise, A n - q. Of the noise in y it determines N A^H R^-1 r, with R = A N A^H + S. The
remaining error of the motion is independent of r, so it does not bias a law along the motion. The motion alone can only
leave out what is noise at the lower end of the band, and the motion there with it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.likelihood.motion.denoise import noise_displacement_psd, noise_is_negligible
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.parallel import map_threads

SETTLED_REL = 1e-3  # change of the denoised displacement over the rms displacement that moves no parameter


def denoised_by_force(point: WorkingPoint, nu: Array) -> tuple[NDArray[np.float32] | None, Array | float]:
    """Denoised minus measured displacement (places, n) m, and sd of the remaining error (places, 2), m and m/s.

    None and 0 where the noise is negligible. nu : (places,) PSD of the sensor noise over S.
    """
    from scipy.fft import irfft, next_fast_len, rfft

    data, A = point.data, point.A
    f_hz, w = data.f_hz, 2 * np.pi * data.f_hz
    N = data.noise_shape * (nu * point.S)[:, None]
    if noise_is_negligible(f_hz, noise_displacement_psd(data.kinds, f_hz, nu * point.S), data.rms[0] ** 2):
        return None, 0.0
    df = np.gradient(f_hz)
    through = N.T[:, :, None] * A.conj().transpose(0, 2, 1)  # N A^H
    known = through @ np.linalg.inv(A @ through + np.diag(point.S))
    left = N - np.einsum("kij,kji->ik", known, A * N.T[:, None, :]).real
    doubt = np.sqrt(np.stack([(left / w**4) @ df, (left / w**2) @ df], axis=1))

    n = point.force.shape[1]
    size = next_fast_len(n, real=True)
    there: Array = 2 * np.pi * np.asarray(np.fft.rfftfreq(size, 1 / data.rate_hz), dtype=np.float64)
    residual = point.force if data.slow is None else point.force - _below_band_stiffness(point) @ data.slow
    forces = map_threads(lambda force: rfft(force, size), residual)
    inside = there > np.pi * data.band[0]  # below half of it nothing is measured

    def at(i: int) -> Array:
        correction = np.sum([np.interp(there, w, known[:, i, j] / w**2) * F for j, F in enumerate(forces)], axis=0)
        return np.asarray(irfft(correction * inside, size)[:n])

    return np.array(map_threads(at, range(len(N))), np.float32), doubt


def _below_band_stiffness(point: WorkingPoint) -> NDArray[np.float32]:
    """(places, places) N/m, response of the laws to the below-band displacement, which is not measured."""
    return np.asarray(point.mean_tangent[..., 0] - np.diag(point.kL), np.float32)


def is_settled(point: WorkingPoint, correction: NDArray[np.float32] | None) -> bool:
    """Whether denoised minus measured displacement (places, n) is that of the point; None: 0."""
    before = point.data.denoise_correction
    if correction is None or before is None:
        return correction is before
    return bool(np.all(np.mean((correction - before) ** 2, axis=1) <= SETTLED_REL**2 * point.data.rms[0] ** 2))
