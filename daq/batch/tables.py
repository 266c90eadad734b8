"""The results of an archive as Parquet: a folder with a file for each table, and pieces that are not merged yet.

A piece holds the rows of some tasks, and gets its name when it is complete. A merge writes the tables anew from tables
and pieces, and then removes the pieces. If the program is killed at any moment, the next call finds all results.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.base.console.output import finite
from daq.base.console.unfinished import half
from daq.base.contract.errors import ConfigError, LogError, not_written
from daq.log.place import locked

if TYPE_CHECKING:
    import pyarrow as pa

SCHEMA_VERSION = "1"
SCHEMA_KEY, TABLE_KEY, CORRECTION_KEY = "rotorscope.schema", "rotorscope.table", "rotorscope.p_archive"
PIECES_NAME, LOCK_NAME = "pieces", ".lock"
MAX_FALSE_DISCOVERY_RATE = 0.05  # of what is named in an archive (Benjamini and Hochberg 1995)
OF_RUN = {
    "key": "string", "log": "string", "rig": "string", "machine": "string", "started": "time", "from_s": "float64",
}  # fmt: skip
TABLE_COLUMNS = {
    "runs": OF_RUN | {
        "task": "string", "window_s": "float64", "seconds": "float64", "rate_hz": "float64", "status": "string",
        "code": "string", "reason": "string", "notes": "strings", "took_s": "float64", "cpu_s": "float64",
        "bound_mb": "float64", "peak_mb": "float64", "version": "string", "run_at": "time",
    },
    "parameters": OF_RUN | {
        "name": "string", "value": "float64", "sd": "float64", "unit": "string", "identifiable": "bool_",
    },
    "verdicts": OF_RUN | {
        "task": "string", "verdict": "string", "at": "strings", "order": "float64", "judged": "bool_",
        "p_value": "float64", "p_archive": "float64", "p_archive_records": "int64", "stands": "bool_",
        "heldout_gain": "float64", "missing_force_percent": "float64", "missing_force_low": "float64",
        "missing_force_high": "float64", "missing_force_after_percent": "float64", "runner_up": "string",
        "adequate": "bool_", "heldout_nll": "float64", "reference_nll": "float64", "codes": "strings",
    },
    "severity": OF_RUN | {
        "channel": "string", "unit": "string", "rms": "float64", "peak": "float64", "crest": "float64",
        "kurtosis": "float64", "velocity_rms_mm_s": "float64", "displacement_rms_um": "float64", "zone": "string",
    },
}  # fmt: skip
Place = tuple[Any, ...]  # what a run is of: the values of these columns
PLACE_COLUMNS = ("log", "rig", "task", "from_s", "window_s")
SORT_COLUMNS = ("log", "rig", "from_s", "task")
DONE_STATUS = "done"
NOTHING_NAMED = ("complete", "unknown")  # verdicts that name no effect


def schema(table: str) -> pa.Schema:
    """Columns of a table, with its name and the version of the schema in the file's metadata."""
    import pyarrow as pa

    kinds = {"time": pa.timestamp("us", tz="UTC"), "strings": pa.list_(pa.string())}
    kinds |= {name: getattr(pa, name)() for name in ("string", "float64", "int64", "bool_")}
    fields = [(name, kinds[kind]) for name, kind in TABLE_COLUMNS[table].items()]
    return pa.schema(fields, metadata={SCHEMA_KEY: SCHEMA_VERSION, TABLE_KEY: table})


