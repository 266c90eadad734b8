"""Leakage of a disc resonance between blocks, projected out of the block spectra.

A disc rings for seconds on its shaft, a block lasts a third of a second. The part of the residual force that rings with
it, such as sensor noise through the shaft, ends at both ends of every block. That spreads it over all bins with one
shape, 1 / (f - f0) and, as it decays, 1 / (f - f0)^2. The shapes are projected out of every series alike, and the lost
share of each bin is counted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.likelihood.motion.motion_record import MotionRecord


@dataclass(frozen=True, slots=True)
class Ringing:
    """Shapes of the leakage of a disc resonance.

    shapes : (places, 2 bins, 6) orthonormal, of whitened spectra. kept : (places, bins) share of each bin that remains.
    """

    shapes: NDArray[np.float32]
    kept: Array

    def take_out(self, i: int, Z: NDArray[np.float32]) -> None:
        """Project the shapes out of spectra Z (blocks, 2 bins) at place i, in place. It needs as much memory again."""
        own = self.shapes[i]
        Z -= (Z @ own) @ own.T


def ringing(data: MotionRecord, weights: NDArray[np.floating]) -> Ringing | None:
    """The shapes; None where no disc resonates in the band. weights : (places, bins) of the spectra."""
    if data.disc is None or not data.band[0] < (f0 := data.disc.w0 / (2 * np.pi)) < data.band[1]:
        return None
    f = data.f_hz  # the notch of the shaft leaves f0 out
    forms = np.stack([1 / (f - f0), 1 / (f - f0) ** 2, 1 / (f + f0)], axis=1)
    shapes, kept = [], []
    for own in weights:
        Q, _ = np.linalg.qr(own[:, None] * forms / np.linalg.norm(forms, axis=0))
        kept.append(1.0 - np.sum(Q**2, axis=1))
        shapes.append(np.kron(Q, np.eye(2)))
    return Ringing(np.array(shapes, np.float32), np.array(kept))
