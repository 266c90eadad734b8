"""Level of the excitation along a record, by which its blocks are weighted.

E[F phi] of a force with a law is the PSD of the force at that time, times the response of the law. Where the level
changes and is taken as constant, a law that depends on the amplitude leaves a remainder that looks like a missing
force. With every block over its own level the balance holds block by block.
"""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array
from estimator.likelihood.thresholds import LIMITS
from estimator.results import Message


def relative_level(power: Array, at: Array, count: float) -> Array | None:
    """(places, n) power of the excitation of each place over its mean; None where all are even.

    power : (places, n) of the residual force in each part of a record. at : (n,) s, where each part begins. count :
    independent complex values in a part.
    """
    level = np.array([_smooth(p, at, count) if _is_uneven(p, count) else np.ones(p.size) for p in power])
    return None if np.all(level == 1.0) else level / level.mean(axis=1, keepdims=True)


def levels_agree(one: Array | None, other: Array | None) -> bool:
    """Whether two levels (places, n) give the same weights; None: even."""
    if one is None or other is None:
        return one is other
    return bool(np.abs(np.log(one / other)).max() < LIMITS.level_tolerance_log)


def rms_ratio(level: Array | None) -> float:
    """Largest over least rms of the excitation along the record. level : (places, n); None: even."""
    return 1.0 if level is None else float(np.sqrt((level.max(axis=1) / level.min(axis=1)).max()))


def uneven_message(level: Array | None) -> tuple[Message, ...]:
    """The message about an excitation whose level changes; none where it is even."""
    if level is None:
        return ()
    text = f"the excitation (rms) changes by a factor of {rms_ratio(level):.1f} along the record; S is its average PSD"
    return (Message("excitation_uneven", text),)


def _is_uneven(power: Array, count: float) -> bool:
    """Whether the rms of sixths of a record differs by more than min_rms_ratio and more than chance. power : (n,)."""
    if power.size < 6:
        return False
    sixth = np.arange(power.size) * 6 // power.size
    parts = np.bincount(sixth)
    rms = np.sqrt(np.bincount(sixth, power) / parts)
    sd = 0.5 * np.sqrt(2.0 / (count * parts.min()))
    return bool(rms.max() > max(LIMITS.min_rms_ratio, 1.0 + LIMITS.min_ratio_sds * sd) * rms.min())


def _smooth(power: Array, at: Array, count: float) -> Array:
    """(n,) moving mean of power (n,) at times `at` (n,) s.

    It reaches half of average_s to either side, or as far as min_independent_values need, but not past the nearer end.
    """
    step = float(np.median(np.diff(at)))
    reach = (
        np.minimum(
            0.5 * max(LIMITS.average_s, step * LIMITS.min_independent_values / count),
            np.minimum(at - at[0], at[-1] - at),
        )
        + 0.1 * step
    )
    total = np.concatenate([[0.0], np.cumsum(power)])
    first, last = np.searchsorted(at, at - reach), np.searchsorted(at, at + reach)
    return np.asarray((total[last] - total[first]) / (last - first))
