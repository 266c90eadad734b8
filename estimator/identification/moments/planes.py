"""The caps, powers, masses and shaft of one transverse direction, for the density methods.

The disc is never measured. Its effect on the stationary density of the caps depends on the band. A disc mode inside the
band is in equilibrium with the caps and is integrated out of exp(-V/T); a disc whose mode lies below stands still. The
disc mode of a soft shaft decays over tens of seconds, so its part of the motion does not average out. Where the bearing
mode is well above it, `density_band` cuts it off. The shaft energy of a direction is
(ks/2) [a (x1^2 + x2^2) + 2 b x1 x2] with

    shaft   disc in band          disc below band
    chain   a = 1/2, b = -1/2     a = 1, b = 0
    beam    a = 0,   b = 0        a = 1, b = 1
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass

from estimator.effects import CATALOGUE
from estimator.errors import ModelError
from estimator.model.rig import CAP_DIRECTIONS, Model
from estimator.results import Parameter

from .synchronous import ORDERS_BY_EFFECT
from .thresholds import LIMITS

POWER_EFFECTS = {name: (n, e.parameters[0].name) for name, e in CATALOGUE.items() if (n := e.power)}
UNIT_OF_PARAMETER = {"kL": "N/m", "m": "kg", "lambda": "1/m^2"} | {
    e.parameters[0].name: e.parameters[0].unit for e in CATALOGUE.values() if e.power
}


@dataclass(frozen=True, slots=True)
class Cap:
    """One measured bearing cap in one direction.

    Attributes
    ----------
    place : str
        "bearing1.x" and so on.
    powers : tuple of int
        Powers of the displacement in its restoring force, 1 first.
    mass : float or None
        Mass, kg; None: unknown.
    """

    place: str
    powers: tuple[int, ...]
    mass: float | None

    def name(self, power: int) -> str:
        """Full name of the coefficient of x^power."""
        if power == 1:
            return f"{self.place}.kL"
        effect, parameter = next((e, p) for e, (k, p) in POWER_EFFECTS.items() if k == power)
        return f"{self.place}.{effect}.{parameter}"


@dataclass(frozen=True, slots=True)
class Plane:
    """The caps of one direction and the shaft between them.

    Attributes
    ----------
    direction : str
        "x" or "y".
    caps : tuple of Cap
        The measured caps, one or two.
    ks : float
        Shaft stiffness, N/m.
    a, b : float
        Coefficients of the shaft energy, see the text of the module.
    """

    direction: str
    caps: tuple[Cap, ...]
    ks: float = 0.0
    a: float = 0.0
    _: KW_ONLY
    b: float = 0.0

    @property
    def masses_known(self) -> bool:
        """Whether the masses of all caps are given."""
        return all(cap.mass is not None for cap in self.caps)

    @property
    def scale_from_shaft(self) -> bool:
        """Whether the known shaft spring can stand in for an unknown mass: it must couple two measured caps."""
        return len(self.caps) == 2 and self.ks > 0.0 and self.b != 0.0

    def solvable(self, cap: Cap) -> bool:
        """Whether the stiffness of this cap has a scale: its mass is given, or the shaft supplies it."""
        return cap.mass is not None or self.scale_from_shaft

    def names(self, solved_only: bool = True) -> tuple[str, ...]:
        """Parameters of a density method, cap by cap: coefficients, lambda = kNL/kL, and the mass where unknown."""
        out: list[str] = []
        for cap in self.caps:
            if self.solvable(cap) or not solved_only:
                out += [cap.name(q) for q in cap.powers]
            if 3 in cap.powers:
                out.append(f"{cap.place}.cubic.lambda")
            if cap.mass is None and (self.scale_from_shaft or not solved_only):
                out.append(f"{cap.place}.m")
        return tuple(out)

    def judged(self, found: Mapping[str, tuple[float, float]]) -> dict[str, Parameter]:
        """Every parameter with its standard deviation or the reason why it is not identifiable.

        found : full name -> (value, standard deviation) of those solved for. A mass by the shaft needs four standard
        deviations: the quotient ks/(ks/T) is large by chance where its denominator is small.
        """
        masses = [found[f"{cap.place}.m"] for cap in self.caps if f"{cap.place}.m" in found]
        weak = any(not (value > 0.0 and sd <= LIMITS.max_shaft_mass_sd_rel * value) for value, sd in masses)
        out = {}
        for name in self.names(solved_only=False):
            if name not in found:
                reason = "mass unknown: give rig.mass for this cap; only ratios follow from its density"
                out[name] = Parameter(None, None, unit_of(name), identifiable=False, reason=reason)
            elif weak and not name.endswith("lambda"):
                reason = "the shaft couples the caps too weakly to set the mass: give rig.mass"
                out[name] = Parameter(None, None, unit_of(name), identifiable=False, reason=reason)
            else:
                out[name] = Parameter.from_estimate(*found[name], unit_of(name))
        return out

    def undetermined(self, reason: str) -> dict[str, Parameter]:
        """Every parameter without a value, for one reason."""
        names = self.names(solved_only=False)
        return {n: Parameter(None, None, unit_of(n), identifiable=False, reason=reason) for n in names}


def unit_of(name: str) -> str:
    """SI unit of a density method's parameter, by its full name."""
    return UNIT_OF_PARAMETER[name.rsplit(".", 1)[1]]


