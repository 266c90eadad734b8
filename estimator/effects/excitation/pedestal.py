"""Flexible pedestal: the bearing stands on a mass and spring, not on the ground."""

from __future__ import annotations

import math
from collections.abc import MutableSequence, Sequence

from estimator.model.effect import Effect, searched


def rates(
    z: Sequence[float], x: float, v: float, p: Sequence[float], lin: Sequence[float], dz: MutableSequence[float]
) -> None:
    w = 2.0 * math.pi * p[1]
    push = lin[1] * (x - z[0]) + lin[2] * (v - z[1])
    dz[0] = z[1]
    dz[1] = push / p[0] - w * w * z[0] - 2.0 * p[2] * w * z[1]


def memory_force(z: Sequence[float], x: float, v: float, p: Sequence[float], lin: Sequence[float]) -> float:
    return -lin[1] * z[0] - lin[2] * z[1]


PEDESTAL = Effect(
    name="pedestal",
    kind="memory",
    parameters=(
        searched("mass", "kg", "moving mass of the pedestal", (0.1, 20.0, 2.0), scale="m"),
        searched("frequency", "Hz", "natural frequency of the pedestal alone", (0.1, 6.0, 1.8), scale="hz_peak"),
        searched("damping", "1", "damping ratio of the pedestal alone", (0.002, 0.7, 0.05)),
    ),
    equation=(
        "-kL z - c z',  mass z'' = kL (x - z) + c (v - z') - mass w^2 z - 2 damping mass w z',  w = 2 pi frequency"
    ),
    signature=(
        "a second resonance and an anti-resonance between them; the missing force is linear in x but delayed, "
        "strongest near the frequency of the pedestal"
    ),
    confused_with=("bouc_wen", "sensor_resonance", "coloured_excitation"),
    distinguish=(
        "linear: no change with level, where Bouc-Wen has one; moves the anti-resonance of the bearing force, "
        "where a sensor resonance multiplies one channel only"
    ),
    reference="Kirk and Gunter, J. Eng. Ind. 94, 1972, 221-232 (support flexibility)",
    check=(
        "frequencies of the two masses in series by their quadratic equation; as the frequency grows the force "
        "goes to zero"
    ),
    on_machine=(
        "loose or cracked foot, soft baseplate, resonance of the housing: tap it with a hammer with the machine stopped"
    ),
    states=2,
    rates=rates,
    memory_force=memory_force,
    found_by="spectrum",
    typical={"frequency": (3.0, 1.8)},
)
