"""Fifth-power stiffness."""

from __future__ import annotations

from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    return p[0] * x**5


QUINTIC = Effect(
    name="quintic",
    kind="force",
    parameters=(amplitude("k5", "N/m^5", "fifth-power stiffness; positive hardens", signed=True),),
    equation="k5 x^5",
    signature=(
        "as cubic, but nearly nothing inside one standard deviation and much at the ends of the range: only the "
        "largest amplitudes show it"
    ),
    confused_with=("cubic", "clearance"),
    distinguish=(
        "the residual force bends only at the largest displacements; a cubic already shows at one standard "
        "deviation, a clearance has a kink and then a straight line"
    ),
    reference="Nayfeh and Mook, Nonlinear Oscillations, Wiley 1979, chapter 2 (odd powers)",
    check="describing function of x = A cos wt is 5 k5 A^4 / 8",
    on_machine=(
        "rare large excursions: shocks from the process, looseness that closes up, rubber or gasket parts at full "
        "compression"
    ),
    stationary_density=True,
    force=force,
    watched=True,
)
