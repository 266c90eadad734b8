"""`rotorscope import`: a file of another format into a log of ours.

Raw counts of a log are int32. Whole numbers go in as they are. Others are scaled by a power of two, channel by
channel, so that the largest comes to between 2^29 and 2^30: rounding is then 2^-30 of the largest value, some 180 dB
below it, and floats of 24 bits within a factor of 64 of the largest survive to the last bit. A large constant in a
channel is taken off first, and stands in the log as the offset of its signal. A value so large that rounding would
come near to the others is refused.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.base.console.memory import bounded_memory
from daq.base.console.output import Output, Progress, quiet_progress
from daq.base.contract.dates import utc_text
from daq.base.contract.errors import LogError
from daq.base.contract.sink import Session
from daq.exchange.checks import Record, load
from daq.exchange.measurement import findings
from daq.rig.rig import Rig, load_rig
from daq.rig.units import SI_UNIT
from drivers.contract import Block, Gap, Info, Notice, Reading, Signal
from drivers.foreign import CAPTURE_SUFFIXES

BLOCK_ROWS = 8192  # in a block
COUNT_BITS = 32
OFFSET_RATIO = 64.0  # of a constant over half the range of what changes, from which on it is taken off
SURVEYED_VALUES = 20_000_000  # samples of all channels, of a longer record the first: 10 s of computing
LEAST_STEPS = 256.0  # in the median of the sizes: rounding is then below -57 dB of it


def import_file(output: Output, path: Path, rig_path: Path, out: Path, rate_hz: float | None, gaps: bool) -> None:
    rig = load_rig(rig_path)
    if out.resolve() == path.resolve():
        raise LogError(f"{out}: is the file to import; choose another name for the log")
    if path.suffix.lower() in CAPTURE_SUFFIXES and (path.suffix.lower() != ".mf4" or rig.link.signals):
        _import_capture(output, path, rig, out)
        return
    found: list[Notice] = []  # for the log, too: whoever has only that is to know

    def say(text: str, code: str = "file_odd") -> None:
        output.note(f"{path}: {text}")
        found.append(Notice(time.monotonic_ns(), "warning", code, text))

    with output.progress(f"reading {path.name}"):
        record = load(path, rig, rate_hz, say, gaps)
    lost = 0 if record.missing is None else int(record.missing.sum())
    for code, text in findings(record.si(), record.rate_hz, rig, SURVEYED_VALUES):
        say(text, code)
    with output.progress(f"writing {out.name}") as progress:
        write_record(record, rig, out, {"source": path.name}, progress, output.note, found)
    value = {
        "schema": 1,
        "file": str(out),
        "channels": list(record.names),
        "samples": record.samples - lost,
        "lost_samples": lost,
        "rate_hz": record.rate_hz,
        "seconds": record.samples / record.rate_hz,
        "started": None if record.started_ns is None else utc_text(record.started_ns),
    }
    text = f"{record.samples / record.rate_hz:.6g} s of {len(record.names)} channels at {record.rate_hz:g} Hz"
    output.result(value, f"{out}: {text}{f', {lost} samples missing' if lost else ''}")


def _import_capture(output: Output, path: Path, rig: Rig, out: Path) -> None:
    """Recorded CAN traffic goes through the driver and the pipeline that live traffic takes."""
    from daq.commands.live.run import run_rig

    if not path.is_file():
        raise LogError(f"{path}: there is no such file; check the path")
    with bounded_memory(path.stat().st_size):  # what cannot be unpacked in it is damage of the file
        run_rig(output, rig, f"capture:{path}", out, command="import")


def write_record(
    record: Record, rig: Rig, out: Path, metadata: dict[str, str], progress: Progress = quiet_progress,
    note: Callable[[str], None] = lambda text: None, found: Sequence[Notice] = (),
) -> None:  # fmt: skip
    """Write a log of a record and of what was found in it: all or none. Raises LogError if it cannot be written."""
    from daq.base.contract.dates import Recorded
    from daq.log.writer import LogWriter

    levels = [level(v) for v in record.values]
    scales = [
        resolved(out, n, v, z, record.rate_hz) for n, v, z in zip(record.names, record.values, levels, strict=True)
    ]
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
    """What made the log."""
    return {"command": "import", "rotorscope": version("rotorscope")}


def _blocks(record: Record, scales: list[float], levels: list[float]) -> Iterator[tuple[int, list[Reading]]]:
    start_ns = time.monotonic_ns() if record.started_ns is None else record.started_ns
    for first, stop, present in _runs(record):
        if not present:
            yield stop, [Gap(first, stop - first, "source")]
            continue
        for index in range(first, stop, BLOCK_ROWS):
            end = min(index + BLOCK_ROWS, stop)
            counts = np.empty((end - index, len(scales)), dtype=np.int32)
            for k, (value, scale, zero) in enumerate(zip(record.values, scales, levels, strict=True)):
                counts[:, k] = np.rint((np.asarray(value[index:end], dtype=np.float64) - zero) / scale)
            yield end, [Block(index, counts, start_ns + round(1e9 * (end - 1) / record.rate_hz))]


def _runs(record: Record) -> Iterator[tuple[int, int, bool]]:
    """(first, stop, present) of runs of rows that are there or not."""
    if record.missing is None:
        yield 0, record.samples, True
        return
    edges = [0, *(np.flatnonzero(np.diff(record.missing)) + 1).tolist(), record.samples]
    for first, stop in zip(edges, edges[1:], strict=False):
        yield first, stop, not record.missing[first]


def level(values: NDArray[Any]) -> float:
    """The constant to take off a column: 0 unless it is far larger than what changes."""
    if not values.size or (values.dtype.kind in "iu" and power_of_two(values) == 1.0):
        return 0.0
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0
    low, high = float(finite.min()), float(finite.max())
    return low / 2 + high / 2 if max(abs(low), abs(high)) > OFFSET_RATIO * (high / 2 - low / 2) > 0 else 0.0


def resolved(out: Path, name: str, values: NDArray[Any], zero: float, rate_hz: float) -> float:
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
        raise LogError(f"{out}: {text}: {remedy}")
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
