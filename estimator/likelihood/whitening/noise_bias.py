"""The likelihood where the force is measured at every place and the residual force is noise: no determinant.

What is left, r = F(y) - f, is noise of the sensors: A n of those of motion and e of those of force, S_r = |A|^2 N + S.
The true force may be anything: every bin has an unknown of its own. With the determinant c would be too large by S over
the power of the force, as f is no random number about the measured force. At its most likely value the unknown force
leaves |r|^2 / S_r. The slope of that by A is the slope of S_r, which the noise in y adds (errors in variables). So the
slope of S_r over S_r, with S_r held, takes the place of the slope of the determinant.
"""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array, Complexes

from .determinant import Jacobian


class NoiseBias(Jacobian):
    """Power of the sensor noise in the residual forces over their PSD, summed over bins, in place of the determinant.

    A0 : (bins, places, places) kg, A at the working point. noise : (places, bins) PSD of the noise of each motion
    sensor, as acceleration. per_psd : (places, bins) one over the PSD of each residual force, Hz/N^2. kept : (bins,)
    share of each bin in the likelihood; None: 1.
    """

    def __init__(self, A0: Complexes, noise: Array, per_psd: Array, kept: Array | None = None) -> None:
        kept = np.ones(len(A0)) if kept is None else kept
        super().__init__(A0)
        self._share = np.einsum("f,if,jf->fij", kept, per_psd, noise)  # of noise of sensor j in force i

    def value(self, tangents: Complexes, delta: Array) -> float:
        """The sum at increments delta (k,), nats."""
        return float(np.sum(np.abs(self.tangent_matrix(tangents, delta)) ** 2 * self._share))

    def slopes(self, tangents: Complexes, delta: Array) -> tuple[Array, Complexes]:
        """Gradient (k,) by the increments, and slopes (places, places, bins) by the elements of A."""
        by_matrix = 2 * np.moveaxis(self.tangent_matrix(tangents, delta).conj() * self._share, 0, -1)
        return np.einsum("ijf,kijf->k", by_matrix, tangents, optimize=True).real, by_matrix

    def derivatives(self, tangents: Complexes, delta: Array) -> tuple[Array, Array]:
        """Gradient (k,) and Hessian (k, k) by the increments."""
        weighted = self.tangent_matrix(tangents, delta).conj() * self._share
        gradient = 2 * np.einsum("fij,kijf->k", weighted, tangents, optimize=True).real
        flat = tangents.reshape(len(tangents), -1)
        share = np.moveaxis(self._share, 0, -1).ravel()
        return gradient, 2 * ((flat.conj() * share) @ flat.T).real
