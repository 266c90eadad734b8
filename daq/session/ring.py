"""The latest samples of one device, in SI, addressed by absolute sample index."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.scaling import Scaling
from drivers.contract import Block, Info
from estimator import Model


class Ring:
    """Rows [start, stop) of `channels` float64 values, at most `capacity` of them; older ones are forgotten.

    One writer. Every row is written twice, `capacity` rows apart, so that any window is one contiguous view. A missing
    row is NaN and False in the mask; it never shifts another row's index.
    """

    def __init__(self, capacity: int, channels: int, first: int = 0) -> None:
        if capacity < 1 or channels < 0 or first < 0:
            raise ValueError(f"ring of {capacity} rows of {channels} channels from index {first}: needs >= 1, 0, 0")
        self._rows = np.full((2 * capacity, channels), np.nan)
        self._present = np.zeros(2 * capacity, dtype=np.bool_)
        self.capacity = capacity
        self.first = first
        self.stop = first

    @property
    def start(self) -> int:
        """The oldest index still held."""
        return max(self.first, self.stop - self.capacity)

    def append(self, rows: NDArray[np.float64]) -> None:
        """Add rows (n, channels) at index `stop`; of more than `capacity`, only the last are kept."""
        self.stop += len(rows)
        kept = rows[-self.capacity :] if len(rows) > self.capacity else rows
        self._write(kept, True)

    def skip(self, count: int) -> None:
        """`count` samples from `stop` on are missing: NaN rows."""
        if count < 0:
            raise ValueError(f"cannot skip {count} rows: the index only grows")
        self.stop += count
        self._write(np.full((min(count, self.capacity), self._rows.shape[1]), np.nan), False)

    def window(self, start: int, stop: int) -> NDArray[np.float64]:
        """Rows [start, stop), (stop - start, channels), a read-only view valid until the next append or skip."""
        view = self._rows[self._slots(start, stop)]
        view.flags.writeable = False
        return view

    def present(self, start: int, stop: int) -> NDArray[np.bool_]:
        """Whether each row of [start, stop) arrived, (stop - start,), a read-only view."""
        view = self._present[self._slots(start, stop)]
        view.flags.writeable = False
        return view

    def _slots(self, start: int, stop: int) -> slice:
        if not self.start <= start <= stop <= self.stop:
            raise IndexError(f"rows [{start}, {stop}) asked for, the ring holds [{self.start}, {self.stop})")
        at = start % self.capacity
        return slice(at, at + stop - start)

    def _write(self, rows: NDArray[np.float64], present: bool) -> None:
        """Put rows (at most `capacity`) at the indices just before `stop`."""
        count, capacity = len(rows), self.capacity
        at = (self.stop - count) % capacity
        before_wrap = min(count, capacity - at)
        self._rows[at : at + count] = rows
        self._rows[at + capacity : at + capacity + before_wrap] = rows[:before_wrap]
        self._rows[: count - before_wrap] = rows[before_wrap:]
        self._present[at : at + count] = present
        self._present[at + capacity : at + capacity + before_wrap] = present
        self._present[: count - before_wrap] = present


class KeptSamples:
    """Blocks of the last seconds. model : its channels are the columns; seconds : that are kept."""

    def __init__(self, model: Model, seconds: float) -> None:
        self._model, self._seconds = model, seconds
        self._blocks: deque[Block] = deque()
        self._info: Info | None = None
        self.rate_hz = 1.0
        self.stop = 0  # absolute index behind the last sample
        self.full_scale: dict[str, int] = {}  # channel -> samples at full scale in what was asked for last

    def begin(self, info: Info) -> None:
        """Forget everything, because the device has a new description."""
        self._info, self.rate_hz = info, info.rate_hz
        self._blocks.clear()

    def append(self, block: Block) -> None:
        """Take a block, and drop the oldest rows."""
        self._blocks.append(block)
        self.stop = block.index + len(block.counts)
        oldest = self.stop - self._seconds * self.rate_hz
        while self._blocks[0].index + len(self._blocks[0].counts) <= oldest:
            self._blocks.popleft()

    def samples(self, first: int, stop: int) -> NDArray[np.float64]:
        """(stop - first, channels of the rig) SI, NaN where there is nothing or it is clipped."""
        names = [s.name for s in self._info.signals] if self._info else []
        wanted = [c.name for c in self._model.channels]
        columns = [names.index(n) for n in wanted] if set(wanted) <= set(names) else list(range(len(wanted)))
        out = np.full((stop - first, len(wanted)), np.nan)
        if self._info is None:
            return out
        scaling, hits = Scaling(self._info, columns), np.zeros(len(wanted), np.int64)
        for block in self._blocks:
            low, high = max(first, block.index), min(stop, block.index + len(block.counts))
            if low < high:
                counts = scaling.select(block.counts[low - block.index : high - block.index])
                rows = scaling.si(counts)
                clipped = scaling.clipped(counts)
                if clipped is not None:
                    rows[clipped] = np.nan
                    hits += clipped.sum(axis=0)
                out[low - first : high - first] = rows
        self.full_scale = {name: int(n) for name, n in zip(wanted, hits, strict=True) if n}
        return out
