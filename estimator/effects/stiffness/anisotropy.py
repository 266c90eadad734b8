"""Anisotropic support: symmetric cross stiffness."""

from __future__ import annotations

from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    return p[0] * xo


ANISOTROPY = Effect(
    name="anisotropy",
    kind="force",
    parameters=(amplitude("kxy", "N/m", "cross stiffness, the same from x to y and from y to x", signed=True),),
    equation="(kxy y, kxy x)",
    signature=(
        "x and y are coherent; the principal axes of stiffness are turned away from the sensors; orbits are "
        "tilted ellipses"
    ),
    confused_with=("cross_coupling", "gyroscopic"),
    distinguish="symmetric, so it stores energy and drives no whirl: mean of x v_y - y v_x stays zero",
    reference="Genta, Dynamics of Rotating Systems, Springer 2005 (non-isotropic supports)",
    check="equal kL in x and y split into kL + kxy and kL - kxy at 45 degrees",
    on_machine=(
        "support stiffer along one slanted axis: housing ribs, a split line, a load zone at an angle; or sensors "
        "not along the axes"
    ),
    scope="node",
    stationary_density=True,
    force=force,
    watched=True,
)
