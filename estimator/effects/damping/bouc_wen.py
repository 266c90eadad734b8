"""Hysteresis: a spring in series with a slider (Bouc-Wen, exponent 1)."""

from __future__ import annotations

from collections.abc import MutableSequence, Sequence

from estimator.model.effect import Effect, amplitude, searched


def rates(
    z: Sequence[float], x: float, v: float, p: Sequence[float], lin: Sequence[float], dz: MutableSequence[float]
) -> None:
    dz[0] = v - (abs(v) * z[0] + v * abs(z[0])) * (0.5 / p[1])


def memory_force(z: Sequence[float], x: float, v: float, p: Sequence[float], lin: Sequence[float]) -> float:
    return p[0] * z[0]


BOUC_WEN = Effect(
    name="bouc_wen",
    kind="memory",
    parameters=(
        amplitude("k", "N/m", "stiffness of the hysteretic branch before it slips"),
        searched("slip", "m", "deflection of that branch at which it slips", (0.1, 8.0, 1.0), scale="x"),
    ),
    equation="k z,  dz/dt = v - (|v| z + v |z|) / (2 slip)",
    signature=(
        "a loop in force against displacement that neither x nor v alone explains; stiffness falls and damping "
        "rises, then falls, with level"
    ),
    confused_with=("coulomb", "clearance", "cubic"),
    distinguish=(
        "the residual force depends on the direction of travel and on where it turned; Coulomb friction has no "
        "stiffness before it slips; a clearance has no loop"
    ),
    reference="Wen, J. Eng. Mech. Div. ASCE 102(2), 1976, 249-263 (A = 1, beta = gamma = 1/(2 slip), n = 1)",
    check="under a large cycle the branch slips at k slip and the loop encloses nearly 4 k slip A",
    on_machine=(
        "micro-slip in bolted or shrunk joints, fretting at the seat of the outer ring, wire-mesh or rubber mounts"
    ),
    states=1,
    rates=rates,
    memory_force=memory_force,
)
