"""Removes old segments: by age, by size, by what is free on the disk; the oldest first."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from .names import Segment, segments
from .sizes import Keep


@dataclass(frozen=True, slots=True, kw_only=True)
class Removed:
    """Outcome of one pass. paths, size_bytes : removed. kept_alarms : segments with an alarm over a limit of size."""

    paths: tuple[Path, ...]
    size_bytes: int
    kept_alarms: int = 0
    failed: str = ""


def remove_old(folder: Path, keep: Keep, now_ns: int, own: Collection[Path], written: Collection[Path]) -> Removed:
    """One pass over a folder of segments.

    now_ns : Unix time of the newest sample. own : segments of this session, which are the newest whatever the clock of
    this computer said as they began. written : that are being written, which stay. The newest of the others stays
    too, however full the disk is: somebody else fills it.
    """
    found = segments(folder)
    ends = {a.path: b.start_ns for a, b in zip(found, found[1:], strict=False)}
    order = [s for s in found if s.path not in own] + [s for s in found if s.path in own]
    order = [s for s in order if s.path not in written]
    size = {s.path: _size(s.path) for s in found}
    total, free = sum(size.values()), shutil.disk_usage(folder).free
    gone: list[Segment] = []
    kept_alarms, failed = 0, ""
    for segment in order:
        old = keep.age_s is not None and now_ns - ends.get(segment.path, now_ns) > keep.age_s * 1e9
        large = keep.size_bytes is not None and total > keep.size_bytes
        full = free < keep.free_bytes and segment is not order[-1]
        if not (old or large or full):
            continue
        if segment.alarm and not keep.alarms_too:
            kept_alarms += large or full
            continue
        try:
            segment.path.unlink(missing_ok=True)
        except OSError as error:
            failed = f"{segment.path}: cannot be removed: {error.strerror or error}"
            continue
        total, free = total - size[segment.path], free + size[segment.path]
        gone.append(segment)
    over = kept_alarms if (keep.size_bytes is not None and total > keep.size_bytes) or free < keep.free_bytes else 0
    removed = tuple(s.path for s in gone)
    return Removed(paths=removed, size_bytes=sum(size[p] for p in removed), kept_alarms=over, failed=failed)


def in_words(removed: Removed) -> str:
    """One line about the removed segments, for the log; "" for none."""
    if not removed.paths:
        return ""
    first, last = removed.paths[0].name, removed.paths[-1].name
    which = first if len(removed.paths) == 1 else f"{first} to {last}"
    return f"{len(removed.paths)} old segments removed ({removed.size_bytes / 1e6:.4g} MB): {which}"


def total_bytes(paths: Sequence[Path]) -> int:
    """Size of files; of one that is gone, 0."""
    return sum(map(_size, paths))


def _size(path: Path) -> int:
    with suppress(OSError):
        return path.stat().st_size
    return 0
