"""Bent shaft turning with the rotor."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ..effect import Effect, EffectParameter

INF = float("inf")


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    # The force on the rotor is (a cos - b sin, a sin + b cos): it turns with the shaft. The law is its opposite.
    if s > 0.0:
        return -(p[0] * math.cos(phase) - p[1] * math.sin(phase))
    return -(p[0] * math.sin(phase) + p[1] * math.cos(phase))


BOW = Effect(
    name="bow",
    kind="shaft",
    parameters=(
        EffectParameter("a", "N", -INF, INF, 0.0, "shaft force in phase with the tacho pulse", linear=True),
        EffectParameter("b", "N", -INF, INF, 0.0, "shaft force a quarter turn ahead of it", linear=True),
    ),
    equation=(
        "force on the disc (a cos phi - b sin phi, a sin phi + b cos phi), minus half of it on each cap; "
        "hypot(a, b) = shaft stiffness times bow"
    ),
    signature="a line at 1X, forward, that stays when the speed goes to zero",
    confused_with=("imbalance", "misalignment"),
    distinguish=(
        "does not grow as speed squared, and pushes the caps against the disc: at one speed alone it cannot be "
        "told from imbalance"
    ),
    reference="Nicholas, Gunter and Allaire, J. Eng. Power 98, 1976, 171-181 (residual shaft bow)",
    check="the forces on disc and caps sum to zero; as the speed goes to zero the response stays",
    on_machine="run-out of the shaft at slow roll; heat soak on one side, a rub that has bent it, careless storage",
    scope="node",
    force=force,
)
