"""`rotorscope export`: a log into another format. Values in the units of the log's rig file; gaps are NaN."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.base.console.extras import required
from daq.base.console.output import Output, spare
from daq.base.console.tables import gap_lines
from daq.base.console.unfinished import half, led_to
from daq.base.contract.dates import utc_text
from daq.base.contract.errors import ConfigError, LogError, not_written
from daq.base.contract.part import WHOLE_RECORD, Part
from daq.log.reader import Recording, read_log
from daq.rig.rig import Rig

from .archives import write_hdf5, write_parquet, write_uff
from .recordings import write_mcap, write_rrd

CSV_ROWS = 50_000
LONGEST_MAT_NAME = 63  # characters, of a variable of MATLAB
RESERVED_NAMES = {
    ".npz": ("rate_hz", "started", "channels", "units", "file"),  # file: the first argument of numpy.savez
    ".csv": ("time",),
    ".mat": ("rate_hz", "started", "channels", "units"),
    ".mf4": ("time",),
    ".parquet": ("time",),
}
SI_SUFFIXES = (".mcap", ".rrd")  # that hold SI units whatever the rig file says


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """names, units and (n, channels) values; NaN where a sample is missing.

    channels : their names in the log, which may be equal, or taken in a format. started_ns : Unix time of row 0.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: NDArray[np.float64]
    rate_hz: float
    channels: tuple[str, ...] = ()
    started_ns: int | None = None

    @property
    def started(self) -> str:
        """As text; "" if it is not known."""
        return "" if self.started_ns is None else utc_text(self.started_ns)


def export(output: Output, log: Path, to: Path, part: Part = WHOLE_RECORD) -> None:
    suffix = to.suffix.lower()
    writer = WRITER_OF_SUFFIX.get(suffix)
    if writer is None:
        raise ConfigError(
            f'{to}: cannot export to a file that ends in "{to.suffix}"; known are {", ".join(WRITER_OF_SUFFIX)}'
        )
    if suffix == ".mcap":
        spare(to)  # it may be a log
    recording, notes = read_log(log, part=part), list[str]()
    with output.progress(f"exporting to {to.name}"):
        table = named(in_si(recording) if suffix in SI_SUFFIXES else in_units(recording, notes.append), suffix)
        if not len(table.values):
            raise LogError(f"{log}: holds no samples; there is nothing to export")
        try:
            place = led_to(to)
            with half(place) as temporary:
                writer(table, temporary)
                temporary.replace(place)
        except OSError as error:
            raise not_written(to, error) from error
    for line in notes:
        output.note(line)
    _say(output, recording, table, to)
    value = {
        "schema": 1,
        "file": str(to),
        "channels": list(table.names),
        "units": list(table.units),
        "samples": recording.n_samples,
        "lost_samples": recording.lost_samples,
        "rate_hz": table.rate_hz,
        "started": table.started or None,
    }
    if recording.from_s is not None:
        value["from_s"] = recording.from_s
    if recording.from_s:
        output.note(f"{to}: its time 0 is {recording.from_s:.9g} s of {log}")
    seconds = len(table.values) / table.rate_hz
    output.result(value, f"{to}: {seconds:.6g} s of {', '.join(table.names)} at {table.rate_hz:g} Hz")


def _say(output: Output, recording: Recording, table: Table, to: Path) -> None:
    """Print what a reader of the export must know."""
    log = recording.path
    for number, (name, channel) in enumerate(zip(table.names, table.channels, strict=True), 1):
        if name != channel:
            output.note(
                f'{to}: channel {number}, "{channel}", is called "{name}" there: its name is taken or not allowed'
            )
    for line in gap_lines(recording.gaps, recording.first, recording.rate_hz):
        output.note(line)
    if recording.lost_samples:
        output.note(f"{to}: the {recording.lost_samples} missing samples are NaN")
    for other in recording.others:
        output.note(f"{log}: {other} are NaN in {to}")
    if recording.growing:
        output.note(f"{log}: is being written; {to} ends with sample {recording.stop - 1}")
    elif not recording.complete:
        output.note(f"{log}: is not complete; `rotorscope recover` says what was lost")


def in_si(recording: Recording) -> Table:
    """The samples of a log in SI units."""
    return Table(
        names=recording.channels,
        units=tuple(s.unit for s in recording.info.signals),
        values=recording.samples(),
        rate_hz=recording.rate_hz,
        channels=recording.channels,
        started_ns=recording.started_ns,
    )


