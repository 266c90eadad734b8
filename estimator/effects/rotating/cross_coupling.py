"""Cross-coupled stiffness: a circulating force."""

from __future__ import annotations

from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    return s * p[0] * xo


CROSS_COUPLING = Effect(
    name="cross_coupling",
    kind="force",
    parameters=(amplitude("k", "N/m", "cross-coupled stiffness; positive drives forward whirl", signed=True),),
    equation="(k y, -k x)",
    signature=(
        "forward sub-synchronous whirl at the resonance with less damping forward than backward; mean of x v_y - "
        "y v_x is not zero"
    ),
    confused_with=("anisotropy", "gyroscopic", "rub"),
    distinguish=(
        "antisymmetric: anisotropy couples x and y with the same sign in both; gyroscopic coupling goes with "
        "velocity and moves frequencies instead of damping"
    ),
    reference="Alford, J. Eng. Power 87, 1965, 333-343",
    check="one mass becomes unstable at k = c w, forward",
    on_machine=(
        "steam or labyrinth seals, oil whirl, internal friction of shrunk parts: look for a forward line below 1X "
        "that grows with load"
    ),
    scope="node",
    force=force,
    watched=True,
)
