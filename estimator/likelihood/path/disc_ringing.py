"""What a disc that rings in the band sends from block to block, taken out of the block spectra.

A disc rings for seconds on its shaft, a block is a third of one. What of the inferred force rings with it, as noise of
the sensors through the shaft does, ends at both ends of every block, which spreads it over all bins with one shape,
1 / (f - f0) and, as it decays, 1 / (f - f0)^2. That is taken out of every series alike, and counted: beside bins that
fits leave out (balance.shaft_notch) the force of a complete model was 70 % too strong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.arrays import Array
from estimator.likelihood.motion.motion_record import MotionRecord


@dataclass(frozen=True, slots=True)
class Ringing:
    """shapes : (places, 2 bins, 6) orthonormal, of weighted spectra. kept : (places, bins) share that is left."""

    shapes: NDArray[np.float32]
    kept: Array

    def take_out(self, i: int, Z: NDArray[np.float32]) -> None:
        """From spectra at place i, (blocks, 2 bins), in place; a few blocks, as what is taken out is as large."""
        own = self.shapes[i]
        Z -= (Z @ own) @ own.T


def ringing(data: MotionRecord, weights: NDArray[np.floating]) -> Ringing | None:
    """None where no disc rings in the band. weights : (places, bins) of the spectra."""
    if data.disc is None or not data.band[0] < (f0 := data.disc.w0 / (2 * np.pi)) < data.band[1]:
        return None
    f = data.f_hz  # without f0: balance.shaft_notch
    forms = np.stack([1 / (f - f0), 1 / (f - f0) ** 2, 1 / (f + f0)], axis=1)
    shapes, kept = [], []
    for own in weights:
        Q, _ = np.linalg.qr(own[:, None] * forms / np.linalg.norm(forms, axis=0))
        kept.append(1.0 - np.sum(Q**2, axis=1))
        shapes.append(np.kron(Q, np.eye(2)))
    return Ringing(np.array(shapes, np.float32), np.array(kept))
