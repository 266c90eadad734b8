"""The results of `rotorscope batch` as a trend: a row for each number of each record, at the time of the record."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from daq.base.contract.errors import ConfigError

from .days import Row, arrow, table
from .store import LEVEL_NAMES, UNIT_OF_LEVEL

RESULT_TABLES = ("runs", "parameters", "verdicts", "severity")
SCHEMA_KEY, SCHEMA_VERSION = b"rotorscope.schema", b"1"  # of the tables that are understood
NOTHING_NAMED = ("complete", "unknown")  # verdicts that are no event
MAX_LISTED = 10  # machines in a message


def is_results(folder: Path) -> bool:
    """Whether a folder holds tables of `rotorscope batch`."""
    return (folder / "runs.parquet").is_file()


def results_rows(folder: Path, machine: str | None = None) -> Any:
    """An Arrow table as `read_day` gives it, in the order of time.

    machine : of several. Records whose source says no date are left out. Raises ConfigError, OSError.
    """
    found = {name: _read(folder / f"{name}.parquet") for name in RESULT_TABLES}
    own = _machine(folder, [_whose(row) for row in found["runs"]], machine)
    rows = [
        row for name, read in ROWS_OF_TABLE.items() for one in found[name] if _whose(one) == own for row in read(one)
    ]
    return table(sorted(rows, key=lambda row: row.time_ns))


def _read(path: Path) -> list[dict[str, Any]]:
    if not path.is_file():
        return []
    found = arrow("pyarrow.parquet").read_table(path)
    version = (found.schema.metadata or {}).get(SCHEMA_KEY)
    if version != SCHEMA_VERSION:
        said = version.decode("utf-8", "replace") if version else "none"
        raise ConfigError(
            f"{path}: its schema is {said}, and {SCHEMA_VERSION.decode()} is understood: update rotorscope"
        )
    rows: list[dict[str, Any]] = found.to_pylist()
    return rows


def _whose(row: dict[str, Any]) -> str:
    """The machine of a row; where none is named, its rig file."""
    return str(row["machine"] or row["rig"] or "")


def _machine(folder: Path, names: list[str], asked: str | None) -> str:
    known = list(dict.fromkeys(names))
    if asked is None and len(known) > 1:
        more = f" and {len(known) - MAX_LISTED} more" if len(known) > MAX_LISTED else ""
        listed = ", ".join(known[:MAX_LISTED]) + more
        raise ConfigError(f"{folder}: holds {len(known)} machines ({listed}): say which with --machine")
    if asked is not None and asked not in known:
        raise ConfigError(f"--machine {asked}: is not in {folder}; there are {', '.join(known[:MAX_LISTED])}")
    return known[0] if asked is None else asked


def _time_ns(row: dict[str, Any]) -> int | None:
    """Unix time of the start of what was looked at, of a window its own; None where it is not known."""
    started: datetime | None = row["started"]
    if started is None:
        return None
    return round((started - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds() * 1e6) * 1000


def _parameter(row: dict[str, Any]) -> Iterator[Row]:
    time = _time_ns(row)
    if time is not None and row["identifiable"] and row["value"] is not None and row["sd"] != 0:  # 0: given
        yield Row(time, "estimate", row["name"], value=row["value"], sd=row["sd"], unit=row["unit"] or "")


def _severity(row: dict[str, Any]) -> Iterator[Row]:
    time = _time_ns(row)
    for name in LEVEL_NAMES if time is not None else ():
        if row[name] is not None:
            zone = (row["zone"] or "") if name == "velocity_rms_mm_s" else ""
            unit = UNIT_OF_LEVEL.get(name) or row["unit"] or ""
            yield Row(time or 0, "severity", f"{row['channel']}.{name}", value=row[name], unit=unit, text=zone)


def _verdict(row: dict[str, Any]) -> Iterator[Row]:
    time = _time_ns(row)
    if time is None:
        return
    if row["missing_force_percent"] is not None and row["task"] == "compare":
        yield Row(time, "missing_force", "all", value=row["missing_force_percent"], unit="%")
    if row["verdict"] and row["verdict"] not in NOTHING_NAMED and row["stands"]:
        where = f" at {', '.join(row['at'])}" if row["at"] else ""
        yield Row(
            time, "notice", row["verdict"], text=f"{row['verdict']}{where}, p {row['p_archive']:.2g} in the archive"
        )


ROWS_OF_TABLE = {"parameters": _parameter, "severity": _severity, "verdicts": _verdict}
