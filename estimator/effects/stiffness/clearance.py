"""Clearance: a second spring that engages on both sides beyond a gap."""

from __future__ import annotations

from collections.abc import Sequence

from estimator.model.effect import Effect, amplitude, searched


def force(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
    if x > p[1]:
        return p[0] * (x - p[1])
    if x < -p[1]:
        return p[0] * (x + p[1])
    return 0.0


CLEARANCE = Effect(
    name="clearance",
    kind="force",
    parameters=(
        amplitude("k", "N/m", "stiffness added beyond the gap"),
        searched("gap", "m", "half of the clearance", (0.02, 4.0, 1.0), scale="x"),
    ),
    equation="k (|x| - gap)_+ sgn x",
    signature=(
        "the missing force is a dead zone with straight flanks: kinks at -gap and +gap; the resonance rises with "
        "level at first and then settles; jumps under a swept sine"
    ),
    confused_with=("cubic", "stop", "hertz", "quintic"),
    distinguish="kinks on both sides (a stop has one), straight beyond them (a cubic and a quintic go on bending)",
    reference="Shaw and Holmes, J. Sound Vib. 90(1), 1983, 129-155 (piecewise linear oscillator)",
    check=(
        "describing function of x = A cos wt is (2k/pi) (acos r - r sqrt(1 - r^2)), r = gap / A (Gelb and Vander "
        "Velde 1968, table of gap elements)"
    ),
    on_machine=(
        "internal clearance of the bearing, loose outer ring in its housing, worn cage; feel the play, check fits "
        "and temperature"
    ),
    stationary_density=True,
    force=force,
    watched=True,
)
