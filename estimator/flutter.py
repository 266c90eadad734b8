"""What the noise e of a sensor does in the laws, as the displacement that it looks like, and that it is taken out.

Noise enters the force of a law as phi'(x) e + phi''(x) e^2 / 2. The mean tangent is seen through A. By what the tangent
fluctuates, kappa, noise adds to the column of the law, which least squares would bend the law to shrink: kappa e, whose
covariance is the product of the two, as they are independent. The second part has the mean <e^2> phi'' / 2, which
looks like a stiffness, and varies about it. As seen, kappa holds noise too, phi'' e, twice what that varies by: half of
it is taken off, with phi'' as the regression of kappa on x^2 has it. White noise of an accelerometer is 1 / w^4 in e:
strong at the lower edge of the band.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .bandlimit import passband
from .columns import Columns
from .dressing import Fluctuating
from .record import Record

Floats = NDArray[np.float64]
POWER = {"displacement": 0, "velocity": 2, "acceleration": 4}  # of 1 / w, from the sensor's noise to that of x
LITTLE = 5e-4  # of <x^2>: noise under it moves no law by more than twice as much
FINEST = 8  # the spectrum of the noise is sharper at its lower edge than that of a tangent by so much


@dataclass(frozen=True, slots=True)
class Flutter:
    """Per unit of each law and, but for the first two, of the PSD of each sensor's noise; 0 for what does not matter.

    covariance : (places, columns, columns) of the tangents along x, (N/m)^2. bend : (places, columns) N/m^3, half the
    curvature of the tangent. variance : (places,) m^2 of e. power : (places, cells, columns, columns) N^2/Hz.
    """

    covariance: Floats
    bend: Floats
    variance: Floats
    power: Floats

    def without(self, noise: Floats, gram: Floats, count: Floats, tangents: Floats) -> tuple[Floats, Floats]:
        """Gram matrices (..., cells, k, k) of `count` bins (..., cells, 1, 1) and mean tangents (k, 4) without it.

        noise : (places,) one-sided PSD of the sensors.
        """
        P, k = self.bend.shape
        e2 = noise * self.variance
        straight = np.eye(k)
        straight[:, 2 * P : 3 * P] -= (e2[:, None] * self.bend).T
        slope = tangents.copy()
        slope[:, 0] -= e2 @ self.bend
        return straight @ (gram - count * np.einsum("i,icjk->cjk", noise, self.power)) @ straight.T, slope

    def scaled(self, covariance: Floats, bend: Floats) -> Flutter:
        """The same when the motion has become larger or smaller, with what that makes of the first two."""
        before, now = (np.sqrt(np.maximum(np.einsum("ikk->ik", z), 0.0)) for z in (self.covariance, covariance))
        size = np.divide(now, before, out=np.zeros_like(now), where=before > 0.0)
        return Flutter(covariance, bend, self.variance, self.power * (size[:, :, None] * size[:, None])[:, None])


def seen_as(kind: str, f_hz: Floats, rate_hz: float, band: tuple[float, float]) -> Floats:
    """(f,) PSD of e per unit of the PSD of a sensor of this kind, at positive frequencies."""
    return np.asarray(passband(f_hz, rate_hz, band) ** 2 / (2 * np.pi * f_hz) ** POWER[kind])


def variance(kind: str, rate_hz: float, band: tuple[float, float]) -> float:
    """<e^2> in m^2 per unit of the PSD."""
    f = np.linspace(0.0, 0.5 * rate_hz, 4001)[1:]
    return float(seen_as(kind, f, rate_hz, band).sum() * f[0])


def noisy(record: Record, columns: Columns, noise: Floats) -> list[int]:
    """The places where the noise of the sensor, of this PSD, is more than a little of the displacement."""
    x2 = record.rms("x") ** 2
    each = (variance(kind, record.rate_hz, record.model.band) for kind in columns.balance.kinds)
    return [row for row, e2 in enumerate(each) if noise[row] * e2 > LITTLE * x2[row]]


def flutter(found: list[Fluctuating], record: Record, columns: Columns, noise: Floats) -> Flutter | None:
    """Of the places where it matters; None where there are none."""
    balance, grid = columns.balance, record.grid
    P, K = len(balance.places), len(balance.columns)
    out = Flutter(np.zeros((P, K, K)), np.zeros((P, K)), np.zeros(P), np.zeros((P, grid.starts.size, K, K)))
    rows = noisy(record, columns, noise)
    for z in found:
        if z.row in rows:
            kind = balance.kinds[z.row]
            out.covariance[z.row, z.laws[:, None], z.laws] = z.C[:, :, 0, 0, 0]
            out.bend[z.row, z.laws] = z.bend
            out.variance[z.row] = variance(kind, record.rate_hz, record.model.band)
            power = _products(z, record, kind, float(noise[z.row]))
            out.power[z.row][:, z.laws[:, None], z.laws] = np.moveaxis(power, -1, 0)
    return out if out.variance.any() else None


def _products(z: Fluctuating, record: Record, kind: str, noise: float) -> Floats:
    """(laws, laws, cells) one-sided PSD of what the laws get from e, real part, per unit of the noise."""
    C, grid = z.C[:, :, 0, 0], record.grid
    lags = C.shape[2]
    f = np.asarray(np.fft.rfftfreq(2 * FINEST * lags, z.dt), np.float64)
    D = np.append(0.0, seen_as(kind, f[1:], record.rate_hz, record.model.band))
    e = np.fft.irfft(D)[:lags] * (f.size - 1) * f[1]
    t = np.asarray(np.arange(lags) * z.dt, np.float64)
    half = 2.0 * np.multiply.outer(z.bend, z.bend)[:, :, None] * z.mean.autocovariance(t) * (z.x2 - noise * e[0])
    weight = 4.0 * z.dt * np.exp(-((t / (0.8 * t[-1])) ** 8))
    weight[0] *= 0.5
    both = (0.5 * (C + C.swapaxes(0, 1)) - half * noise * e) * (e * weight)
    spectrum = np.fft.rfft(both, 2 * lags, axis=2).real
    bins = np.array([[np.interp(grid.f_hz, f[::FINEST], row) for row in rows] for rows in spectrum])
    return np.add.reduceat(bins, grid.starts, axis=2) / grid.per_cell
