"""How strong the unknown force is along a record: what its blocks are weighed by.

E[F phi] of a force with a law is its PSD at the time times the response of the law to it. Taken as even where it is
not, a law that motion makes strong leaves a rest that looks like a missing force (17 % beside a clearance and a force
that grew by 2.5). With every block over its own level the balance holds again, block by block.
"""

from __future__ import annotations

import numpy as np

from estimator.arrays import Array
from estimator.results import Message

MIN_RMS_RATIO = 1.15  # of the lowest rms of a sixth of the record, from where a force counts as uneven
MIN_RATIO_SDS = 8.0  # standard deviations of that ratio
AVERAGE_S = 1.0  # that a level is the mean of
LEVEL_TOLERANCE_LOG = 0.03
MIN_INDEPENDENT_VALUES = 2000  # of independent values in it, at least: its own scatter goes into the weights


def relative_level(power: Array, at: Array, count: float) -> Array | None:
    """(places, n) power of the unknown force of each place over its mean; None where all are even.

    power : (places, n) of the inferred force in each part of a record; at : (n,) s, where each begins. count :
    independent complex values in a part.
    """
    level = np.array([_smooth(p, at, count) if _is_uneven(p, count) else np.ones(p.size) for p in power])
    return None if np.all(level == 1.0) else level / level.mean(axis=1, keepdims=True)


def levels_agree(one: Array | None, other: Array | None) -> bool:
    """Whether weighing by one is as good as by the other."""
    if one is None or other is None:
        return one is other
    return bool(np.abs(np.log(one / other)).max() < LEVEL_TOLERANCE_LOG)


def rms_ratio(level: Array | None) -> float:
    """Largest over least rms of a force along the record."""
    return 1.0 if level is None else float(np.sqrt((level.max(axis=1) / level.min(axis=1)).max()))


def uneven_message(level: Array | None) -> tuple[Message, ...]:
    """What to tell the user of a force whose level changes."""
    if level is None:
        return ()
    text = f"the excitation (rms) changes by a factor of {rms_ratio(level):.1f} along the record; S is its average PSD"
    return (Message("excitation_uneven", text),)


def _is_uneven(power: Array, count: float) -> bool:
    """Whether sixths of a record differ by more than little and more than chance."""
    if power.size < 6:
        return False
    sixth = np.arange(power.size) * 6 // power.size
    parts = np.bincount(sixth)
    rms = np.sqrt(np.bincount(sixth, power) / parts)
    sd = 0.5 * np.sqrt(2.0 / (count * parts.min()))
    return bool(rms.max() > max(MIN_RMS_RATIO, 1.0 + MIN_RATIO_SDS * sd) * rms.min())


def _smooth(power: Array, at: Array, count: float) -> Array:
    """(n,) mean of the parts on either side, as far as half of SECONDS, or as it takes to have COUNT values; no farther
    than to the nearer end."""
    step = float(np.median(np.diff(at)))
    reach = (
        np.minimum(0.5 * max(AVERAGE_S, step * MIN_INDEPENDENT_VALUES / count), np.minimum(at - at[0], at[-1] - at))
        + 0.1 * step
    )
    total = np.concatenate([[0.0], np.cumsum(power)])
    first, last = np.searchsorted(at, at - reach), np.searchsorted(at, at + reach)
    return np.asarray((total[last] - total[first]) / (last - first))
