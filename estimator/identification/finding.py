"""Findings: what a record holds besides force laws, as a line, a faulty sensor, a shaped or a shared excitation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from estimator.effects import found_by
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.model.rig import EffectUse, Setting
from estimator.results import Parameter

MAX_P_VALUE = 1e-3  # of a finding that counts as missing force
OTHER_BEARING = "other_bearing"  # coordinate of a finding that two bearings share
UNKNOWN_EFFECT = "unknown"  # effect of a finding that nothing of the catalogue explains


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One effect that a detector found in a record.

    Attributes
    ----------
    effect : str
        Name in the catalogue, or `UNKNOWN_EFFECT`.
    at : tuple of str
        Canonical locations; they become the keys of the effect in a model.
    gain_nats : float
        Log-likelihood that the effect gains, nats.
    dof : int
        Parameters that the gain is paid with.
    p_value : float
        After a correction for everything that the detector tried.
    power_N2 : dict of int to float
        Mean square of the force that the effect explains, N^2, by index of the location in the motion record.
    against : str
        Coordinate of the comparison's map: "frequency", "shaft_angle", "other_bearing" or "level".
    region : str
        Where along that coordinate, in words.
    explained_share : float
        Of the misfit of the spectrum beyond chance, in nats; 0 where no spectrum is judged.
    settings : dict of str to dict of str to Parameter
        Parameters by canonical location and name; empty where the effect has none.
    note : str
        Remark for the user; empty where there is none.
    detectable : tuple of (float, str) or None
        Smallest size that the detector sees here and its unit; None where that is not known.
    folds : tuple of float
        Nats gained in each part of the band by what the other parts show; empty where that is not known.
    """

    effect: str
    at: tuple[str, ...]
    gain_nats: float
    dof: int
    p_value: float
    power_N2: dict[int, float]
    against: str
    region: str
    explained_share: float = 0.0
    settings: dict[str, dict[str, Parameter]] = field(default_factory=dict)
    note: str = ""
    detectable: tuple[float, str] | None = None
    folds: tuple[float, ...] = ()


def is_cause_of_spectrum(effect: str) -> bool:
    """Whether an effect, or what nothing of the catalogue explains, is one of the rival causes of one spectrum."""
    return effect == UNKNOWN_EFFECT or found_by(effect) == "spectrum"


@dataclass(frozen=True, slots=True, kw_only=True)
class DisturbanceForce:
    """A part of the missing force that no state explains.

    Attributes
    ----------
    place : int
        Index of the location in the motion record.
    against, region : str
        As of a `Finding`.
    power_N2 : float
        Mean square, N^2.
    """

    place: int
    against: str
    region: str
    power_N2: float


def disturbance_forces(findings: Sequence[Finding]) -> list[DisturbanceForce]:
    """The forces of significant findings; of rival causes of one spectrum only the likeliest counts.

    A periodic force does not count: its lines are left out of the force balance.
    """
    out: list[DisturbanceForce] = []
    spectral: dict[int, tuple[float, DisturbanceForce]] = {}
    for f in findings:
        if f.p_value > MAX_P_VALUE or f.effect in PERIODIC_EFFECTS:
            continue
        for place, power_N2 in f.power_N2.items():
            force = DisturbanceForce(place=place, against=f.against, region=f.region, power_N2=power_N2)
            if not is_cause_of_spectrum(f.effect):
                out.append(force)
            elif place not in spectral or f.gain_nats > spectral[place][0]:
                spectral[place] = (f.gain_nats, force)
    return [force for force in out + [force for _, force in spectral.values()] if force.power_N2 > 0]


def effect_use(effect: str, settings: Mapping[str, Mapping[str, Parameter]]) -> EffectUse:
    """An effect at the values of a finding, as a model holds it. settings : by canonical location and name."""
    return EffectUse(effect, {key: {n: Setting(p.value) for n, p in own.items()} for key, own in settings.items()})
