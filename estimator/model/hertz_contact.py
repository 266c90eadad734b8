"""Hertz contact of a ball with a raceway, by complete elliptic integrals; no tables, no curve fits.

Harris, Rolling Bearing Analysis (4th ed.), eqs (6.26)-(6.43). Curvatures 1/R are positive for convex bodies.
With kappa = a/b >= 1 the ellipse of contact, K and E complete elliptic integrals of modulus^2 = 1 - 1/kappa^2:

    F(rho)  = [(kappa^2 + 1) E - 2 K] / [(kappa^2 - 1) E] = |curvature difference| / sum
    delta*  = (2 K/pi) [pi / (2 kappa^2 E)]^(1/3)
    delta   = delta* [3 Q / (2 sum) . 2 (1 - nu^2)/E_young]^(2/3) . sum / 2
    K       = Q / delta^1.5 = STEEL_CONTACT_MODULUS_PA . sum^(-1/2) . delta*^(-3/2)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from estimator.errors import DataError

from .rig import BearingGeometry

# Pa. The rounded constant of Harris, 2.15e5 N/mm^2, which gives the K_n of physics.md section 4. Unrounded,
# (4 sqrt 2/3) E / (2 (1 - nu^2)) is 2.1446e5 N/mm^2 for E = 2.07e5 N/mm^2 and nu = 0.3: 0.25 % less.
STEEL_CONTACT_MODULUS_PA = 2.15e11


@dataclass(frozen=True, slots=True, kw_only=True)
class PointContact:
    """One ball on one raceway. curvature_sum in 1/m; delta_star dimensionless; stiffness in N/m^1.5."""

    curvature_sum: float
    curvature_difference: float
    ellipse_ratio: float
    delta_star: float
    stiffness: float


def ellipse_ratio(difference: float) -> float:
    """kappa = a/b for a curvature difference F(rho) in [0, 1)."""
    from scipy.optimize import brentq
    from scipy.special import ellipe, ellipk

    if not 0.0 <= difference < 1.0:
        raise ValueError(f"curvature difference {difference:.6g} outside [0, 1): not a point contact")
    if difference < 1e-6:  # F(rho) = (3/4) (kappa - 1) + ..., lost to rounding in the formula
        return 1.0 + difference * 4.0 / 3.0

    def excess(log_kappa: float) -> float:
        square = math.exp(2.0 * log_kappa)
        m = 1.0 - 1.0 / square
        return float(((square + 1.0) * ellipe(m) - 2.0 * ellipk(m)) / ((square - 1.0) * ellipe(m))) - difference

    return math.exp(float(brentq(excess, 1e-7, 18.0, xtol=1e-14)))


def delta_star(kappa: float) -> float:
    """Dimensionless approach delta* of an ellipse ratio kappa >= 1."""
    from scipy.special import ellipe, ellipk

    m = 1.0 - 1.0 / kappa**2
    return float(2.0 / math.pi * ellipk(m) * (math.pi / (2.0 * kappa**2 * ellipe(m))) ** (1.0 / 3.0))


def point_contact(first: tuple[float, float], second: tuple[float, float]) -> PointContact:
    """Contact of a body with curvatures `first` and one with `second` (1/m; axial plane, rolling plane), equal steels.

    The principal planes of the two bodies coincide, as they do for a ball in a groove.
    """
    total = sum(first) + sum(second)
    if total <= 0.0:
        raise ValueError("curvature sum not positive: the groove is tighter than the ball")
    difference = abs((first[0] - first[1]) + (second[0] - second[1])) / total
    kappa = ellipse_ratio(difference)
    star = delta_star(kappa)
    return PointContact(
        curvature_sum=total,
        curvature_difference=difference,
        ellipse_ratio=kappa,
        delta_star=star,
        stiffness=STEEL_CONTACT_MODULUS_PA * total**-0.5 * star**-1.5,
    )


def raceways(bearing: BearingGeometry) -> tuple[PointContact, PointContact]:
    """Inner and outer contact of a ball bearing (both grooves of `groove_radius`)."""
    ball = 2.0 / bearing.ball_diameter
    across = bearing.ball_diameter * math.cos(bearing.contact_angle)
    inner, outer = bearing.pitch_diameter - across, bearing.pitch_diameter + across
    if bearing.groove_radius is None:
        raise DataError("rig.bearing: the contact of ball and raceway needs groove_radius_mm; add it")
    groove = -1.0 / bearing.groove_radius
    return point_contact((ball, ball), (groove, 2.0 / inner)), point_contact((ball, ball), (groove, -2.0 / outer))


def load_deflection(bearing: BearingGeometry) -> float:
    """K_n in N/m^1.5: load over approach^1.5 of one ball between the two raceways (inner and outer in series)."""
    inner, outer = raceways(bearing)
    series = inner.stiffness ** (-2.0 / 3.0) + outer.stiffness ** (-2.0 / 3.0)
    return float(series**-1.5)
