"""Theoretical stiffness of a ball bearing against preload: section 6 of the paper, with the transverse balance solved.

    F_j = K_n (g + x cos th_j + y sin th_j)_+^1.5,   F(x) = sum F_j cos th_j,   sum F_j sin th_j = 0 fixes y(x)

g > 0 radial preload, g < 0 clearance; k = dF/dx (tangent) and F/x (secant). Small x, Z balls, g > 0:

    F = (3 Z/4) K_n sqrt(g) x - (3 Z/128) K_n g^(-3/2) x^3

It softens until x ~ g and hardens beyond, so a fitted cubic depends on the amplitude it was fitted over.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from estimator.arrays import Array
from estimator.errors import DataError
from estimator.results import Fit, Parameter

from .hertz_contact import PointContact, load_deflection, raceways
from .rig import BearingGeometry, Model
from .thresholds import LIMITS


@dataclass(frozen=True, slots=True)
class Quadratic:
    """k(x) = k0 + k2 x^2 in N/m and N/m^3, least squares over |x| <= reach (m); largest error in percent of k0."""

    k0: float
    k2: float
    reach: float
    error_percent: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """Stiffness at one preload.

    Attributes
    ----------
    preload : float
        Radial preload, m.
    x, force, tangent, secant : (n,) float64
        Displacement (m), force (N), and its tangent and secant (N/m).
    kL : float
        Tangent at x = 0, N/m.
    kNL : float or None
        Coefficient of x^3 in the force at x = 0, N/m^3; None with clearance, where the force has no such term.
    """

    preload: float
    x: Array
    force: Array
    tangent: Array
    secant: Array
    kL: float
    kNL: float | None
    tangent_quadratic: Quadratic
    secant_quadratic: Quadratic


@dataclass(frozen=True, slots=True, kw_only=True)
class FittedRow:
    """A fitted place beside the theory: the preload that its kL implies, and the kNL of the theory at that preload."""

    place: str
    kL: Parameter
    kNL: Parameter | None
    preload_implied: float | None
    preload_sd: float | None
    theory_kNL: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Theory:
    """Hertz stiffness of the rig's bearing.

    Attributes
    ----------
    bearing : BearingGeometry
        Its geometry.
    inner, outer : PointContact
        Contacts of a ball with the raceways.
    K_n : float
        Load over deflection^1.5 of a ball, N/m^1.5.
    kinematics : mapping of str to float
        Orders of the shaft speed by name.
    curves : tuple of Curve
        Stiffness by preload.
    fitted : tuple of FittedRow
        Stiffness by location.
    """

    bearing: BearingGeometry
    inner: PointContact
    outer: PointContact
    K_n: float
    kinematics: Mapping[str, float]
    curves: tuple[Curve, ...]
    fitted: tuple[FittedRow, ...]

    def table(self) -> list[dict[str, float | str | None]]:
        """The paper's Table 3 as rows: stiffness in N/mm and N/mm^3 by preload, and the fitted places beneath."""
        rows: list[dict[str, float | str | None]] = [
            {
                "row": "theory",
                "preload_um": curve.preload * 1e6,
                "kL_N_per_mm": curve.kL * 1e-3,
                "kNL_N_per_mm3": None if curve.kNL is None else curve.kNL * 1e-9,
                "tangent_k0": curve.tangent_quadratic.k0 * 1e-3,
                "tangent_k2": curve.tangent_quadratic.k2 * 1e-9,
                "secant_k0": curve.secant_quadratic.k0 * 1e-3,
                "secant_k2": curve.secant_quadratic.k2 * 1e-9,
            }
            for curve in self.curves
        ]
        for fit in self.fitted:
            kL, kNL = fit.kL.value, fit.kNL.value if fit.kNL else None
            rows.append(
                {
                    "row": fit.place,
                    "preload_um": None if fit.preload_implied is None else fit.preload_implied * 1e6,
                    "kL_N_per_mm": None if kL is None else kL * 1e-3,
                    "kNL_N_per_mm3": None if kNL is None else kNL * 1e-9,
                }
            )
        return rows

    def to_json(self) -> dict[str, Any]:
        """Everything, in SI (lengths in m), with `"schema": 1`."""
        arrays = ("x", "force", "tangent", "secant")
        curves = [asdict(own) | {name: getattr(own, name).tolist() for name in arrays} for own in self.curves]
        fitted = [
            asdict(row) | {"kL": row.kL.to_json(), "kNL": row.kNL.to_json() if row.kNL else None} for row in self.fitted
        ]
        return {
            "schema": 1,
            "bearing": asdict(self.bearing),
            "inner": asdict(self.inner),
            "outer": asdict(self.outer),
            "K_n": self.K_n,
            "kinematics": dict(self.kinematics),
            "curves": curves,
            "table": self.table(),
            "fitted": fitted,
        }


