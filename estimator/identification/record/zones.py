"""Zones of vibration: A of new machines, B for unlimited operation, C for a limited time, D damaging."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

from estimator.model.rig import MachineClass

from .thresholds import RECORD_LIMITS

Zone = Literal["A", "B", "C", "D"]


@dataclass(frozen=True, slots=True)
class ZoneLimits:
    """Between zones A and B, B and C, C and D.

    Parameters
    ----------
    velocity_mm_s : tuple of float
        Rms from 10 to 1000 Hz.
    displacement_um : tuple of float
        Rms from 10 to 1000 Hz; empty where the standard has none.
    """

    velocity_mm_s: tuple[float, ...]
    displacement_um: tuple[float, ...] = ()


# By the part and the keys of its machine classes. Part 3: ISO 20816-3:2022, annex A (the values of ISO 10816-3:2009).
# Part 7: ISO 10816-7:2009, as the public summaries of DIN ISO 10816-7 have it; True: above 200 kW.
# Part 1: ISO 10816-1:1995, annex B (of ISO 2372), as in the manuals of vibration meters (Voltcraft VBM-100, page 15).
ZONE_LIMITS: Mapping[tuple[Any, ...], ZoneLimits] = MappingProxyType(
    {
        (3, 1, "rigid"): ZoneLimits((2.3, 4.5, 7.1), (29.0, 57.0, 90.0)),
        (3, 1, "flexible"): ZoneLimits((3.5, 7.1, 11.0), (45.0, 90.0, 140.0)),
        (3, 2, "rigid"): ZoneLimits((1.4, 2.8, 4.5), (22.0, 45.0, 71.0)),
        (3, 2, "flexible"): ZoneLimits((2.3, 4.5, 7.1), (37.0, 71.0, 113.0)),
        (7, 1, False): ZoneLimits((2.5, 4.0, 6.6)),
        (7, 1, True): ZoneLimits((3.5, 5.0, 7.6)),
        (7, 2, False): ZoneLimits((3.2, 5.1, 8.5)),
        (7, 2, True): ZoneLimits((4.2, 6.1, 9.5)),
        (1, "I"): ZoneLimits((0.71, 1.8, 4.5)),
        (1, "II"): ZoneLimits((1.12, 2.8, 7.1)),
        (1, "III"): ZoneLimits((1.8, 4.5, 11.2)),
        (1, "IV"): ZoneLimits((2.8, 7.1, 18.0)),
    }
)


def zone_limits(machine: MachineClass) -> ZoneLimits:
    """Limits of the zones of a class of machines.

    Parameters
    ----------
    machine : MachineClass
        Part of the standard, and the kind of machine.
    """
    if machine.part == 7:
        return ZONE_LIMITS[7, machine.category, (machine.power_kw or 0.0) > RECORD_LIMITS.max_small_pump_kw]
    return ZONE_LIMITS[tuple(machine.to_json().values())]


def iso_zone(machine: MachineClass, velocity_mm_s: float, displacement_um: float = 0.0) -> Zone:
    """Zone of a machine's vibration.

    Parameters
    ----------
    machine : MachineClass
        Part of the standard, and the kind of machine.
    velocity_mm_s, displacement_um : float
        Rms from 10 to 1000 Hz. The worse one decides, where the standard has both.
    """
    limits = zone_limits(machine)
    passed = max(
        sum(velocity_mm_s > limit for limit in limits.velocity_mm_s),
        sum(displacement_um > limit for limit in limits.displacement_um),
    )
    zones: tuple[Zone, ...] = ("A", "B", "C", "D")
    return zones[passed]
