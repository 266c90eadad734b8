"""Imbalance of the disc."""

from __future__ import annotations

import math
from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    # The force on the rotor is (a cos - b sin, a sin + b cos): it turns with the shaft. The law is its opposite.
    if s > 0.0:
        return -(p[0] * math.cos(phase) - p[1] * math.sin(phase))
    return -(p[0] * math.sin(phase) + p[1] * math.cos(phase))


IMBALANCE = Effect(
    name="imbalance",
    kind="disc",
    parameters=(
        amplitude("a", "N", "force in phase with the tacho pulse, at the speed of the record", signed=True),
        amplitude("b", "N", "force a quarter turn ahead of it", signed=True, share=0.5),
    ),
    equation=(
        "force on the disc (a cos phi - b sin phi, a sin phi + b cos phi),  hypot(a, b) = U Omega^2 with U = m e "
        "in kg m"
    ),
    signature="a line at 1X, forward, the same at both bearings of a symmetric rotor, growing as speed squared",
    confused_with=("bow", "misalignment", "line"),
    distinguish=(
        "a bow as large as the eccentricity loads the caps in the same way at every speed: the run-out of the shaft at "
        "slow roll tells them apart; a line at fixed Hz does not follow speed"
    ),
    reference="Jeffcott, Phil. Mag. 37, 1919, 304-314",
    check=(
        "response of the disc alone is the force over D33, forward circular: the 1X line is on the positive "
        "frequency side of x + i y"
    ),
    on_machine="balance the rotor; look for lost blades, deposits, a loose disc",
    scope="node",
    force=force,
    found_by="harmonics",
    harmonics=(1,),
    in_likelihood=False,
)
