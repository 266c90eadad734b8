"""Rub: radial contact with friction along the tangent."""

from __future__ import annotations

import math
from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude, searched


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    # Rotation takes x to y, so the surface drags the shaft along (y, -x) / r: backward.
    r = math.sqrt(x * x + xo * xo)  # a third of the time of hypot, whose care for very large numbers is not needed
    if r <= p[2]:
        return 0.0
    return (r - p[2]) / r * (p[0] * x - s * p[1] * xo)


RUB = Effect(
    name="rub",
    kind="force",
    parameters=(
        amplitude("k", "N/m", "radial stiffness of the contact"),
        amplitude("kt", "N/m", "friction coefficient times k", share=0.2),
        searched("clearance", "m", "radius of the orbit at which it touches", (0.3, 4.0, 1.5), scale="x"),
    ),
    equation="(r - clearance)_+ / r (k x - kt y, k y + kt x),  r = hypot(x, y)",
    signature=(
        "starts at a radius of the orbit, whatever the direction; friction drives backward whirl, without end where "
        "kt exceeds c w (dry whip); sub-harmonics and fractional orders"
    ),
    confused_with=("clearance", "cross_coupling", "stop"),
    distinguish=(
        "tied to the radius, not to x or y alone; zero inside the clearance, where cross-coupling acts at any "
        "level, and its whirl is backward"
    ),
    reference=(
        "Muszynska, Shock and Vibration Digest 21(3), 1989, 3-11; friction taken along the tangent, against the "
        "surface of the turning shaft"
    ),
    check=(
        "force at radius r: k (r - clearance) inward and kt / k of it along the tangent, against rotation, at "
        "every angle"
    ),
    on_machine=(
        "seal or gland touched: wear marks on one arc of the stator or the whole shaft, heat, a shaft that bows "
        "as it rubs"
    ),
    scope="node",
    force=force,
)
