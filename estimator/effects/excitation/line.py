"""A periodic force at a fixed frequency."""

from __future__ import annotations

import math
from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude, searched


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    angle = 2.0 * math.pi * p[2] * t
    return -(p[0] * math.cos(angle) + p[1] * math.sin(angle))


LINE = Effect(
    name="line",
    kind="force",
    parameters=(
        amplitude("a", "N", "force in phase with the cosine of time", signed=True),
        amplitude("b", "N", "force in phase with the sine of time", signed=True),
        searched("frequency", "Hz", "frequency, which does not follow the shaft", (0.01, 20.0, 0.7), scale="hz_peak"),
    ),
    equation="force on the cap a cos(2 pi f t) + b sin(2 pi f t)",
    signature="one narrow line that stays put when the speed changes",
    confused_with=("misalignment", "imbalance", "sensor_noise"),
    distinguish=(
        "does not follow the speed; moves the bearing, so every channel shows it with the phase of the rotor "
        "response, where hum in one cable is in one channel"
    ),
    reference="Randall, Vibration-based Condition Monitoring, Wiley 2011 (mains and electrically excited lines)",
    check="power of the line is |H|^2 (a^2 + b^2) / 2 with H of the linear rotor",
    on_machine="mains (50 or 60 Hz and multiples), a neighbouring machine, a pump or fan on the same foundation",
    force=force,
    found_by="harmonics",
    harmonics=(1,),
    in_likelihood=False,
)
