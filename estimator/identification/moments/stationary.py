"""The stationary density exp(-H/T), and tests whether a record obeys it.

With H = kinetic energy + V and force noise Q = 2 T C, velocities are Gaussian for any V, uncorrelated with each other
and with every displacement, and m v^2 is shared equally. Each statistic is given with its sampling error for correlated
samples. The tests are necessary, not sufficient: 1 % of undriven damping at the disc does not show in any of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from estimator.arrays import Array, Complexes
from estimator.errors import DataError
from estimator.results import Message, Parameter

from .batch_means import BlockMoments, propagate
from .planes import Cap, Plane
from .thresholds import LIMITS


def barrier(kL: float, kNL: float, temperature: float) -> float:
    """Potential barrier of a softening cubic in units of the temperature (J): kL^2 / (4 |kNL| T)."""
    return kL**2 / (4.0 * abs(kNL) * temperature)


def softening_message(plane: Plane, found: Mapping[str, Parameter], v: Array) -> list[Message]:
    """A line for each cap whose fitted cubic softens by more than 3 sd and has too low a barrier; v : (n, caps) m/s."""
    out = []
    for i, cap in enumerate(plane.caps):
        kL, kNL = found.get(f"{cap.place}.kL"), found.get(f"{cap.place}.cubic.kNL")
        if cap.mass is None or kL is None or kNL is None or kL.value is None or kNL.value is None:
            continue
        height = barrier(kL.value, kNL.value, cap.mass * float(np.mean(v[:, i] ** 2)))
        if kNL.value < -3.0 * (kNL.sd or 0.0) and height < 20.0:
            text = (
                f"{cap.place}: softening cubic kNL = {kNL.value:.3g} N/m^3 has no stationary density (barrier "
                f"{height:.1f} T, 20 needed): use the hertz effect, or a lower level of excitation"
            )
            out.append(Message("softens", text, cap.place))
    return out


@dataclass(frozen=True, slots=True, kw_only=True)
class Diagnostic:
    """A statistic of the record that exp(-H/T) predicts.

    name : what it is, with the place.
    value, expected : of the record and of exp(-H/T).
    sd : sampling error of the value.
    meaning : what a deviation means, for the user.
    """

    name: str
    value: float
    expected: float
    sd: float
    meaning: str

    @property
    def z(self) -> float:
        """Deviation in standard deviations."""
        return (self.value - self.expected) / self.sd if self.sd > 0.0 else 0.0


def _block_moments(rows: Array, blocks: int = LIMITS.diagnostic_blocks) -> BlockMoments:
    """Batch means of the columns of rows (n, K)."""
    moments = BlockMoments(rows.shape[1])
    size = max(1, len(rows) // blocks)
    for at in range(0, len(rows), size):
        part = rows[at : at + size]
        moments.add(part.sum(axis=0), len(part))
    return moments


def _statistic(
    rows: Array, function: Callable[[Complexes], Complexes], name: str, expected: float, meaning: str
) -> Diagnostic:
    """A statistic and its sampling error. function : of the K column means of rows (n, K), arrays of any shape."""
    (value,), covariance = propagate(lambda u: function(np.moveaxis(u, -1, 0))[..., None], _block_moments(rows))
    sd = float(np.sqrt(max(covariance[0, 0], 0.0)))
    return Diagnostic(name=name, value=float(value), expected=expected, sd=sd, meaning=meaning)


def _kurtosis(v: Array, name: str, meaning: str) -> Diagnostic:
    """Kurtosis of v (n,): 3 if it is Gaussian."""
    v = v / np.std(v)
    rows = np.stack([v, v**2, v**3, v**4], axis=1)

    def function(u: Complexes) -> Complexes:
        fourth = u[3] - 4.0 * u[0] * u[2] + 6.0 * u[0] ** 2 * u[1] - 3.0 * u[0] ** 4
        return np.asarray(fourth / (u[1] - u[0] ** 2) ** 2)

    return _statistic(rows, function, name, 3.0, meaning)


def _correlation(p: Array, q: Array, name: str, meaning: str) -> Diagnostic:
    """Correlation of p and q, (n,) each: 0 expected."""
    p, q = p / np.std(p), q / np.std(q)
    rows = np.stack([p * q, p**2, q**2], axis=1)
    return _statistic(rows, lambda u: u[0] / np.sqrt(u[1] * u[2]), name, 0.0, meaning)


def plane_diagnostics(plane: Plane, x: Array, v: Array) -> tuple[Diagnostic, ...]:
    """Statistics of one direction that the stationary density exp(-H/T) predicts.

    Parameters
    ----------
    plane : Plane
        The caps and the shaft of the direction.
    x : (n, caps) float64
        Band-limited displacement, m, without NaN.
    v : (n, caps) float64
        Band-limited velocity, m/s, without NaN.

    Returns
    -------
    tuple of Diagnostic
        Kurtosis of each velocity; for two caps also correlations, and equipartition if both masses are known.
    """
    out = []
    for i, cap in enumerate(plane.caps):
        out.append(_kurtosis(v[:, i], f"{cap.place}: kurtosis of velocity", "velocity is not Gaussian"))
    if len(plane.caps) == 2:
        one, two = plane.caps
        for i, j in ((0, 1), (1, 0)):
            name = f"corr(x {plane.caps[i].place}, v {plane.caps[j].place})"
            out.append(_correlation(x[:, i], v[:, j], name, "energy flows between the caps"))
        name = f"corr(v {one.place}, v {two.place})"
        out.append(_correlation(v[:, 0], v[:, 1], name, "forces at the caps are correlated, or the rotor couples them"))
        if one.mass is not None and two.mass is not None:
            out.append(_equipartition(one, two, v))
    return tuple(out)


def _equipartition(one: Cap, two: Cap, v: Array) -> Diagnostic:
    """Ratio of m v^2 of two caps of known mass: 1 expected. v : (n, 2) m/s."""
    scale = float(np.mean(v[:, 0] ** 2))
    ratio = (one.mass or 0.0) / (two.mass or 1.0)
    return _statistic(
        v**2 / scale,
        lambda u: np.asarray(ratio * u[0] / u[1]),
        f"m v^2 of {one.place} over {two.place}",
        1.0,
        "noise-to-damping ratios differ between the caps (or a mass or gain is wrong)",
    )


def density_messages(plane: Plane, x: Array, v: Array, limit: float = 4.0) -> list[Message]:
    """One line for each diagnostic that the record contradicts by more than `limit` standard deviations."""
    out = []
    for d in plane_diagnostics(plane, x, v):
        if abs(d.z) > limit:
            expected = f"the density exp(-H/T) of this method has {d.expected:g}"
            text = f"{d.name} is {d.value:.3g} +- {d.sd:.2g}, {expected}: {d.meaning}"
            out.append(Message("density_contradicted", text))
    return out


def check_resonance(v: Array, rate_hz: float, band: tuple[float, float], channel: str) -> None:
    """Raise DataError if the velocity spectrum (n,) peaks at an edge of the band: no resonance lies inside it.

    The velocity of a cap on its spring peaks at the resonance, rises towards it from below and falls above it.
    """
    from scipy.signal import welch

    f, power = welch(v, rate_hz, nperseg=min(2048, len(v)))
    power = np.convolve(power, np.ones(5) / 5.0, mode="same")
    inside = (f >= band[0]) & (f <= band[1])
    if inside.sum() < 8:
        raise DataError(f"band {band[0]:g}-{band[1]:g} Hz is too narrow for a fit: widen it around the resonance")
    peak = float(f[inside][np.argmax(power[inside])])
    side = "below" if peak < 1.06 * band[0] else "above" if peak > band[1] / 1.06 else ""
    if side:
        raise DataError(
            f"channel {channel}: no resonance inside the band {band[0]:g}-{band[1]:g} Hz (it seems to lie {side}): "
            "move the band over the bearing mode"
        )
