"""Whether a law that passed the gates is the answer, beside the candidates that were refused."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.thresholds import THRESHOLDS

from .gates import INSIDE_LIMITS, LEAVES_LITTLE, Context


def share_left(entry: Entry) -> float | None:
    """Share that a candidate leaves of what it was to explain; None where the candidate did not come to that gate."""
    last = entry.gates[-1] if entry.gates else None
    return last.measured if last is not None and last.gate == LEAVES_LITTLE and not last.passed else None


def left_text(entry: Entry) -> str:
    """Share that a candidate leaves of what it was to explain, per cent, for a message."""
    return f"{100 * (share_left(entry) or 0.0):.0f} %"


def better_predicting(entries: Sequence[Entry], named: Entry | None, context: Context) -> Entry | None:
    """The law that leaves more than the named one, but less than half, and predicts better than all; None for none.

    All are fitted together with the model. What the better one leaves is missing beside it. Where no law is named it is
    the answer beside structural modes only: their errors are a force that no law explains. It is no answer where the
    second law still gains beside it, and so explains another force.

    named : the first that passed the gates; None for none.
    """
    if not entries or named is None and context.point.data.background is None:
        return None

    def gain(entry: Entry) -> float:
        fit = context.fits.get(entry.effect)
        return -np.inf if fit is None or fit.gain_nats is None else fit.gain_nats

    first, *others = sorted(entries, key=gain, reverse=True)
    left = share_left(first)
    falls = first.after_percent < first.before_percent
    if left is None or left > THRESHOLDS.max_left_of_likelier_rel or not falls:
        return None
    if is_overshadowed(first, entries) if named is None else not np.isfinite(gain(named)):
        return None
    if not others:
        return first
    second, margin = others[0], THRESHOLDS.rival_nats
    if gain(first) <= gain(second) + margin:
        return None
    is_asked = named is None and gain(second) > margin
    return None if is_asked and context.gain_together(first, second) > gain(first) + margin else first


def is_overshadowed(named: Entry, entries: Sequence[Entry]) -> bool:
    """Whether a candidate that passed is no answer, because something larger than it is missing.

    More than twice what it explains is left, or a law that was refused explains more than twice as much, or is far
    likelier at the same bearings.
    """
    least = named.force_explained_percent / THRESHOLDS.same_force_min_rel
    larger = any(e.force_explained_percent > least and share_left(e) is not None for e in entries)
    return named.after_percent > least or larger or any(_is_far_likelier(e, named) for e in entries)


def _is_far_likelier(refused: Entry, named: Entry) -> bool:
    """Whether a refused law of possible numbers is likelier than a named one, beyond the resolution of the record.

    Both are compared at the bearings of the named one.
    """
    possible = any(gate.gate == INSIDE_LIMITS and gate.passed for gate in refused.gates)
    if not named.placed or refused.passed or not possible or not set(named.at) <= set(refused.by_node):
        return False
    return sum(refused.by_node[node][0] for node in named.at) > named.gain + THRESHOLDS.rival_nats


def has_mistakes_for_rivals(named: Sequence[Entry]) -> bool:
    """Whether mistakes in the rig file are on trial: no law is named, or one that couples the directions of a bearing.

    With swapped channels the caps seem coupled by such a law.
    """
    law = named[0].law if named else None
    return law is None or law.state == "directions"


def leaves_less(mistake: Entry, named: Sequence[Entry]) -> bool:
    """Whether a mistake leaves less than half of what a named law leaves; true where no law is named."""
    if not (named and named[0].placed):
        return True
    return mistake.after_percent < THRESHOLDS.same_force_min_rel * named[0].after_percent
