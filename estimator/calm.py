"""What laws see of a displacement that is measured with noise: of each frequency as much as is likely to be motion.

A law of x + e is bent: a cubic comes out weak by twice the share of e^2 in x^2. White noise of an accelerometer is
1 / w^4 in the displacement, and rules it where the sensor hears more of its own noise than of the force, at the lower
edge of the band. So laws see E[x | measured], by Wiener's filter, and are smoothed by what is then in doubt (the mean
of the law, given the measurement: regression calibration, Carroll et al., Measurement Error in Nonlinear Models, 2006,
ch. 4). The linear terms keep the displacement as it is, as the likelihood knows the noise in it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .flutter import LITTLE, variance
from .linear_memory import filtered
from .motion_blocks import MotionBlocks

Array = NDArray[np.float64]


def calmed(data: MotionBlocks, A: NDArray[np.complex128], nu: Array, S: Array) -> MotionBlocks:
    """The record as laws see it beside sensor noise; as it is where the noise is little or the force is measured.

    A : (bins, places, places) force per acceleration; nu : (places,) PSD of the sensors' noise over S; S : (places,).
    """
    x2 = data.rms[0] ** 2
    noise = nu * S * np.array([variance(kind, data.rate_hz, data.band) for kind in data.kinds])
    if data.measured_force or (noise <= LITTLE * x2).all():
        return replace(data, calm=None, doubt=np.zeros_like(data.left_out))
    f = data.f_hz
    w = 2 * np.pi * f
    gain = data.colour / (data.colour + nu[:, None] * data.heard(A))
    motion = S[:, None] * data.colour / np.abs(np.einsum("kii->ik", A)) ** 2 / w**4
    lost = np.stack([motion * (1.0 - gain), motion * (1.0 - gain) * w**2], axis=2).sum(axis=1)
    doubt = np.sqrt(lost * (data.rate_hz / data.block))

    def less(i: int) -> Array:
        return filtered(lambda at: np.interp(at, w, gain[i] - 1.0), data.x[i], data.rate_hz)

    return replace(data, calm=np.array([less(i) for i in range(len(x2))], np.float32), doubt=doubt)