def kinematics(bearing: BearingGeometry) -> dict[str, float]:
    """Cage, ball-pass and ball-spin frequencies per shaft revolution, outer ring fixed, pure rolling.

    Parameters
    ----------
    bearing : BearingGeometry
        Numbers of balls, diameters and contact angle.
    """
    ratio = bearing.ball_diameter / bearing.pitch_diameter * math.cos(bearing.contact_angle)
    return {
        "FTF": 0.5 * (1.0 - ratio),
        "BPFO": 0.5 * bearing.balls * (1.0 - ratio),
        "BPFI": 0.5 * bearing.balls * (1.0 + ratio),
        "BSF": 0.5 * bearing.pitch_diameter / bearing.ball_diameter * (1.0 - ratio**2),
    }


def ball_angles(bearing: BearingGeometry, phase: float = 0.0) -> Array:
    """(Z,) angles of the balls from x, rad; phase 0 puts a ball on the x axis."""
    return phase + 2.0 * math.pi * np.arange(bearing.balls) / bearing.balls


def radial_force(
    bearing: BearingGeometry, preload: float, x: Array, phase: float = 0.0
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Restoring force, tangent stiffness and transverse displacement, each (n,): N, N/m, m.

    x : (n,) m. The transverse balance is solved to machine accuracy: the elastic energy is convex in y, so its slope
    has one sign change (or a flat stretch inside a clearance, where y = 0 is taken).
    """
    th = ball_angles(bearing, phase)
    cos, sin = np.cos(th), np.sin(th)
    contact = math.cos(bearing.contact_angle)
    # The axial stiffness of the ball is not modelled: approach and force are both projected on the radial plane.
    scale = load_deflection(bearing) * contact**2.5
    x = np.atleast_1d(np.asarray(x, float))

    def approach(y: Array) -> Array:
        return np.maximum(preload / contact + np.multiply.outer(x, cos) + np.multiply.outer(y, sin), 0.0)

    reach = np.abs(x) + abs(preload) + 1e-12
    low, high = -4.0 * reach, 4.0 * reach
    for _ in range(80):  # bisection: halves exactly, the same for every x, and cannot miss the root
        mid = 0.5 * (low + high)
        slope = approach(mid) ** 1.5 @ sin
        low, high = np.where(slope < 0.0, mid, low), np.where(slope > 0.0, mid, high)
        still = slope == 0.0
        low, high = np.where(still, mid, low), np.where(still, mid, high)
    y = 0.5 * (low + high)
    free = approach(np.zeros_like(x)) ** 1.5 @ sin == 0.0
    y = np.where(free, 0.0, y)
    delta = approach(y)
    force = scale * (delta**1.5 @ cos)
    stiff = 1.5 * scale * np.sqrt(delta)
    kxx, kxy, kyy = stiff @ cos**2, stiff @ (cos * sin), stiff @ sin**2
    held = kyy > 1e-20 * kxx  # else one ball in line with the load, which y would have to leave by kilometres
    tangent = kxx - np.divide(kxy**2, kyy, out=np.zeros_like(kxy), where=held)
    return force, tangent, y


def _quadratic(x: Array, k: Array, reach: float) -> Quadratic:
    inside = np.abs(x) <= reach * (1.0 + 1e-9)
    design = np.stack([np.ones(int(inside.sum())), (x[inside] / reach) ** 2], axis=1)
    (k0, k2), *_ = np.linalg.lstsq(design, k[inside], rcond=None)
    error = np.max(np.abs(design @ np.array([k0, k2]) - k[inside])) / max(abs(k0), 1e-300)
    return Quadratic(float(k0), float(k2 / reach**2), float(reach), float(100.0 * error))


def curve(bearing: BearingGeometry, preload: float) -> Curve:
    """Force and stiffness at one preload (m; negative: clearance) over |x| <= 2 reach; quadratics over |x| <= reach.

    The reach is the preload itself, or twice a clearance.
    """
    reach = preload if preload > 0.0 else max(-2.0 * preload, 0.1e-6)
    # exactly symmetric, with an exact zero
    x: Array = np.arange(-200, 201, dtype=np.float64) * (2.0 * reach / 200)
    force, tangent, _ = radial_force(bearing, preload, x)
    secant: Array = np.where(x == 0.0, tangent, force / np.where(x == 0.0, 1.0, x))
    kL, kNL = taylor(bearing, preload)
    return Curve(
        preload=preload,
        x=x,
        force=force,
        tangent=tangent,
        secant=secant,
        kL=kL,
        kNL=kNL,
        tangent_quadratic=_quadratic(x, tangent, reach),
        secant_quadratic=_quadratic(x, secant, reach),
    )


def taylor(bearing: BearingGeometry, preload: float) -> tuple[float, float | None]:
    """Coefficients kL (N/m) and kNL (N/m^3) of the force at x = 0, a ball on the axis; (0, None) in a clearance.

    Exact derivatives of sum K (g + x c + y s)^1.5 with the transverse balance: by symmetry y = O(x^2), and it enters
    the cubic term through the coupling sum c s^... of an odd number of balls; for even Z it vanishes.

    Parameters
    ----------
    bearing : BearingGeometry
        Numbers of balls, diameters and contact angle.
    preload : float
        Radial preload, m; negative: clearance.
    """
    if preload <= 0.0:
        return 0.0, None
    contact = math.cos(bearing.contact_angle)
    scale = load_deflection(bearing) * contact**2.5
    g = preload / contact
    th = ball_angles(bearing)
    cos, sin = np.cos(th), np.sin(th)
    first = 1.5 * scale * math.sqrt(g)
    second = 0.75 * scale / math.sqrt(g)
    third = -0.375 * scale * g**-1.5
    kL = first * float(np.sum(cos**2))
    # F = kL x + second/2 sum c (x c + y s)^2 + third/6 x^3 sum c^4; y = -(second/2) sum(s c^2) x^2 / (first sum s^2)
    y2 = -0.5 * second * float(np.sum(sin * cos**2)) / (first * float(np.sum(sin**2)))
    cubic = third / 6.0 * float(np.sum(cos**4)) + second * y2 * float(np.sum(cos**2 * sin))
    return kL, cubic


def theory(model: Model, fit: Fit | None = None, preloads: Sequence[float] | None = None) -> Theory:
    """Stiffness of the model's ball bearing by Hertz theory, together with fitted stiffnesses.

    Parameters
    ----------
    model : Model
        The rig, with `bearing`.
    fit : Fit or None
        Source of the fitted stiffnesses. None: the model's own values of kL and kNL.
    preloads : sequence of float or None
        m. None: 0.2 to 0.6 um as in the paper, and the rig's own preload.

    Returns
    -------
    Theory
        Contacts, kinematic orders, stiffness by preload, and the fitted locations.

    Raises
    ------
    DataError
        The model has no bearing geometry.
    """
    bearing = model.bearing
    if bearing is None:
        raise DataError("rig.bearing: no geometry; give balls, ball_diameter_mm, pitch_diameter_mm, groove_radius_mm")
    if preloads is None:
        given = () if bearing.preload is None else (bearing.preload,)
        preloads = sorted({round(g, 12) for g in (*LIMITS.preloads_m, *given)})
    inner, outer = raceways(bearing)
    rows = tuple(_fitted(bearing, _of_model(model) if fit is None else fit.parameters))
    curves = tuple(curve(bearing, g) for g in preloads)
    return Theory(
        bearing=bearing,
        inner=inner,
        outer=outer,
        K_n=load_deflection(bearing),
        kinematics=kinematics(bearing),
        curves=curves,
        fitted=rows,
    )


def _of_model(model: Model) -> dict[str, Parameter]:
    """The rig file's stiffnesses (what `fit --out` wrote, or a first guess) as parameters without sd."""
    out: dict[str, Parameter] = {}
    for place, settings in model.linear.items():
        if "kL" in settings and settings["kL"].value is not None:
            out[f"{place}.kL"] = Parameter(settings["kL"].value, None, "N/m")
    for use in model.effects:
        for place, settings in use.parameters.items():
            if use.custom is None and "kNL" in settings and settings["kNL"].value is not None:
                out[f"{place}.{use.name}.kNL"] = Parameter(settings["kNL"].value, None, "N/m^3")
    return out


def _fitted(bearing: BearingGeometry, found: Mapping[str, Parameter]) -> list[FittedRow]:
    rows = []
    unit = taylor(bearing, 1e-6)[0]  # kL = unit sqrt(g / um)
    for name, kL in found.items():
        if not name.endswith(".kL"):
            continue
        place = name.removesuffix(".kL")
        kNL = found.get(f"{place}.cubic.kNL")
        if kL.value is None or kL.value <= 0.0:
            rows.append(FittedRow(place=place, kL=kL, kNL=kNL, preload_implied=None, preload_sd=None, theory_kNL=None))
            continue
        g = (kL.value / unit) ** 2 * 1e-6
        sd = None if kL.sd is None else 2.0 * g * kL.sd / kL.value
        rows.append(
            FittedRow(place=place, kL=kL, kNL=kNL, preload_implied=g, preload_sd=sd, theory_kNL=taylor(bearing, g)[1])
        )
    return rows
