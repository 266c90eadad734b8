"""`rotorscope import`: a file of another format into a Rotorscope log.

Raw counts of a log are int32. Whole numbers go in as they are. Others are scaled by a power of two, channel by
channel, so that the largest comes to between 2^29 and 2^30: rounding is then 2^-30 of the largest value, some 180 dB
below it, and floats of 24 bits within a factor of 64 of the largest survive to the last bit. A large constant in a
channel is taken off first, and stands in the log as the offset of its signal. A value so large that rounding would
come near to the others is refused.
"""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.base.console.memory import bounded_memory
from daq.base.console.output import Output, Progress, quiet_progress
from daq.base.contract.dates import utc_text
from daq.base.contract.errors import ConfigError, LogError
from daq.base.contract.part import WHOLE_RECORD, Part
from daq.base.contract.sink import Session
from daq.exchange.checks import Record, load
from daq.exchange.joined import joined
from daq.exchange.measurement import findings
from daq.rig.edit import of_channels
from daq.rig.rig import Rig, load_rig
from daq.rig.units import SI_UNIT
from drivers.contract import Block, BusError, Gap, Info, LinkOpenError, Notice, Reading, Signal
from drivers.foreign import CAPTURE_SUFFIXES
from drivers.links import capture_file

BLOCK_ROWS = 8192  # in a block
COUNT_BITS = 32
OFFSET_RATIO = 64.0  # of a constant over half the range of what changes, from which on it is taken off
SURVEYED_VALUES = 20_000_000  # samples of all channels, of a longer record the first: 10 s of computing
LEAST_STEPS = 256.0  # in the median of the sizes: rounding is then below -57 dB of it


def import_files(
    output: Output, paths: Sequence[Path], rig_path: Path, out: Path, rate_hz: float | None, gaps: bool,
    part: Part = WHOLE_RECORD,
) -> None:  # fmt: skip
    """One file or a part of it, or several of one measurement with gaps between them, into one log."""
    rig = of_channels(load_rig(rig_path), part.channels)
    if len(paths) > 1 and part.of_time:
        raise ConfigError("--from, --to and --seconds are for one file; import all, and export the part of the log")
    for path in paths:
        if out.resolve() == path.resolve():
            raise LogError(f"{out}: is the file to import; choose another name for the log")
    captures = [path for path in paths if _is_capture(Path(capture_file(str(path))), rig)]
    if captures and len(paths) > 1:
        raise LogError(f"{captures[0]}: CAN traffic is imported one file at a time; give each a log of its own")
    if captures:
        try:
            _import_capture(output, captures[0], rig, out, part)
        except BusError as error:
            rest = shlex.join(["--rig", str(rig_path), "--out", str(out)])
            ways = " or ".join(f"rotorscope import {shlex.quote(name)} {rest}" for name in error.choices)
            raise LinkOpenError(f"{error.what}; choose one: {ways}" if ways else error.what) from error
        return
    found: list[Notice] = []  # for the log, too, whose reader may have no other source

    def say(text: str, code: str = "file_odd", of: Path = paths[0]) -> None:
        output.note(f"{of}: {text}")
        found.append(Notice(time.monotonic_ns(), "warning", code, text if len(paths) == 1 else f"{of.name}: {text}"))

    read = []
    for path in paths:
        with output.progress(f"reading {path.name}"):
            read.append((path, load(path, rig, rate_hz, partial(say, of=path), gaps, part)))
    record = joined(read, say) if len(read) > 1 else read[0][1]
    faults = findings(record.si(), record.rate_hz, rig, SURVEYED_VALUES)
    notices = [*found, *(Notice(time.monotonic_ns(), "warning", code, text) for code, text in faults)]
    source = ", ".join(path.name for path in paths)
    with output.progress(f"writing {out.name}") as progress:
        write_record(record, rig, out, {"source": source}, progress, output.note, notices)
    for code, text in faults:
        say(text, code)
    seconds = (record.samples + sum(count for _, count in record.breaks)) / record.rate_hz
    value = {
        "schema": 1,
        "file": str(out),
        "channels": list(record.names),
        "samples": record.samples - (0 if record.missing is None else int(record.missing.sum())),
        "lost_samples": record.lost,
        "rate_hz": record.rate_hz,
        "seconds": seconds,
        "started": None if record.started_ns is None else utc_text(record.started_ns),
    }
    text = f"{seconds:.6g} s of {len(record.names)} channels at {record.rate_hz:g} Hz"
    output.result(value, f"{out}: {text}{f', {record.lost} samples missing' if record.lost else ''}")


def _is_capture(path: Path, rig: Rig) -> bool:
    """Whether it is recorded CAN traffic; an .mf4 is if the rig file maps signals."""
    suffix = path.suffix.lower()
    return suffix in CAPTURE_SUFFIXES and (suffix != ".mf4" or bool(rig.link.signals))


def _import_capture(output: Output, path: Path, rig: Rig, out: Path, part: Part) -> None:
    """Recorded CAN traffic goes through the driver and the pipeline of live traffic. path : with or without ?bus=."""
    from daq.commands.live.run import run_rig

    file = Path(capture_file(str(path)))
    if file.is_dir():
        raise LogError(f"{path}: is a folder; give a file in it")
    if not file.is_file():
        raise LogError(f"{path}: there is no such file; check the path")
    with bounded_memory(file.stat().st_size):  # what cannot be unpacked in it is damage of the file
        run_rig(output, rig, f"capture:{path}", out, command="import", part=part)


