"""Frames of several messages -> rows: which frames are of one instant.

Where stamps are exact and a row is short, frames that come close together are one row, in any order. Else rows are
separated by the usual order of the messages. A row that lacks a message stays incomplete; it never takes the frame of
another instant.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.protocol.period import Period, estimate_period

LONGEST_ROW_SHARE = 0.4  # of the period: the time alone does not separate longer rows from the next row
UNEQUAL_REL = 0.02  # rates of two messages that differ by more are different rates, not different clocks
OWN_CLOCKS_REL = 5e-4  # rates that differ by more than two oscillators do: the messages have separate clocks
SLIP_FRAMES, SLIP_SHARE = 32, 0.2  # frames of a message that slip against the others by so much of a period

I64Array = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Rows:
    """Frames grouped into rows. row : (frames,) row of each frame. n : number of rows. first_ns : (n,) start of a row.
    mixed : (n,) whether frames of several rows came at once with some missing, so that they cannot be matched."""

    row: I64Array
    n: int
    first_ns: I64Array
    mixed: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Timing:
    """How the messages of one device follow each other.

    periods : of each message, None for too few frames. rank : of each message in the usual order. lag_ns : of each
    message behind the first. apart_ns : frames further apart are of two rows; None where the order separates rows.
    late_ns : a frame that is later than usual by more than this starts another row; None where stamps are coarse.
    """

    periods: tuple[Period | None, ...]
    rank: I64Array
    lag_ns: I64Array
    apart_ns: float | None
    _: KW_ONLY
    late_ns: float | None

    @classmethod
    def unknown(cls) -> Timing:
        """The timing before any frame was seen."""
        empty = np.empty(0, np.int64)
        return cls((), empty, empty, None, late_ns=None)

    @classmethod
    def learn(cls, which: I64Array, t_ns: I64Array, messages: int) -> Timing:
        """The timing of these frames. which : (n,) message of each frame, in the order of arrival."""
        periods = tuple(estimate_period(t_ns[which == m]) for m in range(messages))
        before = np.diff(t_ns, prepend=t_ns[:1])
        pause = [_median(before[1:][which[1:] == m], -1.0) for m in range(messages)]
        opener = int(which[0]) if max(pause) <= 0.0 else int(np.argmax(pause))
        opened = np.flatnonzero(which == opener)
        frames = np.arange(len(which))[opened[0] :]  # frames before the first opener belong to an earlier row
        start = opened[np.searchsorted(opened, frames, side="right") - 1]
        place, behind, of = frames - start, t_ns[frames] - t_ns[start], which[frames]
        usual = [_median(place[of == m], float(m)) for m in range(messages)]
        rank = np.argsort(np.argsort(usual, kind="stable"), kind="stable").astype(np.int64)
        lag = np.array([_median(behind[of == m], 0.0) for m in range(messages)]).astype(np.int64)
        period = periods[opener]
        if period is None or not period.exact:
            return cls(periods, rank, lag, None, late_ns=None)
        others = max((pause[m] for m in range(messages) if m != opener), default=0.0)
        short = float(lag.max()) < LONGEST_ROW_SHARE * period.ns and pause[opener] > others
        return cls(periods, rank, lag, 0.5 * (pause[opener] + others) if short else None, late_ns=0.5 * period.ns)

    def unlike(self) -> tuple[int, int, float] | None:
        """The two messages whose periods differ most, and by how much: (faster, slower, relative); None if none do."""
        known = [(p.ns, m) for m, p in enumerate(self.periods) if p is not None]
        if len(known) < 2:
            return None
        (fast_ns, fast), (slow_ns, slow) = min(known), max(known)
        errors = [self.periods[m].error_rel for m in (fast, slow)]  # type: ignore[union-attr]
        share = slow_ns / fast_ns - 1.0
        return (fast, slow, share) if share > max(OWN_CLOCKS_REL, 1.5 * sum(errors)) else None

    def rows(self, which: I64Array, t_ns: I64Array) -> Rows:
        """Rows of these frames; the first frame opens the first row."""
        if len(which) == 0:
            empty = np.empty(0, np.int64)
            return Rows(empty, 0, empty, np.empty(0, np.bool_))
        steps = np.diff(t_ns)
        if self.apart_ns is not None:
            return self._by_time(which, t_ns, steps > self.apart_ns)
        rank = self.rank[which]
        new = np.concatenate([[True], rank[1:] <= rank[:-1]])
        if self.late_ns is not None:
            usual = self.lag_ns[which[1:]] - self.lag_ns[which[:-1]]
            new[1:] |= np.abs(steps - usual) > self.late_ns
        row = np.cumsum(new) - 1
        return Rows(row, int(row[-1]) + 1, self._began(which, t_ns, new), np.zeros(int(row[-1]) + 1, np.bool_))

    def slipped(self, which: I64Array, t_ns: I64Array, rows: Rows, late_ns: NDArray[np.float64]) -> int | None:
        """A message whose frames come at another time of the row than usual; None if none do.

        late_ns : (messages,) mean delay of each message over SLIP_FRAMES; updated in place.
        """
        if self.late_ns is None:
            return None
        for m in range(len(self.rank)):
            mine = which == m
            late = (t_ns[mine] - rows.first_ns[rows.row[mine]] - self.lag_ns[m])[-SLIP_FRAMES:]
            if len(late):
                late_ns[m] += (float(np.median(late)) - late_ns[m]) * len(late) / SLIP_FRAMES
            if abs(late_ns[m]) > SLIP_SHARE * 2.0 * self.late_ns:
                return m
        return None

    def _by_time(self, which: I64Array, t_ns: I64Array, apart: NDArray[np.bool_]) -> Rows:
        new = np.concatenate([[True], apart])
        cluster = np.cumsum(new) - 1
        messages = len(self.rank)
        counts = np.bincount(cluster * messages + which, minlength=(int(cluster[-1]) + 1) * messages)
        if counts.max() <= 1:
            n = int(cluster[-1]) + 1
            return Rows(cluster, n, self._began(which, t_ns, new), np.zeros(n, np.bool_))
        # the k-th frame of a message in a cluster is of its k-th row: rows that came together after a stall
        order = np.lexsort((np.arange(len(which)), which, cluster))
        key = cluster[order] * messages + which[order]
        head = np.concatenate([[True], key[1:] != key[:-1]])
        turn = np.empty(len(which), np.int64)
        turn[order] = np.arange(len(which)) - np.maximum.accumulate(np.where(head, np.arange(len(which)), 0))
        pair = cluster * (int(turn.max()) + 1) + turn
        _, first, row = np.unique(pair, return_index=True, return_inverse=True)
        counts = counts.reshape(-1, messages)
        mixed = (counts.max(axis=1) > 1) & (counts.min(axis=1) != counts.max(axis=1))
        return Rows(row.astype(np.int64), len(first), t_ns[first] - self.lag_ns[which[first]], mixed[cluster[first]])

    def _began(self, which: I64Array, t_ns: I64Array, new: NDArray[np.bool_]) -> I64Array:
        """Time at which the first message of each row came, or should have come."""
        return np.asarray(t_ns[new] - self.lag_ns[which[new]])


def _median(values: NDArray[np.int64], default: float) -> float:
    return float(np.median(values)) if len(values) else default
