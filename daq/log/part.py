"""A part of a log, found by bisection: the rest is neither read nor checked, however long the log is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from daq.base.contract.part import ROW_ROUNDING, Part
from drivers.contract import Gap, Info

from .codec import RawBlock
from .entries import Entry, Head, walk
from .scan import PROBE_BYTES, Findings, next_chunk, opened

NEAR_BYTES = 1 << 16  # no use in halving less
MOST_HEADS = 64  # chunks that may come before the first sample, or lie between one that can be read alone and another


@dataclass(frozen=True, slots=True)
class Span:
    """Samples from index `first` up to `stop` (None: to the end), in the file from byte `at` on.

    origin : index of the first sample of the whole log.
    """

    first: int
    stop: int | None
    at: int
    origin: int


def span(path: Path, part: Part, started_ns: int | None, info: Info, origin: int, findings: Findings) -> Span:
    """Where a part of a log lies.

    started_ns, info, origin : time of the first sample, its description and its index, of the whole log.
    """
    first, stop = part.rows(path, info.rate_hz, started_ns)
    if part.dated and started_ns is not None:  # the device's clock may have drifted from ours since
        first, late = _on_host(path, first, info, origin, started_ns, findings)
        stop = None if stop is None else max(first + 1, stop + late)
    return Span(origin + first, None if stop is None else origin + stop, _at(path, origin + first, findings), origin)


def beginning(findings: Findings) -> Findings:
    """For another pass over a file: it ends where it did at the first look."""
    return Findings(size=findings.size, partial=findings.partial)


def inside(entry: Entry, of: Span, info: Info) -> Entry | None:
    """The part of a block or a gap that lies in the span; None if there is none."""
    stop = of.stop
    if isinstance(entry, Gap):
        end = entry.index + entry.count if stop is None else min(entry.index + entry.count, stop)
        index = max(entry.index, of.first)
        if not entry.count:
            return entry if of.first <= entry.index and (stop is None or entry.index < stop) else None
        return replace(entry, index=index, count=end - index) if end > index else None
    if isinstance(entry, RawBlock):
        end = entry.stop if stop is None else min(entry.stop, stop)
        index = max(entry.index, of.first)
        if end <= index:
            return None
        return entry if (index, end) == (entry.index, entry.stop) else cut(entry, index, end, info.rate_hz)
    return entry


def cut(block: RawBlock, first: int, stop: int, rate_hz: float) -> RawBlock:
    """The rows of a block from index `first` up to `stop`; the host time of a part is that of its last row."""
    rows, host, device, index, period_ns = [], [], [], block.index, 1e9 / rate_hz
    for number, count in enumerate(block.part_rows):
        a, b = max(index, first), min(index + count, stop)
        if b > a:
            rows.append(b - a)
            host.append(block.part_host_ns[number] - round((index + count - b) * period_ns))
            if len(block.part_device_ns):
                device.append(block.part_device_ns[number] + round((a - index) * period_ns))
        index += count
    return RawBlock(
        index=first,
        counts=block.counts[first - block.index : stop - block.index],
        part_rows=rows,
        part_host_ns=host,
        part_device_ns=device,
    )


def _on_host(
    path: Path, row: int, info: Info, origin: int, started_ns: int, findings: Findings
) -> tuple[int, int]:  # fmt: skip
    """The row that came at the Unix time at which the row given was due, and how many rows later that is."""
    wanted_ns, now = started_ns + round(row * 1e9 / info.rate_hz), row
    for _ in range(2):
        came_ns = _came_ns(path, origin + now, info, findings)
        if came_ns is None:
            break
        now = max(0, now + round((wanted_ns - came_ns) * 1e-9 * info.rate_hz - ROW_ROUNDING))
    return now, now - row


def _came_ns(path: Path, index: int, info: Info, findings: Findings) -> int | None:
    """Unix time of a sample by the host times of the block that it is in, or of the one after it."""
    offset_ns = 0
    for entry, _ in walk(path, beginning(findings), at=_at(path, index, findings)):
        if isinstance(entry, Head):
            offset_ns = entry.wall_offset_ns
        elif isinstance(entry, RawBlock) and entry.stop > index:
            last = entry.index + entry.part_rows[0] - 1
            return entry.part_host_ns[0] + offset_ns - round((last - index) * 1e9 / info.rate_hz)
    return None


def _at(path: Path, index: int, findings: Findings) -> int:
    """Where the last chunk begins whose first sample is not behind `index`, and that can be read alone."""
    low, high = 0, findings.size or 0
    with opened(path) as file:
        while high - low > NEAR_BYTES:
            middle = (low + high) // 2
            at = next_chunk(file, middle, findings.size or 0, high, PROBE_BYTES)
            if at is not None and (begins := _begins(path, at, findings)) is not None and begins <= index:
                low = at
            else:
                high = middle
    return low


def _begins(path: Path, at: int, findings: Findings) -> int | None:
    """Index of the first sample or gap from a chunk on; None if there is none near, or the chunk says not of what."""
    described = False
    for number, (entry, _) in enumerate(walk(path, beginning(findings), at=at)):
        described = described or isinstance(entry, Info)
        if isinstance(entry, RawBlock) or (isinstance(entry, Gap) and entry.count and described):
            return entry.index
        if number > MOST_HEADS:
            break
    return None
