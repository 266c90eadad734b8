"""Misalignment of coupling or bearings."""

from __future__ import annotations

import math
from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    return -(p[0] * math.cos(2.0 * phase) + p[1] * math.sin(2.0 * phase))


MISALIGNMENT = Effect(
    name="misalignment",
    kind="force",
    parameters=(
        amplitude("a", "N", "force in phase with cos 2 phi", signed=True),
        amplitude("b", "N", "force in phase with sin 2 phi", signed=True),
    ),
    equation="force on the cap a cos 2 phi + b sin 2 phi",
    signature="a line at twice shaft speed, stronger in one direction and at the coupling end",
    confused_with=("line", "crack", "imbalance"),
    distinguish=(
        "2X without the 1X and 3X that a crack modulates; follows the speed, which a line at fixed Hz does not"
    ),
    reference=(
        "Gibbons, Coupling misalignment forces, Proc. 5th Turbomachinery Symp., 1976, 111-116; Sekhar and Prabhu, "
        "J. Sound Vib. 185(4), 1995, 655-671"
    ),
    check="the simulated spectrum has its line at order 2.0 and none at 1.0",
    on_machine="align the coupling warm; pipe strain, soft foot, cocked bearing",
    force=force,
    found_by="harmonics",
    harmonics=(2,),
    in_likelihood=False,
)
