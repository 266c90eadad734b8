"""Stiffness that drifts during the record."""

from __future__ import annotations

from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    return (p[0] * t + 0.5 * p[1] * t * t) * x


STIFFNESS_DRIFT = Effect(
    name="stiffness_drift",
    kind="force",
    parameters=(
        amplitude("rate", "N/m/s", "rate of change of stiffness at t = 0", signed=True),
        amplitude("curvature", "N/m/s^2", "change of that rate per second", signed=True, share=0.0),
    ),
    equation="(rate t + curvature t^2 / 2) x",
    signature=(
        "early and late parts of the record want different kL; the resonance creeps; nothing repeats with the shaft"
    ),
    confused_with=("ball_pass", "cubic"),
    distinguish=(
        "slow and one way, where ball pass repeats many times a second; does not follow the level, as a "
        "nonlinearity does when the level drifts"
    ),
    reference=(
        "Harris, Rolling Bearing Analysis, 4th ed., Wiley 2001 (stiffness goes as the root of "
        "the preload, which follows temperature)"
    ),
    check="halves of a simulated record fitted apart differ by the drift between their middles",
    on_machine="warming up: preload grows or is lost; log the temperature, wait for steady state, check the locknut",
    force=force,
)
