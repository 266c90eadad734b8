"""Local defect of a raceway or ball: a strike at every pass."""

from __future__ import annotations

import math
from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude, searched


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    psi = p[1] * phase - p[2]
    psi -= 2.0 * math.pi * math.floor(psi / (2.0 * math.pi))
    return -p[0] * math.exp(-psi / p[3])


LOCAL_DEFECT = Effect(
    name="local_defect",
    kind="force",
    parameters=(
        amplitude("strike", "N", "peak force of a strike", signed=True),
        searched("order", "1", "strikes per shaft turn: BPFO, BPFI or twice BSF", (0.3, 30.0, 2.1), scale="bpfo"),
        searched("angle", "rad", "defect angle of the first strike", (0.0, 6.283185307179586, 0.0), scale="angle"),
        searched(
            "width",
            "rad",
            "decay of a strike in defect angle, 2 pi from one strike to the next",
            (0.005, 0.6, 0.05),
            scale="angle",
        ),
    ),
    equation="force on the cap strike exp(-psi / width),  psi = (order phi - angle) mod 2 pi",
    signature=(
        "impulsive residual, kurtosis, lines at the defect order and its multiples in the envelope; each strike "
        "rings the resonance"
    ),
    confused_with=("ball_pass", "line"),
    distinguish=(
        "acts at x = 0 and does not scale with x; a comb of many harmonics, where varying compliance makes "
        "sidebands of the resonance only"
    ),
    reference="McFadden and Smith, J. Sound Vib. 96(1), 1984, 69-82 (single point defect)",
    check=(
        "harmonics of the strike fall as 1 / sqrt(1 + (n width)^2), n = 1, 2, ...: the Fourier series of the "
        "pulse train"
    ),
    on_machine=(
        "spall or brinelling: BPFO points to the outer ring, BPFI to the inner, 2 BSF to a ball; look at the "
        "grease, plan a change"
    ),
    force=force,
    found_by="harmonics",
    harmonics="all",
)
