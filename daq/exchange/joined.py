"""Several files of one measurement as one record: in the order of their dates, with gaps between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from daq.base.contract.errors import LogError

from .checks import Record

SAME_RATE = 1e-4  # relative difference of the rates of files that can be one record
UNKNOWN_GAP = 1  # samples between files that say no date


def joined(files: Sequence[tuple[Path, Record]], note: Callable[[str], None]) -> Record:
    """One record of several files. Raises LogError if their rates differ or their times overlap.

    note : called where the length of a gap is unknown.
    """
    path, first = files[0]
    for other, record in files[1:]:
        if abs(record.rate_hz / first.rate_hz - 1) > SAME_RATE:
            text = f"{record.rate_hz:.9g} Hz, and {path} {first.rate_hz:.9g} Hz"
            raise LogError(f"{other}: {text}; import them into logs of their own")
    dated = [(record.started_ns, name, record) for name, record in files if record.started_ns is not None]
    if len(dated) == len(files):
        dated.sort(key=lambda of: of[0])
        breaks = _by_date(dated)
        ordered = [record for _, _, record in dated]
    else:
        note("not every file says its date: they follow each other as given, and how long the gaps are is not known")
        ordered = [record for _, record in files]
        ends = np.cumsum([record.samples for record in ordered])[:-1].tolist()
        breaks = tuple((end, UNKNOWN_GAP) for end in ends)
    scaled = {(record.factors, record.offsets) for record in ordered}
    if len(scaled) > 1:  # in other units: all in SI
        ordered = [_in_si(record) for record in ordered]
    missing = None
    if any(record.missing is not None for record in ordered):
        missing = np.concatenate([np.zeros(r.samples, bool) if r.missing is None else r.missing for r in ordered])
    values = tuple(np.concatenate(columns) for columns in zip(*(r.values for r in ordered), strict=True))
    return replace(ordered[0], values=values, missing=missing, breaks=breaks)


def _by_date(dated: Sequence[tuple[int, Path, Record]]) -> tuple[tuple[int, int], ...]:
    """(row, missing samples before it) of each file but the first."""
    breaks, row = [], 0
    for (before_ns, before, record), (started_ns, path, _) in zip(dated, dated[1:], strict=False):
        row += record.samples
        gap = round((started_ns - before_ns) * 1e-9 * record.rate_hz) - record.samples
        if gap < 0:
            raise LogError(f"{path}: begins {-gap} samples before {before} ends; correct the dates, or cut one of them")
        if gap:
            breaks.append((row, gap))
    return tuple(breaks)


def _in_si(record: Record) -> Record:
    count = len(record.names)
    offsets = record.offsets or (0.0,) * count
    values = tuple(v * f + o for v, f, o in zip(record.values, record.factors, offsets, strict=True))
    return replace(record, values=values, factors=(1.0,) * count, offsets=(0.0,) * count)