class Results:
    """A folder of results, locked while it is open."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._pieces = folder / PIECES_NAME

    @classmethod
    @contextmanager
    def opened(cls, folder: Path) -> Iterator[Results]:
        """Open a folder. Raises ConfigError if it cannot be made, another command uses it, or the schema differs."""
        own = cls(folder)
        try:
            own._pieces.mkdir(parents=True, exist_ok=True)
            lock = os.open(folder / LOCK_NAME, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise ConfigError(f"--out {folder}: cannot be made: {error.strerror}; choose another folder") from error
        try:
            if not locked(lock):
                raise ConfigError(f"--out {folder}: another rotorscope batch writes there; wait for it, or stop it")
            own.merge()
            yield own
        finally:
            os.close(lock)

    def known(self) -> dict[Place, tuple[str, str, float]]:
        """Key, status and length in s of each run, by its place."""
        rows = self._columns("runs", (*PLACE_COLUMNS, "key", "status", "seconds"))
        return {tuple(place): (key, status, seconds) for *place, key, status, seconds in rows}

    def failed(self) -> list[tuple[str, str]]:
        """Code and reason of each run that failed."""
        rows = self._columns("runs", ("status", "code", "reason"))
        return [(code, reason) for status, code, reason in rows if status != DONE_STATUS]

    def verdicts(self) -> list[tuple[str, bool]]:
        """Verdict of each diagnosis, and whether it stays significant in the archive."""
        rows = self._columns("verdicts", ("task", "verdict", "stands"))
        return [(verdict, bool(stands)) for task, verdict, stands in rows if task == "diagnose"]

    def add(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Store rows of runs, each with its `rows`, as one piece. Raises LogError or ConfigError if it cannot be."""
        import pyarrow as pa
        from pyarrow import parquet

        if not rows:
            return
        texts = [json.dumps(finite(_plain(row)), allow_nan=False) for row in rows]
        path = self._pieces / f"{1 + max((int(p.stem) for p in self._numbered()), default=0):08d}.parquet"
        _write(path, pa.table({"row": texts}), parquet)

    def merge(self) -> None:
        """Bring all pieces into the tables. Raises LogError or ConfigError if these cannot be written."""
        from pyarrow import parquet

        pieces = self._numbered()
        rows: dict[Place, dict[str, Any]] = {}
        for path in pieces:
            for row in self._piece(path):
                rows[tuple(row[c] for c in PLACE_COLUMNS)] = row  # the newest one holds
        if not rows and (self.folder / "runs.parquet").exists():
            self._remove(pieces)
            return
        gone = {row["key"] for row in rows.values()}  # some tables may have them from a merge that was cut off
        without_rig = {(log, "", *rest) for log, _, *rest in rows}  # and now it has one
        for *place, key in self._columns("runs", (*PLACE_COLUMNS, "key")):
            if tuple(place) in rows or tuple(place) in without_rig:
                gone.add(key)
        for name in reversed(TABLE_COLUMNS):  # runs last: it says what is gone
            whole = _merged(self._table(name), name, list(rows.values()), gone)
            _write(self.folder / f"{name}.parquet", whole, parquet)
        self._remove(pieces)

    def _columns(self, table: str, names: Sequence[str]) -> Iterator[tuple[Any, ...]]:
        """Some columns of a table, row by row: many rows as dictionaries would fill the memory."""
        whole = self._table(table)
        return zip(*(whole[name].to_pylist() for name in names), strict=True)

    def _table(self, name: str) -> pa.Table:
        from pyarrow import ArrowException, parquet

        path = self.folder / f"{name}.parquet"
        if not path.exists():
            return schema(name).empty_table()
        try:
            table = parquet.read_table(path)
        except (OSError, ArrowException) as error:
            text = f"{path}: cannot be read as a table: {error}; move it away, or choose another --out"
            raise LogError(text) from error
        version = (table.schema.metadata or {}).get(SCHEMA_KEY.encode(), b"none").decode()
        if version != SCHEMA_VERSION:
            text = f"{path}: its schema is {version}, and this rotorscope writes {SCHEMA_VERSION}; choose another --out"
            raise ConfigError(text)
        return table

    def _numbered(self) -> list[Path]:
        return sorted(path for path in self._pieces.glob("*.parquet") if path.stem.isdecimal())

    @staticmethod
    def _piece(path: Path) -> list[dict[str, Any]]:
        """The rows of a piece; none for a piece that a power cut left incomplete."""
        from pyarrow import ArrowException, parquet

        with suppress(OSError, ArrowException, ValueError):
            return [json.loads(text) for text in parquet.read_table(path)["row"].to_pylist()]
        return []

    @staticmethod
    def _remove(pieces: Sequence[Path]) -> None:
        for path in pieces:
            path.unlink(missing_ok=True)


