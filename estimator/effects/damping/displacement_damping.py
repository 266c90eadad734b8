"""Damping that grows with displacement."""

from __future__ import annotations

from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    return p[0] * x * x * v


DISPLACEMENT_DAMPING = Effect(
    name="displacement_damping",
    kind="force",
    parameters=(amplitude("cx", "N s/m^3", "damping per squared displacement"),),
    equation="cx x^2 v",
    signature="damping rises with level; the missing force is odd in velocity and acts only off the centre",
    confused_with=("quadratic_damping", "clearance"),
    distinguish=(
        "vanishes at x = 0 where quadratic damping is largest; a clearance stores force, this only resists velocity"
    ),
    reference="van der Pol, Phil. Mag. 2, 1926, 978-992 (the term x^2 dx/dt)",
    check="equivalent viscous damping of x = A cos wt is cx A^2 / 4; of a Gaussian displacement, cx sigma_x^2",
    on_machine=(
        "film squeezed out as the gap closes, elastomer rings, contact damping of the balls beyond the preload"
    ),
    force=force,
    watched=True,
)
