"""Breathing transverse crack of the shaft."""

from __future__ import annotations

import math
from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    return -(p[0] + p[1] * math.cos(phase) + p[2] * math.sin(phase)) * x


CRACK = Effect(
    name="crack",
    kind="shaft",
    parameters=(
        amplitude("loss", "N/m", "mean loss of shaft stiffness", signed=True, scale="shaft"),
        amplitude(
            "loss_cos",
            "N/m",
            "loss in phase with cos phi; hypot(loss_cos, loss_sin) = loss if it opens fully",
            signed=True,
            share=0.6,
        ),
        amplitude("loss_sin", "N/m", "loss in phase with sin phi", signed=True, share=0.8),
    ),
    equation="-(loss + loss_cos cos phi + loss_sin sin phi) (x_disc - mean of the caps)",
    signature=(
        "shaft stiffness breathes once a turn: sidebands at +-1X about the shaft modes, and 1X, 2X, 3X under a "
        "static load; peaks at half the critical speed"
    ),
    confused_with=("bow", "imbalance", "misalignment", "ball_pass"),
    distinguish=(
        "tied to the deflection of the shaft, not to a bearing; sidebands at one shaft order, not at a ball-pass order"
    ),
    reference="Mayes and Davies, J. Vib. Acoust. 106, 1984, 139-145; Gasch, J. Sound Vib. 160(2), 1993, 313-332",
    check="the forces on disc and caps sum to zero; sidebands of a shaft vibration at f appear at f +- 1X",
    on_machine="stop and inspect: 2X growing over weeks, phase of 1X wandering, notch or keyway",
    scope="node",
    force=force,
    typical={"loss": (0.05, 0.15)},
)
