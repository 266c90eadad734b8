"""Cubic stiffness."""

from __future__ import annotations

from collections.abc import Sequence

from ..effect import Effect, EffectParameter


def force(
    x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]
) -> float:
    return p[0] * x * x * x


CUBIC = Effect(
    name="cubic",
    kind="force",
    parameters=(
        EffectParameter(
            "kNL", "N/m^3", float("-inf"), float("inf"), 0.0, "cubic stiffness; positive hardens", linear=True
        ),
    ),
    equation="kNL x^3",
    signature=(
        "the resonance moves with the level and its peak is bent; the displacement density is flatter (hardening) or "
        "more peaked (softening) than a Gaussian; third harmonic; the same for both signs of x"
    ),
    confused_with=("quintic", "clearance", "hertz"),
    distinguish=(
        "all are odd in x: a quintic grows faster at the ends, a clearance has kinks, Hertz softens before it hardens"
    ),
    reference="Tiwari and Vyas, J. Sound Vib. 203(3), 1997, 389-408, eq. (5): G(x) = x^3",
    check="force = -dV/dx with V = kNL x^4 / 4 (same equation), by finite differences",
    on_machine="preload and contact angle; a bearing that hardens is loaded beyond its preload",
    stationary_density=True,
    force=force,
)
