"""Frames that stand out of order in a file, by their time stamps: neighbours are put in order.

Frames after a clock was set back are left as they are: their times continue from the new time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .capture_batches import Batch

MOST_FRAMES = 16  # the largest distance of a frame from its place
I64Array = NDArray[np.int64]


class Reorder:
    """Sorts frames by holding the last MOST_FRAMES of them, because a later frame may belong before them."""

    def __init__(self) -> None:
        self.sorted = 0  # frames put into their place
        self.reported = False
        self._held: Batch | None = None

    def take(self, batch: Batch) -> Batch:
        """The frames whose place is final."""
        whole = batch if self._held is None else _joined(self._held, batch)
        whole = self._in_order(whole)
        front, self._held = whole.cut(max(0, len(whole.frames) - MOST_FRAMES))
        return front

    def rest(self) -> Batch | None:
        held, self._held = self._held, None
        return held

    def _in_order(self, batch: Batch) -> Batch:
        t_ns, ids = batch.frames.t_ns, batch.frames.ids
        if len(t_ns) < 2 or not (np.diff(t_ns) < 0).any():
            return batch
        order = np.arange(len(t_ns))
        times, kinds = t_ns.copy(), ids.copy()  # in the order so far: the runs may share frames
        late = t_ns < np.maximum.accumulate(t_ns)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], late, [False]])))
        for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            if stop - start > MOST_FRAMES:
                continue
            least = times[start:stop].min()
            before = times[max(0, start - MOST_FRAMES) : start]
            first = start - len(before) + int(np.searchsorted(before, least, side="right")) if len(before) else start
            if _better(times, kinds, first, stop):
                places = first + np.argsort(times[first:stop], kind="stable")
                for each in (order, times, kinds):
                    each[first:stop] = each[places]
                self.sorted += stop - start
        return _ordered(batch, order)


def _better(t_ns: I64Array, ids: NDArray[np.uint32], first: int, stop: int) -> bool:
    """Whether the distances of equal frames are more even in the order of their stamps, or stay as they are."""
    around = slice(max(0, first - MOST_FRAMES), stop + MOST_FRAMES)
    near, kinds = t_ns[around], ids[around]
    back = [own for kind in np.unique(kinds) if (np.diff(own := near[kinds == kind]) < 0).any()]
    if not back:  # frames of different identifiers have changed places
        return True
    most = max(back, key=len)
    steps, ordered = np.diff(most), np.diff(np.sort(most))
    if len(steps) < 3:
        return True
    middle = np.median(ordered)
    return bool(np.abs(ordered - middle).sum() < np.abs(steps - middle).sum() and (ordered > 0.3 * middle).mean() > 0.8)


def _ordered(batch: Batch, order: I64Array) -> Batch:
    frames = batch.frames
    return Batch(
        frames=type(frames)(frames.ids[order], frames.lengths[order], frames.payload[order], frames.t_ns[order]),
        buses=batch.buses[order], names=batch.names, sent=batch.sent[order], holes=batch.holes, why=batch.why,
        said=batch.said,
    )  # fmt: skip


def _joined(a: Batch, b: Batch) -> Batch:
    f, g = a.frames, b.frames
    holes = np.concatenate([a.holes[:-1], [a.holes[-1] + b.holes[0]], b.holes[1:]])
    return Batch(
        frames=type(f)(
            np.concatenate([f.ids, g.ids]), np.concatenate([f.lengths, g.lengths]),
            np.concatenate([f.payload, g.payload]), np.concatenate([f.t_ns, g.t_ns]),
        ),
        buses=np.concatenate([a.buses, b.buses]), names=b.names, sent=np.concatenate([a.sent, b.sent]), holes=holes,
        why=b.why, said=b.said,
    )  # fmt: skip
