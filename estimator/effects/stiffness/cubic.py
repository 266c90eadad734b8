"""Cubic stiffness."""

from __future__ import annotations

from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    return p[0] * x * x * x


CUBIC = Effect(
    name="cubic",
    kind="force",
    parameters=(amplitude("kNL", "N/m^3", "cubic stiffness; positive hardens", signed=True),),
    equation="kNL x^3",
    signature=(
        "the resonance moves with the level and its peak bends; the displacement density is flatter (hardening) "
        "or more peaked (softening) than a Gaussian; the missing force is smooth and odd in x"
    ),
    confused_with=("quintic", "clearance", "hertz", "bouc_wen"),
    distinguish=(
        "a quintic grows faster at the ends of the range, a clearance has kinks at the gap, Hertz softens before "
        "it hardens, Bouc-Wen forms a loop and adds damping"
    ),
    reference="Tiwari and Vyas, J. Sound Vib. 203(3), 1997, 389-408: eq. (5), G(x) = x^3",
    check=(
        "frequency of free vibration rises by 3 kNL A^2 / (8 kL) of itself (Nayfeh and Mook, Nonlinear "
        "Oscillations, Wiley 1979, section 2.3)"
    ),
    on_machine="preload, contact angle and fit of the bearing: a bearing that hardens is driven beyond its preload",
    stationary_density=True,
    force=force,
    watched=True,
)
