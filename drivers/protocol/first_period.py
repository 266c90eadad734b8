"""The period of a device from its first samples: how many samples are needed, and the choice if they are uneven."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .period import MOST_SAMPLES, NOMINAL_REL, SHARP_REL, Period, estimate_period, off_nominal

LEAST_SAMPLES, LEAST_S = 32, 1.0  # a rate is measured over both, or over
ENOUGH_S = 2.0  # and a few samples
FEW_SAMPLES = 8
MOST_LEARN_S = 10.0  # where samples are lost, or held up; after that the rate that is said is believed
OUTRUN_RATIO = 1.8  # of arrivals over those at the nominal rate: the device is faster; held-up samples made 1.54
MEAN_ERROR_REL = 2e-2  # of a rate by the number of arrivals: so many samples may be lost
MOST_BY_CHANCE = 24.0  # samples lost at random that may look like a slower device

I64Array = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class FirstPeriod:
    """The first period. used : to start with. measured : None if it is not certain. even : no sample was held up."""

    used: Period
    measured: Period | None
    even: bool


def first_period(times: I64Array, nominal_ns: float | None, final: bool, least: int) -> FirstPeriod | None:
    """The period of these arrivals; None if more are needed. final : no more come. least : samples required."""
    n, span_s = len(times), float(times.max() - times.min()) / 1e9
    few = least <= LEAST_SAMPLES and n >= FEW_SAMPLES and span_s >= ENOUGH_S
    if not (final or few or (n >= least and span_s >= LEAST_S)):
        return None
    found = estimate_period(times, nominal_ns)
    even, seen = found is not None and found.sure, n
    if found is not None and not found.sure:
        found, seen = _before_uneven(times, nominal_ns, least) or (found, n)
    short = 0.0 if found is None or found.exact or nominal_ns is None else seen * (found.ns / nominal_ns - 1.0)
    by_chance = NOMINAL_REL * seen < short < MOST_BY_CHANCE
    if not final and span_s < MOST_LEARN_S and n < MOST_SAMPLES and (found is None or not found.sure or by_chance):
        return None
    sure = found is not None and found.sure and (seen == n or not by_chance)
    if nominal_ns is not None and not sure:
        outruns = (n - 1) * nominal_ns > OUTRUN_RATIO * 1e9 * span_s > 0.0
        found = Period(1e9 * span_s / (n - 1), MEAN_ERROR_REL, False, sure=False) if outruns else None
    return _believed(times, found, nominal_ns, even)


def _before_uneven(times: I64Array, nominal_ns: float | None, least: int) -> tuple[Period, int] | None:
    """The period of the samples before the first loss or delay, and their number; None if it is not certain."""
    for n in (len(times) // 2, len(times) // 4):
        if n >= least and float(np.ptp(times[:n])) / 1e9 >= LEAST_S:
            found = estimate_period(times[:n], nominal_ns)
            if found is not None and found.sure:
                return found, n
    return None


def _believed(times: I64Array, found: Period | None, nominal_ns: float | None, even: bool) -> FirstPeriod | None:
    if nominal_ns is not None and (found is None or not off_nominal(found, nominal_ns)):
        sharp = found is not None and (found.exact or found.error_rel < SHARP_REL)
        used = found if found is not None and sharp else Period(nominal_ns, NOMINAL_REL / 2.0, False)
        return FirstPeriod(used, found, even)
    if found is not None:
        return FirstPeriod(found, found, even)
    steps = np.diff(times)
    if not (steps > 0).any():
        return None
    return FirstPeriod(Period(float(np.median(steps[steps > 0])), 1.0, False), None, even)
