"""A part of what a link of recorded traffic delivers, in time."""

from __future__ import annotations

from dataclasses import replace

from daq.base.contract.dates import SINCE_2001_NS
from daq.base.contract.part import Part, beyond
from drivers.contract import Block, Driver, Gap, Info, LinkStats, Reading


class PartOf:
    """A driver that gives the samples of `part` of another, whose first sample is at 0 s; indices stay.

    `read` raises ConfigError if nothing lies in the part. name : of the record, for messages.
    """

    def __init__(self, driver: Driver, part: Part, name: str) -> None:
        self.kind = driver.kind
        self.stats: LinkStats = driver.stats
        self._driver = driver
        self._part = part
        self._name = name
        self._rate_hz = 1.0
        self._span: tuple[int, int | None] | None = None  # indices
        self._origin = self._seen = 0
        self._given = self._over = False

    @property
    def exhausted(self) -> bool:
        return self._over or self._driver.exhausted

    def open(self) -> None:
        self._driver.open()

    def close(self) -> None:
        self._driver.close()

    def read(self, timeout_s: float) -> list[Reading]:
        out: list[Reading] = []
        for reading in self._driver.read(timeout_s) if not self._over else ():
            if isinstance(reading, Info):
                self._rate_hz = reading.rate_hz
                out.append(reading)
            elif isinstance(reading, Block | Gap):
                out += self._inside(reading)
            elif self._given or self._span is None:
                out.append(reading)
            if self._over:
                break
        if self.exhausted and not self._given and self._span is not None:
            raise beyond(self._name, (self._seen - self._origin) / self._rate_hz)
        return out

    def _inside(self, reading: Block | Gap) -> list[Reading]:
        count = len(reading.counts) if isinstance(reading, Block) else reading.count
        if self._span is None:
            if isinstance(reading, Gap):
                return [] if count else [reading]
            self._span = self._of(reading)
        self._seen, (first, stop) = reading.index + count, self._span
        if stop is not None and reading.index >= stop:
            self._over = True
            return []
        index, end = max(reading.index, first), self._seen if stop is None else min(self._seen, stop)
        if end < index or (end == index and count):
            return []
        self._given = True
        if isinstance(reading, Gap):
            return [replace(reading, index=index, count=end - index)]
        period_ns = 1e9 / self._rate_hz
        host_ns = reading.t_host_ns - round((self._seen - end) * period_ns)
        device_ns = None
        if reading.t_device_ns is not None:
            device_ns = reading.t_device_ns + round((index - reading.index) * period_ns)
        counts = reading.counts[index - reading.index : end - reading.index]
        return [Block(index, counts, host_ns, device_ns)]

    def _of(self, block: Block) -> tuple[int, int | None]:
        """Indices of the part, from the first sample of the record."""
        self._origin = block.index
        first_ns = block.t_host_ns - round((len(block.counts) - 1) * 1e9 / self._rate_hz)
        first, stop = self._part.rows(self._name, self._rate_hz, first_ns if first_ns >= SINCE_2001_NS else None)
        return self._origin + first, None if stop is None else self._origin + stop