def in_units(recording: Recording, note: Callable[[str], None]) -> Table:
    """Samples of a log in the units of its rig file; in SI for a channel that the file lacks, or without the file."""
    names, units = recording.channels, [s.unit for s in recording.info.signals]
    values = recording.samples()
    table = Table(
        names=names,
        units=tuple(units),
        values=values,
        rate_hz=recording.rate_hz,
        channels=names,
        started_ns=recording.started_ns,
    )
    try:
        rig = Rig.parse(recording.rig_text, attached=recording.attachments)
    except (ConfigError, LogError):
        said = ", ".join(f"{n} in {u or 'no unit'}" for n, u in zip(names, units, strict=True))
        note(f"{recording.path}: holds no intact rig file (rig.toml), so values are in SI units: {said}")
        return table
    for k, name in enumerate(names):
        if name in rig.units:
            column = [c.name for c in rig.model.channels].index(name)
            values[:, k] /= rig.factors[column]
            units[k] = rig.units[name]
    return replace(table, units=tuple(units))


def named(table: Table, suffix: str) -> Table:
    """The table with names that the format can hold, each once and none reserved."""
    taken, names = set(RESERVED_NAMES.get(suffix, ())), []
    wanted = [_matlab_name(c) if suffix == ".mat" else c or "channel" for c in table.channels]
    for name in wanted:
        free, number = name, 2
        while free in taken or (free != name and free in wanted):
            end = f"_{number}"
            free, number = (name[: LONGEST_MAT_NAME - len(end)] if suffix == ".mat" else name) + end, number + 1
        taken.add(free)
        names.append(free)
    return replace(table, names=tuple(names))


def _matlab_name(name: str) -> str:
    text = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return (text if re.match(r"[A-Za-z]", text) else f"x{text}")[:LONGEST_MAT_NAME]


def _npz(table: Table, path: Path) -> None:
    arrays = {name: table.values[:, k] for k, name in enumerate(table.names)}
    about = {"rate_hz": np.float64(table.rate_hz), "channels": np.array(table.names), "units": np.array(table.units)}
    if table.started:
        about["started"] = np.array(table.started)
    np.savez(path, allow_pickle=False, **about, **arrays)  # type: ignore[arg-type]


def _csv(table: Table, path: Path) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(_csv_line(["time", *(f"{n} [{u}]" for n, u in zip(table.names, table.units, strict=True))]) + "\n")
        for start in range(0, len(table.values), CSV_ROWS):
            rows = table.values[start : start + CSV_ROWS]
            time = (start + np.arange(len(rows))) / table.rate_hz
            lines = (
                f"{t:.9f}," + ",".join(map(repr, row)) for t, row in zip(time.tolist(), rows.tolist(), strict=True)
            )
            file.write("\n".join(lines) + "\n")
        if table.started:
            file.write(f"# started {table.started}\n")


def _csv_line(cells: Iterable[str]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow(cells)
    return text.getvalue()


def _mat(table: Table, path: Path) -> None:
    import scipy.io

    columns: dict[str, object] = {name: table.values[:, k] for k, name in enumerate(table.names)}
    about = {"rate_hz": table.rate_hz, "channels": list(table.names), "units": list(table.units)}
    if table.started:
        about["started"] = table.started
    scipy.io.savemat(path, columns | about, oned_as="column", do_compression=True)


def _wav(table: Table, path: Path) -> None:
    from scipy.io import wavfile

    if table.rate_hz != round(table.rate_hz):
        raise LogError(f"{path.suffix}: a .wav holds whole rates only, not {table.rate_hz:g} Hz; export to .npz")
    wavfile.write(path, round(table.rate_hz), table.values.astype(np.float32))
    about = json.dumps({"rotorscope": {"channels": table.channels, "units": table.units, "started": table.started}})
    info = b"INFO" + _riff(b"ICRD", table.started[:10].encode()) * bool(table.started) + _riff(b"ICMT", about.encode())
    with path.open("r+b") as file:
        file.seek(0, io.SEEK_END)
        file.write(_riff(b"LIST", info))
        size = file.tell() - 8
        file.seek(4)
        file.write(size.to_bytes(4, "little"))


def _riff(name: bytes, content: bytes) -> bytes:
    """A chunk of a .wav."""
    return name + len(content).to_bytes(4, "little") + content + bytes(len(content) % 2)


def _mf4(table: Table, path: Path) -> None:
    asammdf = required("asammdf", "formats", ".mf4")
    MDF, Signal = asammdf.MDF, asammdf.Signal
    time = np.arange(len(table.values)) / table.rate_hz
    with MDF(version="4.10") as file:
        signals = [
            Signal(table.values[:, k], time, name=name, unit=unit)
            for k, (name, unit) in enumerate(zip(table.names, table.units, strict=True))
        ]
        file.append(signals)
        file.header.start_time = datetime.fromtimestamp((table.started_ns or 0) / 1e9, UTC)  # 1970: not known
        file.save(path, overwrite=True)


WRITER_OF_SUFFIX: dict[str, Callable[[Table, Path], None]] = {
    ".npz": _npz, ".csv": _csv, ".mat": _mat, ".wav": _wav, ".mf4": _mf4, ".mcap": write_mcap, ".rrd": write_rrd,
    ".uff": write_uff, ".h5": write_hdf5, ".parquet": write_parquet,
}  # fmt: skip
