"""Sensor noise referred to force: through the shaft, the noise of one bearing enters both residual forces.

The residual forces are r = A y = F + A n, with n the noise of the sensors. Where a shaft couples the caps they
are correlated, R = S + A N A^H. A force that follows the motion y has with r the mean product T A^-1 R, T its mean
response. With each row whitened by itself, W = 1 / diag R, the slope of the determinant T A^-1 leaves T A^-1 (R W - 1):
noise of bearing 2 would look like a force at bearing 1 that follows bearing 2. So the response of every force is taken
as that to the measured motion, T A^-1 R W A. It is T where the rows are independent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.motion_record import MotionRecord
from estimator.likelihood.thresholds import LIMITS


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorNoise:
    """Sensor noise in the residual forces, and the weights that whiten them.

    weight : (places, bins) S over the PSD of each residual force. share : (places, bins) share of sensor noise in that
    PSD. root : (bins, places) one over the root of that PSD. shared : (bins, places, places) correlations of the
    residual forces by noise; None where they are independent.
    """

    weight: Array
    share: Array
    root: Array
    shared: Complexes | None

    def correlation(self, i: int, j: int) -> Complexes | float:
        """(bins,) correlation of two residual forces by sensor noise."""
        return 0.0 if self.shared is None else np.asarray(self.shared[:, i, j])

    def to_measured(self, A: Complexes) -> Complexes | None:
        """(bins, places, places) factor from the response to the motion to the response to the measured motion.

        A : (bins, places, places) along the line of the determinant. None where the two responses are the same.
        """
        if self.shared is None:
            return None
        apart = self.shared * self.root[:, None, :] / self.root[:, :, None]  # R W - 1
        return np.asarray(np.eye(A.shape[1]) + np.linalg.solve(A, apart @ A))


def referred_noise(data: MotionRecord, A: Complexes, nu: Array, S: Array) -> SensorNoise:
    """Sensor noise in residual forces. A : (bins, places, places) kg. nu : (places,) noise over S. S : (places,)."""
    referred = referred_psd(data, A, nu * S) / S[:, None]
    weight = 1.0 / (data.excitation_shape + referred)
    P = len(data.places)
    noise = data.noise_shape * (nu * S)[:, None]
    R = np.einsum("kil,lk,kjl->kij", A, noise, A.conj())
    R[:, range(P), range(P)] = 0.0
    root = np.sqrt(weight / S[:, None]).T
    shared = R * root[:, :, None] * root[:, None, :]
    correlated = np.abs(shared).max(initial=0.0) > LIMITS.min_correlation
    return SensorNoise(weight=weight, share=referred * weight, root=root, shared=shared if correlated else None)


def force_correlation(data: MotionRecord, weight: Array, i: int, j: int) -> Complexes:
    """(bins,) correlation of the residual forces of places i and j per correlation of their excitation.

    weight : (places, bins).
    """
    root_weight = np.sqrt(weight[i] * weight[j])
    return np.asarray(root_weight * np.sqrt(data.excitation_shape[i] * data.excitation_shape[j]), complex)


def referred_psd(data: MotionRecord, A: Complexes, N: Array) -> Array:
    """(places, bins) PSD of sensor noise referred to force, N^2/Hz. N : (places,) PSD of white noise of the sensors."""
    return np.asarray(np.einsum("kil,lk->ik", np.abs(A) ** 2, data.noise_shape * N[:, None]))
