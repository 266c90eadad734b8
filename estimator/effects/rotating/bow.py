"""Bent shaft that rotates with the rotor."""

from __future__ import annotations

import math
from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    # The force on the rotor is (a cos - b sin, a sin + b cos): it turns with the shaft. The law is its opposite.
    if s > 0.0:
        return -(p[0] * math.cos(phase) - p[1] * math.sin(phase))
    return -(p[0] * math.sin(phase) + p[1] * math.cos(phase))


BOW = Effect(
    name="bow",
    kind="shaft",
    parameters=(
        amplitude("a", "N", "shaft force in phase with the tacho pulse", signed=True),
        amplitude("b", "N", "shaft force a quarter turn ahead of it", signed=True, share=0.5),
    ),
    equation=(
        "force on the disc (a cos phi - b sin phi, a sin phi + b cos phi), minus half of it on each cap; "
        "hypot(a, b) = k r of a bow r, k the stiffness that holds the disc while the caps stand still"
    ),
    signature=(
        "a line at 1X, forward; as the speed goes to zero the run-out of the disc stays, the load on the caps vanishes"
    ),
    confused_with=("imbalance", "misalignment"),
    distinguish=(
        "loads the caps as an imbalance m r Omega^2 of the disc does, at every speed: only the run-out of the shaft "
        "itself, at slow roll, tells them apart"
    ),
    reference="Nicholas, Gunter and Allaire, J. Eng. Power 98, 1976, 171-181 (residual shaft bow)",
    check=(
        "the forces on disc and caps sum to zero; the caps move as by an imbalance of eccentricity r at every speed, "
        "the disc by r more"
    ),
    on_machine="run-out of the shaft at slow roll; heat soak on one side, a rub that has bent it, careless storage",
    scope="node",
    force=force,
    found_by="harmonics",
    harmonics=(1,),
    in_likelihood=False,
)