def _write(path: Path, table: pa.Table, parquet: Any) -> None:
    """Write a table to a temporary file, and rename it."""
    try:
        with half(path) as aside:
            parquet.write_table(table, aside, compression="zstd")
            os.replace(aside, path)
    except OSError as error:
        raise not_written(path, error) from error


def _plain(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row for JSON: times are Unix times in s."""
    return {k: v.timestamp() if isinstance(v, datetime) else v for k, v in row.items()}


def _merged(old: pa.Table, name: str, rows: Sequence[Mapping[str, Any]], gone: set[str]) -> pa.Table:
    """A table without the rows of the keys that are gone, with those of new runs, sorted."""
    import pyarrow as pa
    import pyarrow.compute as pc

    form = schema(name)
    own = [row for run in rows for row in _rows_in(name, run)]
    columns = {c: [_typed(row.get(c), TABLE_COLUMNS[name][c]) for row in own] for c in form.names}
    kept = old.filter(pc.invert(pc.is_in(old["key"], value_set=pa.array(sorted(gone), pa.string()))))
    whole = pa.concat_tables([kept.cast(form), pa.table(columns, schema=form)])
    order = [(c, "ascending") for c in SORT_COLUMNS if c in form.names]
    whole = whole.take(pc.sort_indices(whole, sort_keys=order))
    return _corrected(whole) if name == "verdicts" else whole.replace_schema_metadata(form.metadata)


def _rows_in(name: str, run: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """The rows of one run in one table."""
    if name == "runs":
        yield dict(run)
        return
    of_run = {column: run.get(column) for column in (*OF_RUN, "task")}
    yield from (of_run | row for row in run["rows"].get(name, ()))


def _typed(value: Any, kind: str) -> Any:
    return datetime.fromtimestamp(value, UTC) if kind == "time" and value is not None else value


def _corrected(verdicts: pa.Table) -> pa.Table:
    """The table of verdicts with p-values corrected for the number of its records."""
    import pyarrow as pa
    from scipy.stats import false_discovery_control

    p_values = verdicts["p_value"].to_pylist()
    at = [k for k, p in enumerate(p_values) if p is not None]
    archive: list[float | None] = [None] * len(p_values)
    corrected = false_discovery_control(np.clip([p_values[k] for k in at], 0.0, 1.0)) if at else ()
    for k, p in zip(at, corrected, strict=True):
        archive[k] = float(p)
    named = [v is not None and v not in NOTHING_NAMED for v in verdicts["verdict"].to_pylist()]
    below = [p is not None and p <= MAX_FALSE_DISCOVERY_RATE for p in archive]
    columns = {
        "p_archive": pa.array(archive, pa.float64()),
        "p_archive_records": pa.array([None if p is None else len(at) for p in archive], pa.int64()),
        "stands": pa.array([yes if n else None for n, yes in zip(named, below, strict=True)], pa.bool_()),
    }
    for name, values in columns.items():
        verdicts = verdicts.set_column(verdicts.schema.get_field_index(name), name, values)
    text = (
        f"p_value pays for all that was searched in its record; p_archive also for the {len(at)} records of this table "
        f"(Benjamini-Hochberg); stands: p_archive <= {MAX_FALSE_DISCOVERY_RATE:g}"
    )
    return verdicts.replace_schema_metadata({**(schema("verdicts").metadata or {}), CORRECTION_KEY: text})
