"""One-sided stop: contact on one side only."""

from __future__ import annotations

from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude, searched


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    if p[1] >= 0.0:
        return p[0] * (x - p[1]) if x > p[1] else 0.0
    return p[0] * (x - p[1]) if x < p[1] else 0.0


STOP = Effect(
    name="stop",
    kind="force",
    parameters=(
        amplitude("k", "N/m", "stiffness of the stop"),
        searched(
            "gap", "m", "distance to the stop; its sign is the side that the stop is on", (-4.0, 4.0, 1.0), scale="x"
        ),
    ),
    equation="k max(x - gap, 0) for gap >= 0;  k min(x - gap, 0) for gap < 0",
    signature=(
        "the missing force is zero on one side of a kink and straight on the other; skewed displacement density; "
        "even and odd harmonics"
    ),
    confused_with=("clearance", "quadratic", "rub"),
    distinguish=(
        "one kink only; a quadratic is smooth; a rub is tied to the radius of the orbit and drags along the tangent"
    ),
    reference="Shaw and Holmes, J. Sound Vib. 90(1), 1983, 129-155 (one-sided contact)",
    check="describing function of x = A cos wt is half that of a clearance with the same gap",
    on_machine="a snubber, a dowel, a cap bolt or a seal land that is touched on one side; look for a polished spot",
    stationary_density=True,
    force=force,
)
