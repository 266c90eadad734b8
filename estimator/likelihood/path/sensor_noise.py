"""How the noise of the sensors comes into the inferred forces: through the shaft, that of one bearing into both.

The inferred forces are r = A y = F + A n, with the noise n of the sensors, and with what sampling folds back, which is
noise of a sensor to all that is inferred. So they are not independent where a shaft couples the caps, R = S + A N A^H,
and a force that follows the motion y has with r the mean product T A^-1 R, T its mean response. Rows weighed apart, by
W = 1 / diag R, leave of that T A^-1 (R W - 1) beside the slope of the determinant, T A^-1: noise of bearing 2 would be
taken for a force at bearing 1 that follows bearing 2 (0.6 % of the bearing force, beside a shaft half as stiff as a
bearing, behind a Bessel filter of order 6 at 0.45 of the rate). So the response of every force is taken as that to what
is measured, T A^-1 R W A, which is T where the rows are independent.

Where a force is measured and something is folded back beside it (folded_force.py), the mean product is known without
S, which is noise of the sensor of the force there and moves nothing: T (M B^H + A^-1 S), S of the other places. Rows
are still weighed as if their noise were nu |A|^2, S: by its own density, so little near the end of the band that the
harmonics of laws rule the fit there, a force with a jump came out 10 % too weak, by what noise does to its instants.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.likelihood.motion.motion_record import MotionRecord

MIN_CORRELATION = 1e-4  # correlation of two rows, anywhere in the band, that moves nothing


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorNoise:
    """weight : (places, bins), S over the PSD of each inferred force; root : (bins, places) one over its root. share :
    (places, bins) what of that PSD is noise of sensors, which does not rise with the force. shared : (bins, places,
    places) correlations of these forces by noise; None where they are independent. folded : (bins, places, places)
    M B^H W; alone : (bins, places) S W of places without a measured force; None where nothing is folded beside one."""

    weight: Array
    share: Array
    root: Array
    shared: Complexes | None
    folded: Complexes | None = None
    alone: Array | None = None

    def correlation(self, i: int, j: int) -> Complexes | float:
        """(bins,) correlation of two inferred forces by noise."""
        return 0.0 if self.shared is None else np.asarray(self.shared[:, i, j])

    def to_measured(self, A: Complexes) -> Complexes | None:
        """(bins, places, places) from the response to the motion to that to what is measured; A as the determinant has
        it."""
        if self.folded is not None and self.alone is not None:
            return np.asarray(np.linalg.solve(A, self.alone[:, :, None] * A) + self.folded @ A)
        if self.shared is None:
            return None
        apart = self.shared * self.root[:, None, :] / self.root[:, :, None]  # R W - 1
        return np.asarray(np.eye(A.shape[1]) + np.linalg.solve(A, apart @ A))


def referred_noise(data: MotionRecord, A: Complexes, nu: Array, S: Array) -> SensorNoise:
    """A : (bins, places, places). nu : (places,) noise of the sensors over S. S : (places,)."""
    referred = referred_psd(data, A, nu * S) / S[:, None]
    weight = 1.0 / (data.colour + aliased_psd(data, A, S) + referred)
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
    return replace(found, folded=folded, alone=(data.colour * weight * (data.driven == 0.0)[:, None]).T)


def force_correlation(data: MotionRecord, A: Complexes, weight: Array, i: int, j: int) -> Complexes:
    """(bins,) correlation of two inferred forces over that of the forces that there are: what sampling folds back of a
    common force is common too, noise of sensors is not."""
    own, back = np.sqrt(weight[i] * weight[j]), np.sqrt(data.folded[i] * data.folded[j])
    through = A[:, i, i] * A[:, j, j].conj() + A[:, i, j] * A[:, j, i].conj()
    return np.asarray(own * (np.sqrt(data.colour[i] * data.colour[j]) + back * through))


def aliased_psd(data: MotionRecord, A: Complexes, S: Array) -> Array:
    """(places, bins) PSD over S of each inferred force of what is folded back at all places."""
    return _through(A, data.folded * S[:, None]) / S[:, None]


def referred_psd(data: MotionRecord, A: Complexes, N: Array) -> Array:
    """(places, bins) the same, not over S, of white noise N (places,) of all sensors."""
    return _through(A, data.noise_shape * N[:, None])


def _through(A: Complexes, noise: Array) -> Array:
    """(places, bins) PSD of the forces that are inferred from noise (places, bins) of the accelerations."""
    return np.asarray(np.einsum("kil,lk->ik", np.abs(A) ** 2, noise))
