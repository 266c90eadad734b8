"""Coulomb friction."""

from __future__ import annotations

from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    if v > 0.0:
        return p[0]
    return -p[0] if v < 0.0 else 0.0


COULOMB = Effect(
    name="coulomb",
    kind="force",
    parameters=(amplitude("fc", "N", "friction force while sliding"),),
    equation="fc sgn v",
    signature=(
        "damping falls as the level rises; the missing force is a step in velocity; the displacement density is "
        "more peaked than a Gaussian"
    ),
    confused_with=("bouc_wen", "quadratic_damping"),
    distinguish=(
        "a step against velocity, whatever the displacement; Bouc-Wen needs some displacement before it slips and "
        "so adds stiffness at low level; quadratic damping rises with level"
    ),
    reference="Den Hartog, Trans. ASME 53, 1931, APM-53-9, 107-115 (Coulomb and viscous friction)",
    check="equivalent viscous damping of x = A cos wt is 4 fc / (pi w A)",
    on_machine=(
        "a seal or an outer ring that slides in its housing, fretting rust at the seat, dry bushes of a pedestal"
    ),
    force=force,
    watched=True,
)
