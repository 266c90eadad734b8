"""Varying compliance: stiffness modulated as balls pass."""

from __future__ import annotations

import math
from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude, searched


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    angle = p[2] * phase
    return (p[0] * math.cos(angle) + p[1] * math.sin(angle)) * x


BALL_PASS = Effect(
    name="ball_pass",
    kind="force",
    parameters=(
        amplitude("k_cos", "N/m", "modulation of stiffness in phase with the cosine", signed=True),
        amplitude("k_sin", "N/m", "modulation of stiffness in phase with the sine", signed=True),
        searched(
            "order",
            "1",
            "ball passes per shaft turn; from the record if it shows one, or the geometry (BPFO)",
            (0.3, 30.0, 2.1),
            scale="bpfo",
        ),
    ),
    equation="(k_cos cos(order phi) + k_sin sin(order phi)) x",
    signature=(
        "sidebands at the ball-pass frequency about the resonance; the missing force is proportional to x with a "
        "sign that follows the cage; stiffness estimates breathe"
    ),
    confused_with=("local_defect", "stiffness_drift", "crack"),
    distinguish=(
        "modulates the stiffness and adds no force at rest, where a defect strikes; at a non-integer order, where "
        "a crack is at 1X of the shaft"
    ),
    reference="Sunnersjo, J. Sound Vib. 58(3), 1978, 363-373 (varying compliance vibrations of rolling bearings)",
    check=(
        "sidebands of a tone at f appear at f +- order times shaft frequency with equal size; BPFO of the rig of "
        "the paper is 2.100"
    ),
    on_machine="radial load with clearance: few balls carry; more preload, or look at the load zone",
    force=force,
)
