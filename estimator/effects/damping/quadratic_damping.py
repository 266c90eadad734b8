"""Quadratic damping."""

from __future__ import annotations

from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    return p[0] * v * abs(v)


QUADRATIC_DAMPING = Effect(
    name="quadratic_damping",
    kind="force",
    parameters=(amplitude("cq", "N s^2/m^2", "quadratic damping"),),
    equation="cq v |v|",
    signature=(
        "damping rises with level; the missing force is a parabola of either sign against velocity and flat "
        "against displacement"
    ),
    confused_with=("displacement_damping", "coulomb"),
    distinguish=(
        "the force is large at high velocity, that is at the centre; displacement-dependent damping vanishes at "
        "the centre and acts off it"
    ),
    reference=(
        "Nayfeh and Mook, Nonlinear Oscillations, Wiley 1979, chapter 3; Roberts and Spanos, Random Vibration and "
        "Statistical Linearization, Wiley 1990"
    ),
    check=(
        "equivalent viscous damping of x = A cos wt is 8 cq w A / (3 pi); of a Gaussian velocity, cq sqrt(8/pi) sigma_v"
    ),
    on_machine="oil churning, orifices and squeeze-film lands, air drag of a fan",
    force=force,
    watched=True,
)
