"""The sampling period of a device that sends no counter, from when its samples arrived.

Arrivals are late by queues and bursts, some samples never come, and stamps may be coarse. The mean distance of
arrivals is the period only if nothing is lost; a loss always makes distances longer. So the period is the
value on which most distances agree: distances of neighbours where they are even, else over so many samples that bursts
average out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

LEAST_SAMPLES = 8
MOST_SAMPLES = 16_384  # of a record that are looked at
EVEN_REL = 0.35  # of a period: a distance so near a whole number of periods is even
EVEN_SHARE = 0.9  # of the distances that are, where stamps are exact
LEAST_CAME_SHARE = 0.5  # of the samples that an even distance implies; if fewer came, it is that of a transfer
TWIN_SHARE = 0.02  # of distances near zero, which an exact stamp never has
LONGEST_EVEN_STEPS = 8  # periods; an error of the first guess would pass for a part of a period in longer ones
NOMINAL_REL = 2e-3  # of the rate: an oscillator is never so far off
TWO_DIGITS_REL = 1e-3  # of the rate: a device's rate is a short number, and its clock is not exact
SHARP_REL = 5e-4  # of a period: a quarter of what an oscillator may be off
ODD_SAMPLES = 0.1  # a distance so far from a whole number of periods is no loss
REGULAR_SAMPLES = 1.5  # by which the distance over many samples varies, if nothing is lost at random
LEAST_REGULAR_SAMPLES, LEAST_LOSSES = 64, 8.0  # over so many samples or losses: at random, these vary by 7
UNSEEN_SHARE = 0.1  # of the common divisor of all stamps, if they are whole periods
WHOLE_SAMPLES = 1.25  # prompt arrivals lie within one sample, and a little jitter
MOST_BLOCKS = 16  # of arrivals, each with a prompt one
COARSE_REL = 0.2  # of a period: a resolution of stamps that is no longer fine

F64Array = NDArray[np.float64]
I64Array = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Period:
    """A sampling period. ns : its value. error_rel : its uncertainty. exact : each stamp places its own sample.

    sure : False where arrivals neither agree on a distance nor follow their number, because of losses or delays.
    """

    ns: float
    error_rel: float
    exact: bool
    sure: bool = True

    @property
    def rate_hz(self) -> float:
        return 1e9 / self.ns


def estimate_period(t_ns: I64Array, nominal_ns: float | None = None) -> Period | None:
    """The period of these arrivals, in order; None for too few arrivals, or stamps that do not increase.

    nominal_ns : believed where stamps of a coarse resolution fit it and another period as well. Arrivals that lie on a
    finer lattice, and come no faster than it on the mean, lie on that of the reads of an adapter.
    """
    steps_ns = np.diff(t_ns[:MOST_SAMPLES])
    if len(steps_ns) < LEAST_SAMPLES - 1 or not (steps_ns > 0).any():
        return None
    resolution_ns = float(np.gcd.reduce(steps_ns))
    steps = steps_ns.astype(np.float64)
    even = _even(steps, resolution_ns)
    nominal = even is not None and nominal_ns is not None and abs(even.ns / nominal_ns - 1.0) < NOMINAL_REL
    least_ns = 0.0 if nominal_ns is None else (1.0 - NOMINAL_REL) * nominal_ns
    if even is not None and even.ns < least_ns <= float(steps.sum() + even.ns) / len(steps):
        even = None
    if even is None or not (nominal or even.ns > LEAST_CAME_SHARE * float(steps.mean())):
        many = _over_many(_times(steps), resolution_ns)
        straight = None if many is None else _straight(_times(steps), many.ns)
        if many is None or straight is None:
            return None if many is None else replace(many, sure=False)
        return many if many.error_rel < SHARP_REL else straight
    ratio = steps / even.ns
    if (np.abs(ratio - np.rint(ratio)) > ODD_SAMPLES).mean() > TWIN_SHARE:
        # late frames, or pauses that come back, are not whole periods: the mean distance counts them in
        return _regular(_times(steps), even.ns, REGULAR_SAMPLES * even.ns) or even
    coarse, missing_share = resolution_ns >= COARSE_REL * even.ns, float((np.rint(ratio) - 1.0).clip(0.0).mean())
    few = not coarse and missing_share * len(steps) < 4.0 * max(LEAST_LOSSES, LEAST_REGULAR_SAMPLES * missing_share)
    if nominal or few or (np.rint(ratio) > 1).mean() < TWIN_SHARE / 4:
        return even
    # whole multiples of a resolution, or of the reads of an adapter: losses at random, or a period between two
    # multiples, which is regular
    return _regular(_times(steps), even.ns, 1.01 * resolution_ns if coarse else REGULAR_SAMPLES * even.ns) or even


def _regular(t_ns: F64Array, period_ns: float, most_ns: float) -> Period | None:
    """The distance over many samples, if it varies by no more than `most_ns`; losses at random would vary by more."""
    n = len(t_ns)
    lost = max(float((np.rint(np.diff(t_ns) / period_ns) - 1).clip(0).mean()), 1e-9)
    width = int(min(max(LEAST_REGULAR_SAMPLES, LEAST_LOSSES / lost), n // 4))
    steps = (t_ns[width:] - t_ns[:-width]) / width
    low, high = np.quantile(steps, (0.1, 0.9)).tolist()
    if (high - low) * width > most_ns:
        return None
    middle = float(steps[(steps >= low) & (steps <= high)].mean())
    return Period(middle, max(high - low, 1e-6 * middle) / float(np.sqrt(n / width)) / middle, False)


def _times(steps: F64Array) -> F64Array:
    return np.concatenate([[0.0], np.cumsum(steps)])


def _even(steps: F64Array, resolution_ns: float) -> Period | None:
    """The period of the lattice on which the stamps lie, apart from a few late ones; None if they lie on none."""
    period = float(np.median(steps))
    if period <= 0.0:
        return None
    for _ in range(3):
        number = np.rint(steps / period)
        near = np.abs(steps / period - number) < EVEN_REL
        if near.mean() < EVEN_SHARE or (number < 1).mean() > TWIN_SHARE:
            return None
        good = near & (number >= 1) & (number <= LONGEST_EVEN_STEPS)
        if not good.any():
            return None
        period = float(steps[good].sum() / number[good].sum())
    rest = steps[good] - number[good] * period
    error_ns = float(np.sqrt(2.0 * np.mean(rest**2) / good.sum()))
    if not rest.any():  # as fine as the stamps are, no distance differs: their resolution is not seen
        resolution_ns *= UNSEEN_SHARE
    return Period(period, max(error_ns, resolution_ns / good.sum()) / period, True)


def _over_many(t_ns: F64Array, resolution_ns: float) -> Period | None:
    """The period as the mean distance over the number of samples at which the distance varies least."""
    n, best, least, scale = len(t_ns), None, np.inf, 0.0
    for power in range(int(np.log2(max(n // 4, 1))), -1, -1):
        width = 1 << power
        steps = (t_ns[width:] - t_ns[:-width]) / width
        low, middle, high = np.quantile(steps, (0.1, 0.5, 0.9)).tolist()
        spread_ns = max(high - low, resolution_ns / width)
        error_ns = spread_ns / float(np.sqrt(n / width))
        scale = scale or middle
        if 0.5 * scale <= middle <= 1.05 * scale and middle > 0.0 and error_ns < least:  # else shorter than a burst
            mean = float(steps[(steps >= low) & (steps <= high)].mean())  # for the median of coarse stamps is coarse
            if mean > 0.0:  # not so of stamps that go to and fro
                best, least = Period(mean, error_ns / middle, False), error_ns
    return best


def _straight(t_ns: F64Array, period_ns: float) -> Period | None:
    """The slope of the earliest arrivals by their number, if these are of a device that counts on and lost nothing.

    Losses, which make a random walk, and delays leave larger distances between these arrivals and their line.
    """
    n = len(t_ns)
    edges = np.linspace(0, n, min(MOST_BLOCKS, n // 2) + 1).astype(np.int64)
    late = t_ns / period_ns - np.arange(n)
    number = np.array([a + int(np.argmin(late[a:b])) for a, b in zip(edges[:-1], edges[1:], strict=True)])
    slope, start = np.polyfit(number, t_ns[number] / period_ns, 1)
    rest = t_ns[number] / period_ns - slope * number - start
    if np.ptp(rest) > WHOLE_SAMPLES or slope <= 0.0:
        return None
    return Period(period_ns * float(slope), 0.5 / (float(number[-1] - number[0]) * float(slope)), False)


def off_nominal(found: Period, nominal_ns: float) -> bool:
    """Whether a measured period differs from the nominal one by more than an oscillator's error and its uncertainty."""
    return abs(found.ns / nominal_ns - 1.0) > max(NOMINAL_REL, 2.0 * found.error_rel)


def round_rate(rate_hz: float, error_rel: float = 0.0) -> float:
    """A rate within 0.1 % of a number of two digits is that number; else the shortest one within twice the error."""
    nice = float(f"{rate_hz:.1e}")
    if abs(nice - rate_hz) < TWO_DIGITS_REL * rate_hz:
        return nice
    for digits in range(3, 7):
        nice = float(f"{rate_hz:.{digits - 1}e}")
        if abs(nice - rate_hz) <= min(max(2.0 * error_rel, 1e-5), TWO_DIGITS_REL) * rate_hz:
            break
    return nice
