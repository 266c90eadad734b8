"""Gyroscopic coupling."""

from __future__ import annotations

from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    return s * p[0] * vo


GYROSCOPIC = Effect(
    name="gyroscopic",
    kind="force",
    parameters=(
        amplitude(
            "g", "N s/m", "gyroscopic coefficient at the speed of the record (proportional to speed)", signed=True
        ),
    ),
    equation="(g v_y, -g v_x)",
    signature=(
        "forward and backward modes part as the speed rises; x and y are coherent a quarter turn apart; no energy "
        "goes in or out"
    ),
    confused_with=("cross_coupling", "anisotropy"),
    distinguish=(
        "goes with velocity and does no work: modes split in frequency while their damping stays; cross-coupling "
        "does the opposite"
    ),
    reference=(
        "Genta, Dynamics of Rotating Systems, Springer 2005 (gyroscopic matrix); Childs, Turbomachinery "
        "Rotordynamics, Wiley 1993"
    ),
    check="equal modes at w split into sqrt(w^2 + a^2) +- a, a = g / (2 m)",
    on_machine="overhung or large disc at high speed; expected physics, not a fault: put it in the model",
    scope="node",
    stationary_density=True,
    force=force,
)
