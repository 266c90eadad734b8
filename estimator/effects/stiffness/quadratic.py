"""Quadratic stiffness: a nonlinear bearing about an off-centre working point."""

from __future__ import annotations

from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    return p[0] * x * x


QUADRATIC = Effect(
    name="quadratic",
    kind="force",
    parameters=(amplitude("kq", "N/m^2", "quadratic stiffness; positive is stiffer for positive x", signed=True),),
    equation="kq x^2",
    signature=(
        "skewed displacement density, second harmonics, and the missing force is even in x; with it goes a mean "
        "displacement that an accelerometer cannot see"
    ),
    confused_with=("stop", "cubic", "sensor_clipping"),
    distinguish=(
        "a stop is even only on one side and has a kink; a skewed sensor shows the skew in one channel with no "
        "shift of its resonance with level"
    ),
    reference=(
        "Nayfeh and Mook, Nonlinear Oscillations, Wiley 1979, section 2.3 (quadratic and cubic restoring force)"
    ),
    check="second harmonic of x = A cos wt is kq A^2 / 2, equal to the mean",
    on_machine=(
        "static side load: weight of the rotor, belt pull, gear force, thermal bending; look at the load zone of "
        "the bearing"
    ),
    stationary_density=True,
    force=force,
    watched=True,
)