def disc_mode_hz(model: Model) -> float:
    """Frequency of the disc on the shaft and the caps' springs in series, Hz; 0 without disc or shaft."""
    disc = model.mass.get("disc")
    if model.shaft == "none" or not disc or model.shaft_stiffness <= 0.0:
        return 0.0
    shaft = (2.0 if model.shaft == "chain" else 4.0) * model.shaft_stiffness
    starts = [s["kL"].value for s in model.linear.values() if "kL" in s]
    springs = [v for v in starts if v is not None and v > 0.0]
    bearing = 2.0 * sum(springs) / len(springs) if springs else math.inf
    return math.sqrt(1.0 / (1.0 / shaft + 1.0 / bearing) / disc) / (2.0 * math.pi)


def density_band(model: Model) -> tuple[tuple[float, float], bool]:
    """The band in Hz that the density methods use, and whether the disc stands still in it.

    The model's own band, its low end raised to 2.3 times the disc mode (the filter's stop edge is at half the low end)
    if that stays under 0.7 of the bearing mode: sqrt(kL/m) of the rig file, or the middle of the band.
    """
    low, high = model.band
    disc = disc_mode_hz(model)
    if disc == 0.0:
        return model.band, False
    modes = []
    for place in model.places:
        setting, mass = model.linear.get(place, {}).get("kL"), model.cap_mass(place)
        if setting is not None and setting.value is not None and setting.value > 0.0 and mass is not None:
            modes.append(math.sqrt(setting.value / mass) / (2.0 * math.pi))
    bearing = min(modes, default=math.sqrt(low * high))
    raised = max(low, 2.3 * disc)
    return ((raised, high), True) if raised == low or raised < 0.7 * bearing else (model.band, False)


def _shaft_term(model: Model, caps: int) -> tuple[float, float]:
    """The coefficients a, b of the shaft energy, for one or two measured caps."""
    if model.shaft == "none" or model.shaft_stiffness <= 0.0:
        return 0.0, 0.0
    _, still = density_band(model)
    if still:
        a, b = (1.0, 0.0) if model.shaft == "chain" else (1.0, 1.0)
    else:
        a, b = (0.5, -0.5) if model.shaft == "chain" else (0.0, 0.0)
    return (a, b) if caps == 2 else (a, 0.0)


def planes_of(model: Model) -> tuple[Plane, ...]:
    """One `Plane` per measured direction, caps in the order of `model.places`. ModelError for a larger rotor."""
    if model.rotor is not None or len(model.bearings) > 2:
        raise ModelError('this method knows one disc between two bearings at most: use method = "spectral"')
    out = []
    for direction in CAP_DIRECTIONS:
        places = [p for p in model.places if p.endswith("." + direction)]
        if not places:
            continue
        caps = []
        for place in places:
            extra = [POWER_EFFECTS[e.name][0] for e in model.effects if e.name in POWER_EFFECTS and place in e.at]
            caps.append(Cap(place, (1, *sorted(set(extra))), model.cap_mass(place)))
        a, b = _shaft_term(model, len(places))
        out.append(Plane(direction, tuple(caps), ks=model.shaft_stiffness, a=a, b=b))
    return tuple(out)


def ignored_effects(model: Model) -> tuple[str, ...]:
    """Names of the effects that a density method leaves out: all but powers of the displacement and shaft orders."""
    return tuple(e.name for e in model.effects if e.name not in POWER_EFFECTS and e.name not in ORDERS_BY_EFFECT)
