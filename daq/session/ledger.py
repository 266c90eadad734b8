"""The account of one stream: received and lost samples, each counted once."""

from __future__ import annotations

from dataclasses import replace

from drivers.contract import Block, Gap, Reading

MOST_GAPS = 100_000  # kept for the summary; the log has all of them


class Ledger:
    """Lets readings through so that the index only grows and every jump of it has a gap.

    first, stop : indices of the stream so far; lost : samples in gaps; gaps : for the summary.
    """

    def __init__(self) -> None:
        self._limit: int | None = None
        self.first: int | None = None
        self.stop = 0
        self.lost = 0
        self.gaps: list[Gap] = []

    def limit_to(self, more: int) -> None:
        """Limit the stream to so many samples from here on, with lost ones."""
        self._limit = more + (0 if self.first is None else self.stop - self.first)

    @property
    def samples(self) -> int:
        """Samples that came."""
        return 0 if self.first is None else self.stop - self.first - self.lost

    @property
    def full(self) -> bool:
        return self._limit is not None and self.first is not None and self.stop - self.first >= self._limit

    def accept(self, reading: Reading) -> list[Reading]:
        """The reading as it is passed on: unchanged, trimmed, with a gap before it, or none."""
        if isinstance(reading, Block):
            return self._block(reading)
        if isinstance(reading, Gap):
            return self._gap(reading)
        return [reading]

    def _block(self, block: Block) -> list[Reading]:
        before = self._begin(block.index)
        known = self.stop - block.index
        stop = self._end(block.index + len(block.counts))
        if stop <= self.stop:
            return before
        if known > 0 or stop < block.index + len(block.counts):
            start = max(known, 0)
            # the device's time is that of the first row, which is no longer the first
            block = replace(block, index=block.index + start, counts=block.counts[start : stop - block.index])
            block = replace(block, t_device_ns=None) if start else block
        self.stop = stop
        return [*before, block]

    def _gap(self, gap: Gap) -> list[Reading]:
        if gap.count <= 0:
            return [self._note(Gap(gap.index, 0, gap.reason))]
        before = self._begin(gap.index)
        start, stop = max(gap.index, self.stop), self._end(gap.index + gap.count)
        if stop <= start:
            return [*before, self._note(Gap(gap.index, 0, gap.reason))]
        self.stop = stop
        self.lost += stop - start
        return [*before, self._note(Gap(start, stop - start, gap.reason))]

    def _begin(self, index: int) -> list[Reading]:
        """The gap that a driver left out."""
        if self.first is None:
            self.first = self.stop = index
        stop = self._end(index)
        if stop <= self.stop:
            return []
        owed = Gap(self.stop, stop - self.stop, "sequence")
        self.lost += owed.count
        self.stop = stop
        return [self._note(owed)]

    def _end(self, stop: int) -> int:
        return stop if self._limit is None or self.first is None else min(stop, self.first + self._limit)

    def _note(self, gap: Gap) -> Gap:
        if len(self.gaps) < MOST_GAPS:
            self.gaps.append(gap)
        return gap
