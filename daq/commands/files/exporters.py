"""`rotorscope export`: a log into another format. Values in the units of the log's rig file; gaps are NaN, and said."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.base.console.output import Output
from daq.base.console.tables import gap_lines
from daq.base.console.unfinished import half, led_to
from daq.base.contract.errors import ConfigError, LogError, not_written
from daq.log.reader import Recording, read_log
from daq.rig.rig import Rig

CSV_ROWS = 50_000


@dataclass(frozen=True, slots=True)
class Table:
    """names, units and (n, channels) values; NaN where a sample is missing."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: NDArray[np.float64]
    rate_hz: float


def export(output: Output, log: Path, to: Path) -> None:
    writer = WRITER_OF_SUFFIX.get(to.suffix.lower())
    if writer is None:
        raise ConfigError(
            f'{to}: cannot export to a file that ends in "{to.suffix}"; known are {", ".join(WRITER_OF_SUFFIX)}'
        )
    recording = read_log(log)
    with output.progress(f"exporting to {to.name}"):
        table = in_units(recording)
        if not len(table.values):
            raise LogError(f"{log}: holds no samples; there is nothing to export")
        try:
            place = led_to(to)
            temporary = place.with_name(f".{place.name}.part{to.suffix}")
            with half(temporary):
                writer(table, temporary)
                temporary.replace(place)
        except OSError as error:
            raise not_written(to, error) from error
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
    value = {
        "schema": 1,
        "file": str(to),
        "channels": list(table.names),
        "units": list(table.units),
        "samples": recording.n_samples,
        "lost_samples": recording.lost_samples,
        "rate_hz": table.rate_hz,
    }
    seconds = len(table.values) / table.rate_hz
    output.result(value, f"{to}: {seconds:.6g} s of {', '.join(table.names)} at {table.rate_hz:g} Hz")


def in_units(recording: Recording) -> Table:
    """The samples of a log in the units of its own rig file; in SI where that does not know a channel."""
    names, units = recording.channels, [s.unit for s in recording.info.signals]
    values = recording.samples()
    try:
        rig = Rig.parse(recording.rig_text)
    except (ConfigError, LogError):
        return Table(names, tuple(units), values, recording.rate_hz)
    for k, name in enumerate(names):
        if name in rig.units:
            column = [c.name for c in rig.model.channels].index(name)
            values[:, k] /= rig.factors[column]
            units[k] = rig.units[name]
    return Table(names, tuple(units), values, recording.rate_hz)


def _npz(table: Table, path: Path) -> None:
    arrays = {name: table.values[:, k] for k, name in enumerate(table.names)}
    np.savez(path, allow_pickle=False, rate_hz=np.float64(table.rate_hz), **arrays)


def _csv(table: Table, path: Path) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(",".join(["time", *(f"{n} [{u}]" for n, u in zip(table.names, table.units, strict=True))]) + "\n")
        for start in range(0, len(table.values), CSV_ROWS):
            rows = table.values[start : start + CSV_ROWS]
            time = (start + np.arange(len(rows))) / table.rate_hz
            lines = (
                f"{t:.9f}," + ",".join(map(repr, row)) for t, row in zip(time.tolist(), rows.tolist(), strict=True)
            )
            file.write("\n".join(lines) + "\n")


def _mat(table: Table, path: Path) -> None:
    import scipy.io

    names = {name: name.replace(".", "_").replace("-", "_") for name in table.names}
    columns = {names[name]: table.values[:, k] for k, name in enumerate(table.names)}
    scipy.io.savemat(path, columns | {"rate_hz": table.rate_hz}, oned_as="column", do_compression=True)


def _wav(table: Table, path: Path) -> None:
    from scipy.io import wavfile

    if table.rate_hz != round(table.rate_hz):
        raise LogError(f"{path.suffix}: a .wav holds whole rates only, not {table.rate_hz:g} Hz; export to .npz")
    wavfile.write(path, round(table.rate_hz), table.values.astype(np.float32))


def _mf4(table: Table, path: Path) -> None:
    from asammdf import MDF, Signal

    time = np.arange(len(table.values)) / table.rate_hz
    with MDF(version="4.10") as file:
        signals = [
            Signal(table.values[:, k], time, name=name, unit=unit)
            for k, (name, unit) in enumerate(zip(table.names, table.units, strict=True))
        ]
        file.append(signals)
        file.save(path, overwrite=True)


WRITER_OF_SUFFIX: dict[str, Callable[[Table, Path], None]] = {
    ".npz": _npz, ".csv": _csv, ".mat": _mat, ".wav": _wav, ".mf4": _mf4,
}  # fmt: skip
