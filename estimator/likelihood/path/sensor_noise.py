"""Sensor noise referred to force: through the shaft, the noise of one bearing enters both residual forces.

The residual forces are r = A y = F + A n, with n the noise of the sensors and what sampling folds back. Where a shaft
couples the caps they are correlated, R = S + A N A^H. A force that follows the motion y has with r the mean product
T A^-1 R, T its mean response. With each row whitened by itself, W = 1 / diag R, the slope of the determinant T A^-1
leaves T A^-1 (R W - 1): noise of bearing 2 would look like a force at bearing 1 that follows bearing 2. So the response
of every force is taken as that to the measured motion, T A^-1 R W A. It is T where the rows are independent.

Where a force is measured and aliased motion is in it, the mean product is known without S: T (M B^H + A^-1 S), S of the
other places. Rows are still whitened as if their noise were nu |A|^2 S.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.motion_record import MotionRecord

MIN_CORRELATION = 1e-4  # of two residual forces, anywhere in the band; a smaller one is neglected


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorNoise:
    """Sensor noise in the residual forces, and the weights that whiten them.

    weight : (places, bins) S over the PSD of each residual force. share : (places, bins) share of sensor noise in that
    PSD. root : (bins, places) one over the root of that PSD. shared : (bins, places, places) correlations of the
    residual forces by noise; None where they are independent. folded : (bins, places, places) M B^H W, alone : (bins,
    places) S W of places without a measured force; both None where no aliased motion is in a measured force.
    """

    weight: Array
    share: Array
    root: Array
    shared: Complexes | None
    folded: Complexes | None = None
    alone: Array | None = None

    def correlation(self, i: int, j: int) -> Complexes | float:
        """(bins,) correlation of two residual forces by sensor noise."""
        return 0.0 if self.shared is None else np.asarray(self.shared[:, i, j])

    def to_measured(self, A: Complexes) -> Complexes | None:
        """(bins, places, places) factor from the response to the motion to the response to the measured motion.

        A : (bins, places, places) along the line of the determinant. None where the two responses are the same.
        """
        if self.folded is not None and self.alone is not None:
            return np.asarray(np.linalg.solve(A, self.alone[:, :, None] * A) + self.folded @ A)
        if self.shared is None:
            return None
        apart = self.shared * self.root[:, None, :] / self.root[:, :, None]  # R W - 1
        return np.asarray(np.eye(A.shape[1]) + np.linalg.solve(A, apart @ A))


def referred_noise(data: MotionRecord, A: Complexes, nu: Array, S: Array) -> SensorNoise:
    """Sensor noise in residual forces. A : (bins, places, places) kg. nu : (places,) noise over S. S : (places,)."""
    referred = referred_psd(data, A, nu * S) / S[:, None]
    weight = 1.0 / (data.excitation_shape + aliased_psd(data, A, S) + referred)
    P = len(data.places)
    noise = (data.noise_shape * nu[:, None] + data.folded) * S[:, None]
    R = np.einsum("kil,lk,kjl->kij", A, noise, A.conj())
    R[:, range(P), range(P)] = 0.0
    root = np.sqrt(weight / S[:, None]).T
    shared = R * root[:, :, None] * root[:, None, :]
    correlated = np.abs(shared).max(initial=0.0) > MIN_CORRELATION
    found = SensorNoise(weight=weight, share=referred * weight, root=root, shared=shared if correlated else None)
    if not data.folded_beside.any():
        return found
    B = A.copy()
    for i in np.flatnonzero(data.folded_beside.any(axis=1)):
        B[:, i, i] -= data.alike_beside[i]
        noise[i] = data.folded_beside[i]
    folded = np.einsum("lk,kjl->klj", noise, B.conj()) * root[:, None, :] ** 2
    return replace(
        found, folded=folded, alone=(data.excitation_shape * weight * (data.measured_force_psd == 0.0)[:, None]).T
    )


def force_correlation(data: MotionRecord, A: Complexes, weight: Array, i: int, j: int) -> Complexes:
    """(bins,) correlation of the residual forces of places i and j per correlation of their excitation.

    What sampling folds back of a common excitation is common too; sensor noise is not. weight : (places, bins).
    """
    own, back = np.sqrt(weight[i] * weight[j]), np.sqrt(data.folded[i] * data.folded[j])
    through = A[:, i, i] * A[:, j, j].conj() + A[:, i, j] * A[:, j, i].conj()
    return np.asarray(own * (np.sqrt(data.excitation_shape[i] * data.excitation_shape[j]) + back * through))


def aliased_psd(data: MotionRecord, A: Complexes, S: Array) -> Array:
    """(places, bins) PSD of the motion that sampling folds back, referred to force, over S."""
    return _through(A, data.folded * S[:, None]) / S[:, None]


def referred_psd(data: MotionRecord, A: Complexes, N: Array) -> Array:
    """(places, bins) PSD of sensor noise referred to force, N^2/Hz. N : (places,) PSD of white noise of the sensors."""
    return _through(A, data.noise_shape * N[:, None])


def _through(A: Complexes, noise: Array) -> Array:
    """(places, bins) N^2/Hz, PSD of the residual forces that noise (places, bins) of the accelerations causes."""
    return np.asarray(np.einsum("kil,lk->ik", np.abs(A) ** 2, noise))
