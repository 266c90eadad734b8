"""The trend on disk: a Parquet file for each day (UTC), and a stream that grows while the day goes on.

Rows go to `DAY.N.arrows`, an Arrow stream: what was written is read also if its end is cut. When the day is over, or
the session ends, they are put into `DAY.parquet`, and the stream is removed.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from daq.base.console import unfinished
from daq.base.console.extras import required
from daq.log.place import being_written, locked

TREND_SCHEMA = "1"  # version of the columns
VERSION_KEY = b"rotorscope.trend"
PYARROW_EXTRA = "formats"  # of the package
STREAM_SUFFIX, DAY_SUFFIX = ".arrows", ".parquet"
READ_TRIES = 3
MAX_PENDING = 20_000  # rows that wait for the disk: hours


def arrow(module: str = "pyarrow") -> Any:
    """A module of pyarrow. Raises ConfigError with what to type if it is not installed."""
    return required(module, PYARROW_EXTRA, "the trend")


class Row(NamedTuple):
    """A number of the trend. time_ns : Unix time; sd : None where none is known."""

    time_ns: int
    kind: str
    name: str
    value: float | None = None
    sd: float | None = None
    unit: str = ""
    text: str = ""


def schema() -> Any:
    """The columns, as Arrow has them."""
    pa = arrow()
    text = [(name, pa.string()) for name in ("kind", "name", "unit", "text")]
    number = [("value", pa.float64()), ("sd", pa.float64())]
    fields = [("time", pa.timestamp("us", tz="UTC")), *text[:2], *number, *text[2:]]
    return pa.schema(fields, metadata={VERSION_KEY: TREND_SCHEMA.encode()})


def table(rows: Sequence[Row]) -> Any:
    """Rows as an Arrow table."""
    pa = arrow()
    columns = {name: [getattr(row, name) for row in rows] for name in Row._fields[1:]}
    columns["time"] = [row.time_ns // 1000 for row in rows]
    return pa.table({name: columns[name] for name in schema().names}, schema=schema())


def day_name(time_ns: int) -> str:
    """2026-11-28, in UTC."""
    return datetime.fromtimestamp(time_ns // 10**9, UTC).strftime("%Y-%m-%d")


class DayWriter:
    """Appends rows to the file of their day. One thread. Rows that the disk does not take wait for the next call."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._day = ""
        self._file: Any = None
        self._stream: Any = None
        self._pending: list[Row] = []
        for day in days_of(folder, STREAM_SUFFIX):  # of a session that was killed
            compact(folder, day)

    def append(self, rows: Iterable[Row]) -> None:
        """Raises OSError; then the rows wait, the newest `MAX_PENDING` of them."""
        self._pending = [*self._pending, *rows][-MAX_PENDING:]
        while self._pending:
            day = day_name(self._pending[0].time_ns)
            count = next((k for k, row in enumerate(self._pending) if day_name(row.time_ns) != day), len(self._pending))
            if day != self._day:
                self.end_day()
            try:
                self._write(day, table(self._pending[:count]))
            except OSError:
                self._drop_stream()  # it may hold half of this: the next one begins anew
                raise
            self._pending = self._pending[count:]

    def end_day(self) -> None:
        """Put the rows of the day into its file. Raises OSError; the stream stays then, and is read as well."""
        day, self._day = self._day, ""
        self._drop_stream()
        if day:
            compact(self._folder, day)

    def _write(self, day: str, rows: Any) -> None:
        if self._stream is None:
            self._begin(day)
        self._stream.write_table(rows)
        self._file.flush()

    def _begin(self, day: str) -> None:
        ipc = arrow("pyarrow.ipc")
        number = 0
        while True:
            path = self._folder / f"{day}.{number}{STREAM_SUFFIX}"
            try:
                fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0), 0o644)
                break
            except FileExistsError:
                number += 1
        locked(fd)
        self._file = os.fdopen(fd, "wb")
        self._day = day
        self._stream = ipc.new_stream(self._file, schema())

    def _drop_stream(self) -> None:
        stream, file, self._stream, self._file = self._stream, self._file, None, None
        for one in (stream, file):
            if one is not None:
                with suppress(OSError):
                    one.close()


def days_of(folder: Path, suffix: str) -> list[str]:
    """The days of which there are files of this ending, in order."""
    return sorted({path.name.partition(".")[0] for path in folder.glob(f"*{suffix}")})


def streams(folder: Path, day: str) -> list[Path]:
    """The streams of a day, in the order in which they were made."""
    found = folder.glob(f"{day}.*{STREAM_SUFFIX}")
    return sorted(found, key=lambda path: int(n) if (n := path.name.split(".")[1]).isdecimal() else 0)


def compact(folder: Path, day: str) -> None:
    """Put the streams of a day, those of others that still write excepted, into its file. Raises OSError."""
    pa, parquet = (
        arrow(),
        arrow("pyarrow.parquet"),
    )
    own = [path for path in streams(folder, day) if not being_written(path)]
    path = folder / f"{day}{DAY_SUFFIX}"
    parts = [parquet.read_table(path)] if path.exists() else []
    parts += [batch for stream in own for batch in stream_tables(stream)]
    if parts:
        whole = pa.concat_tables([part.cast(schema()) for part in parts]).sort_by("time")
        with unfinished.half(path) as half:
            parquet.write_table(whole, half, compression="zstd")
            os.replace(half, path)
    for stream in own:
        stream.unlink(missing_ok=True)


def stream_tables(path: Path) -> Iterator[Any]:
    """The complete rows of a stream."""
    pa, ipc = arrow(), arrow("pyarrow.ipc")
    with suppress(pa.ArrowInvalid, OSError, EOFError), path.open("rb") as file, ipc.open_stream(file) as reader:
        for batch in reader:
            yield pa.Table.from_batches([batch])


def read_day(folder: Path, day: str) -> Any:
    """All rows of a day, in the order of time: an Arrow table. Raises OSError."""
    path, parts = folder / f"{day}{DAY_SUFFIX}", list[Any]()
    for _ in range(READ_TRIES):  # a service may put its streams into the file meanwhile
        own = streams(folder, day)
        parts = [arrow("pyarrow.parquet").read_table(path)] if path.exists() else []
        parts += [batch for stream in own for batch in stream_tables(stream)]
        if streams(folder, day) == own:
            break
    whole = arrow().concat_tables([part.cast(schema()) for part in parts]) if parts else schema().empty_table()
    return whole.sort_by("time")


def read_days(folder: Path) -> Any:
    """All rows of a trend, in the order of time: an Arrow table. Raises OSError."""
    days = sorted({*days_of(folder, DAY_SUFFIX), *days_of(folder, STREAM_SUFFIX)})
    return arrow().concat_tables([read_day(folder, day) for day in days] or [schema().empty_table()])
