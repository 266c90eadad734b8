"""Correction of the moment equations for the band limit.

In band-limited signals the white force and the displacement of the same instant are correlated: the part of
E[x F] = 0 outside the band is missing. With receptance H, filter gain G and one-sided S

    beta = E[x_b F_b] = -S integral (1 - |G|^2) Re H df        Re H ~ 1/k below the resonance, -1/(m w^2) above it

It is -0.2 to +0.4 % of k E[x^2] on the paper's rig. Damping c and S follow from two more moments: the residual force
has variance S B = E[(m a + k x)^2] + c^2 E[v^2], B = integral |G|^2 df, and S = 4 c m E[v^2] (power in = power out).
They serve this correction only, for which an error of 10 % in c is harmless.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.signals.band_limit import passband

Number = complex | Complexes


@dataclass(frozen=True, slots=True)
class BandEdge:
    """The part of the spectrum that a band limit leaves out.

    hz : (n,) frequencies outside the flat band, Hz.
    measure : (n,) (1 - |G|^2) df there, Hz.
    width : B, Hz.
    above : frequency above which the receptance is that of the mass, Hz.
    """

    hz: Array
    measure: Array
    width: float
    above: float

    @classmethod
    def of(cls, rate_hz: float, band: tuple[float, float]) -> BandEdge:
        """The edges of the band-limiting filters at a sampling rate and band, Hz."""
        f: Array = np.linspace(0.0, 0.5 * rate_hz, 4001, dtype=np.float64)
        df = float(f[1])
        gain = passband(f, rate_hz, band) ** 2
        outside = gain < 1.0 - 1e-9
        # thinned: the receptance is smooth away from the resonance, which is inside
        step = 16
        hz, measure = f[outside], (1.0 - gain[outside]) * df
        groups = np.arange(0, len(hz), step)
        weight = np.add.reduceat(measure, groups)
        middle = np.add.reduceat(hz * measure, groups) / weight
        return cls(middle, weight, float(np.sum(gain) * df), 0.5 * rate_hz)

    def work(self, k: Number, m: float, xx: Number, vv: Number, aa: Number) -> Complexes:
        """beta, N m, of a cap; 0 where c is not positive. Analytic in its complex arguments, arrays of one shape.

        k : stiffness of bearing and shaft, N/m. m : kg. xx, vv, aa : mean squares of x, v, a.
        """
        k = np.asarray(k, complex)
        with np.errstate(divide="ignore", invalid="ignore"):
            residual = m * m * aa - 2.0 * m * k * vv + k * k * xx
            inner = (2.0 * m * self.width) ** 2 - residual / vv
            valid = (residual.real > 0.0) & (inner.real > 0.0)
            c = 2.0 * m * self.width - np.sqrt(np.where(valid, inner, 1.0))
        S = 4.0 * c * m * vv
        w = 2.0 * math.pi * self.hz
        stiff = k[..., None] - m * w**2
        real = stiff / (stiff * stiff + (c[..., None] * w) ** 2)
        tail = -1.0 / (m * (2.0 * math.pi) ** 2 * self.above)
        return np.where(valid, -S * (real @ self.measure + tail), 0.0)
