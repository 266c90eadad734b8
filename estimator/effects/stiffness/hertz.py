"""Hertz contact of the balls, with preload or clearance."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

from estimator.model.effect import Effect, amplitude, searched

MOST_BALLS = 40
_BALL_ANGLES = 2.0 * np.pi * np.arange(MOST_BALLS) / np.maximum(np.arange(MOST_BALLS + 1), 1)[:, None]
BALL_COSINES, BALL_SINES = (
    np.cos(_BALL_ANGLES),
    np.sin(_BALL_ANGLES),
)  # [balls, j]: tables, as trigonometry would be most of the cost


@cache
def _law(known: int) -> Callable[..., float]:
    """The law of a bearing with `known` balls; where that is 0, their number is in p.

    The compiler unrolls the loop of a known number and vectorises it over samples (five times faster).
    """

    def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
        # The tangent at rest is taken off: kL stays the whole stiffness there. Balls are frozen at th_j = 2 pi j / Z.
        g, balls = p[1], known if known else max(min(int(p[2]), MOST_BALLS), 1)
        cx, cy = (x, xo) if s > 0.0 else (xo, x)
        total = 0.0
        for j in range(balls):
            squeeze = g + cx * BALL_COSINES[balls, j] + cy * BALL_SINES[balls, j]
            squeeze = squeeze if squeeze > 0.0 else 0.0
            total += squeeze * math.sqrt(squeeze) * (BALL_COSINES[balls, j] if s > 0.0 else BALL_SINES[balls, j])
        if g > 0.0:
            total -= 0.75 * balls * math.sqrt(g) * x
        return p[0] * total

    return force


force = _law(0)


HERTZ = Effect(
    name="hertz",
    kind="force",
    parameters=(
        amplitude("k", "N/m^1.5", "load-deflection constant of one ball between both rings"),
        searched("preload", "m", "radial preload of every ball; negative is clearance", (-2.0, 10.0, 1.5), scale="x"),
        searched(
            "balls", "1", "number of balls, one of them on the x axis", (3.0, 40.0, 6.0), scale="balls", given=True
        ),
    ),
    equation=(
        "k sum_j (g + x cos th_j + y sin th_j)_+^1.5 (cos th_j, sin th_j) - k0 (x, y), k0 = 0.75 Z k sqrt(g) for "
        "g > 0, else 0"
    ),
    signature=(
        "stiffness first falls (by 21 to 29 % until x is about the preload), then rises; couples x and y at large "
        "radius; with clearance as a rounded dead zone"
    ),
    confused_with=("cubic", "clearance"),
    distinguish=(
        "softens near the centre and hardens beyond the preload; a cubic does one or the other; with clearance "
        "the flanks bend as x^1.5 instead of being straight"
    ),
    reference=(
        "Tiwari and Vyas, J. Sound Vib. 203(3), 1997, 389-408, section 6; Harris, Rolling Bearing Analysis, "
        "Wiley, load-deflection of point contact"
    ),
    check=(
        "six balls: F = 4.5 k sqrt(g) x - (9/64) k g^-1.5 x^3 for small x, before the tangent is taken off "
        "(physics of the same section)"
    ),
    on_machine=(
        "preload by fit, locknut and temperature; kL is the whole stiffness at rest, so a softening curve with "
        "low kL means little preload"
    ),
    scope="node",
    one_direction=True,
    stationary_density=True,
    force=force,
    for_given=lambda p: _law(max(min(int(p[2]), MOST_BALLS), 1)),
)