def write_record(
    record: Record, rig: Rig, out: Path, metadata: dict[str, str], progress: Progress = quiet_progress,
    note: Callable[[str], None] = lambda text: None, found: Sequence[Notice] = (),
) -> None:  # fmt: skip
    """Write a log of a record and its findings: complete or not at all. Raises LogError if it cannot be written."""
    from daq.base.contract.dates import Recorded
    from daq.log.writer import LogWriter

    levels = [level(v) for v in record.values]
    source, columns = metadata.get("source", str(out)), zip(record.names, record.values, levels, strict=True)
    scales = [resolved(source, name, values, zero, record.rate_hz) for name, values, zero in columns]
    offsets = [f * z + o for f, z, o in zip(record.factors, levels, record.offsets or [0.0] * len(levels), strict=True)]
    units = [SI_UNIT[c.kind] for c in rig.model.channels]
    info = Info(
        tuple(
            Signal(name, unit, f * scale, offset)
            for name, unit, f, scale, offset in zip(record.names, units, record.factors, scales, offsets, strict=True)
        ),
        record.rate_hz,
        count_bits=COUNT_BITS,
    )
    whole = False
    writer = LogWriter(out, live=False, wanted=lambda: whole, recorded=Recorded())
    try:
        writer.start(
            Session(
                model=rig.model, info=info, device="", attachments=rig.attachments(), metadata=versions() | metadata
            )
        )
        writer.readings(found)
        for index, readings in _blocks(record, scales, levels):
            writer.readings(readings)
            progress(index / record.samples)
        whole = True
    finally:
        writer.close()
    for notice in writer.health().notices:
        if notice.level == "error":
            raise LogError(f"{notice.text}; make room and import again")
        note(notice.text)


def versions() -> dict[str, str]:
    """Versions of the programs that made the log."""
    return {"command": "import", "rotorscope": version("rotorscope")}


def _blocks(record: Record, scales: list[float], levels: list[float]) -> Iterator[tuple[int, list[Reading]]]:
    start_ns = time.monotonic_ns() if record.started_ns is None else record.started_ns
    before = dict(record.breaks)
    ahead = 0  # of the index before the row
    for first, stop, present in _runs(record):
        if first in before:
            yield first, [Gap(first + ahead, before[first], "source")]
            ahead += before[first]
        if not present:
            yield stop, [Gap(first + ahead, stop - first, "source")]
            continue
        for index in range(first, stop, BLOCK_ROWS):
            end = min(index + BLOCK_ROWS, stop)
            counts = np.empty((end - index, len(scales)), dtype=np.int32)
            for k, (value, scale, zero) in enumerate(zip(record.values, scales, levels, strict=True)):
                counts[:, k] = np.rint((np.asarray(value[index:end], dtype=np.float64) - zero) / scale)
            yield end, [Block(index + ahead, counts, start_ns + round(1e9 * (end + ahead - 1) / record.rate_hz))]


def _runs(record: Record) -> Iterator[tuple[int, int, bool]]:
    """(first, stop, present) of runs of rows that are there or not; another file begins a run."""
    edges = {0, record.samples, *(row for row, _ in record.breaks)}
    if record.missing is not None:
        edges |= set((np.flatnonzero(np.diff(record.missing)) + 1).tolist())
    ordered = sorted(edges)
    for first, stop in zip(ordered, ordered[1:], strict=False):
        yield first, stop, record.missing is None or not record.missing[first]


def level(values: NDArray[Any]) -> float:
    """The constant to take off a column: 0 unless it is far larger than what changes."""
    if not values.size or (values.dtype.kind in "iu" and power_of_two(values) == 1.0):
        return 0.0
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0
    low, high = float(finite.min()), float(finite.max())
    return low / 2 + high / 2 if max(abs(low), abs(high)) > OFFSET_RATIO * (high / 2 - low / 2) > 0 else 0.0


def resolved(source: str, name: str, values: NDArray[Any], zero: float, rate_hz: float) -> float:
    """The scale of a column. Raises LogError if the largest value leaves the others too few steps."""
    rest = values - zero if zero else values
    scale = power_of_two(rest)
    if scale == 1.0:
        return scale
    size = np.abs(rest[np.isfinite(rest)])
    usual = float(np.median(size[size > 0])) if size.any() else 0.0
    if usual < LEAST_STEPS * scale:
        row = int(np.nanargmax(np.abs(rest)))
        text = f"{name} is {values[row]:g} at row {row} (t = {row / rate_hz:.6g} s), and usually about {usual:.3g}"
        remedy = "a log resolves 2^-30 of the largest value; if that one is no measured value, cut the record there"
        raise LogError(f"{source}: {text}: {remedy}")
    return scale


def power_of_two(values: NDArray[Any]) -> float:
    """The scale of a column: value = count * scale exactly for whole numbers, else to 2^-30 of the largest."""
    whole = values.dtype.kind in "iu"
    if whole and (values.dtype.itemsize < 4 or (int(values.max()) < 2**31 - 1 and int(values.min()) > -(2**31))):
        return 1.0
    finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    largest = float(max(abs(float(finite.max())), abs(float(finite.min())))) if finite.size else 0.0
    if largest == 0.0:
        return 1.0
    return float(2.0 ** (np.frexp(largest)[1] - 30))
