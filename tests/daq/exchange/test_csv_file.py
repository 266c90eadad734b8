"""Tables as recorders and spreadsheets write them: the right numbers, or the reason and what to do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from daq.base.contract.dates import unix_ns
from daq.base.contract.errors import LogError
from daq.exchange.checks import Record, load
from daq.exchange.columns import date_ns
from daq.rig.rig import Rig

XY_TOML = """[[channel]]
name = "{0}"
node = "bearing1"
direction = "{0}"
unit = "m/s^2"
"""
HEAD_TOML = "schema = 1\n[band]\nlow = 1.0\nhigh = 40.0\n"
XY_RIG = Rig.parse(HEAD_TOML + XY_TOML.format("x") + XY_TOML.format("y"))
AT_100_HZ = Rig.parse(HEAD_TOML + "[acquisition]\nrate_hz = 100.0\n" + XY_TOML.format("x") + XY_TOML.format("y"))
K = np.arange(60)
X, Y = 1000 + K / 8, -K / 4


def table(form: str, separator: str = ",", head: str = "time,x,y", time: float = 1.0) -> str:
    rows = [separator.join((form % (k / 100 * time), form % x, form % y)) for k, x, y in zip(K, X, Y, strict=True)]
    return "\n".join([head.replace(",", separator), *rows]) + "\n"


def read(
    folder: Path, text: str | bytes, rig: Rig = AT_100_HZ, rate_hz: float | None = None, name: str = "a.csv"
) -> Record:
    (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    said: list[str] = []
    return load(folder / name, rig, rate_hz, said.append)


def german(text: str) -> str:
    return text.replace(".", ",")


def rows(time: Callable[[int], str], head: str = "time;x;y") -> str:
    return "\n".join([head, *(f"{time(k)};{x};{y}" for k, x, y in zip(K.tolist(), X, Y, strict=True))])


def time_of_day(k: int) -> str:
    """A hundred rows a second, from a tenth of a second before midnight on."""
    seconds = (86400 - 0.1 + k / 100) % 86400
    return f"{int(seconds / 3600):02d}:{int(seconds / 60 % 60):02d}:{seconds % 60:05.2f}".replace("60.00", "00.00")


STAMPED_ROWS = rows(lambda k: f"2024-05-31T13:05:{k / 100:09.6f}+02:00", "Time;x;y")
READABLE_FILES = {
    "plain": table("%.6f"),
    "german": german(table("%.6f", ";", "time;x;y".replace(";", ","))),
    "german, three decimals": german(table("%.3f", ";")),
    "tabs": table("%.6f", "\t"),
    "utf-16": table("%.6f").encode("utf-16"),
    "utf-16 without a mark": table("%.6f").encode("utf-16-be"),
    "mark": table("%.6f").encode("utf-8-sig"),
    "excel": german(table("%.4f", ";", "Zeit [s],x [m/s²],y [m/s²]")).encode("cp1252"),
    "sep=": "sep=;\n" + table("%.6f", ";"),
    "preamble": "Recorder;7\nSampling rate;100 Hz\n\n" + table("%.6f", ";"),
    "units": table("%.6f", ",", "time,x,y\ns,m/s^2,(m/s^2)"),
    "ms": table("%.6f", ",", "Time [ms],x,y", 1e3),
    "us": table("%.3f", ",", "time_us,x,y", 1e6),
    "units behind a slash": table("%.6f", ",", "t/ms,x/(m/s^2),y/(m/s²)", 1e3),
    "empty rows of a spreadsheet": table("%.6f", ",", "time,x,y\n,,") + ",,\n,,\n",
    "us in a row": table("%.3f", ",", "Time,x,y\nµs,m/s²,m/s²", 1e6),
    "minutes": table("%.9f", ",", "t/min,x,y", 1 / 60),
    "ends with separators": "\n".join(line + ";" for line in table("%.6f", ";").splitlines()),
    "remarks": "# by me\n" + table("%.6f") + "# started 2024-05-31T11:05:00.000000Z\n",
    "blanks": table("%.6f", " "),
    "columns": table("%.6f", "   "),
    "remarks with names": "# sensors,x,y\nThe sensors x and y of bearing 1\n" + table("%.6f"),
    "savetxt": "# " + table("%.6f"),
    "elapsed": table("%.6f", ",", "Elapsed Time (ms),x,y", 1e3),
    "quoted": "\n".join(
        ["time,x,y", *(f'"{k / 100}","{x:,.3f}","{y}"' for k, x, y in zip(K, X, Y, strict=True))]
    ),  # "1,000.125"
    "german thousands": "\n".join(
        [
            "time;x;y",
            *(
                german(f"{k / 100};1.{x - 1000:07.3f};{y}").replace(";1,", ";1.", 1)
                for k, x, y in zip(K, X, Y, strict=True)
            ),
        ]
    ),  # fmt: skip
    "stamps": STAMPED_ROWS,
    "stamps under Datum": rows(lambda k: "31.05.2024 13:05:" + german(f"{k / 100:06.3f}"), "Datum;x;y"),
    "times of day past midnight": rows(time_of_day),
}


@pytest.mark.promise("tables of others", "units of time, decimal commas, unit rows, encodings", "read as meant")
@pytest.mark.parametrize("kind", READABLE_FILES)
def test_a_table_is_read_as_it_is_meant(tmp_path: Path, kind: str) -> None:
    record = read(tmp_path, READABLE_FILES[kind])
    assert record.rate_hz == pytest.approx(100.0, rel=1e-6)
    np.testing.assert_allclose(record.si(), np.column_stack([X, Y]), atol=6e-3 if "decimals" in kind else 1e-9)


def test_dates_of_stamps_heads_and_our_own_exports(tmp_path: Path) -> None:
    started = unix_ns("2024-05-31T11:05:00Z")
    assert read(tmp_path, READABLE_FILES["stamps"]).started_ns == started
    assert read(tmp_path, READABLE_FILES["remarks"]).started_ns == started
    assert read(tmp_path, "Start time: 2024-05-31 11:05:00Z\n" + table("%.6f")).started_ns == started
    epoch = rows(lambda k: f"{1717153500000 + 10 * k}", "timestamp;x;y")
    record = read(tmp_path, epoch, XY_RIG)
    assert record.rate_hz == 100.0
    assert record.started_ns == started
    assert read(tmp_path, table("%.6f")).started_ns is None
    start_ns = date_ns("2024-05-31 13:05:00")  # of this computer's zone
    days = rows(lambda k: f"31.05.2024;13:05:{k / 100:05.2f}", "Date;Time;x;y")
    assert read(tmp_path, days).started_ns == start_ns
    head = "LabVIEW Measurement\t\nDate\t2024/05/31\nTime\t13:05:00\n***End_of_Header***\t\n"
    assert read(tmp_path, head + table("%.6f", "\t", "X_Value,x,y")).started_ns == start_ns


@pytest.mark.promise("doubtful tables", "`1,234`, decimal commas between commas and others", "refused with the line")
@pytest.mark.parametrize(
    ("text", "rig", "said"),
    [
        (table("%.6f", ",", "time [ticks],x,y"), XY_RIG, 'the time is in "ticks", which is no unit of time; write one'),
        (table("%.6f", ",", "time,x,y", 1e3), AT_100_HZ, r'in s it gives 0.1 Hz, in ms the .*100 Hz.*"time \[ms\]"'),
        (table("%.6f", ",", "time,x,y", 1 / 60), AT_100_HZ, r"in s it gives 6000\S* Hz, in min"),
        (
            table("%.6f", ",", "time,x,y", 1e6), XY_RIG,
            "lower band.high, or check the rate, or whether its time is in s",
        ),
        (german(table("%.6f")), XY_RIG, ":2: 6 cells where the header has 3: these may be decimal commas"),
        ("time;x;y\n" + 60 * "1,000;2,000;3,000\n", XY_RIG, '"1,000" may be 1.000 or 1000; write its numbers with'),
        (table("%.6f").replace("\n0.100000,", "\nnow,"), XY_RIG, ":12: time: \"now\" is not a number"),
        (rows(lambda k: f"{k // 4}.0"), AT_100_HZ, "time stands still at row 1 .0 s., as its numbers are rounded"),
        (table("%.6f", ",", "Frequency [Hz],x,y"), XY_RIG, "a table over frequency: a spectrum"),
        (table("%.6f").replace("time", "x"), XY_RIG, 'the header names "x" twice'),
    ],
)  # fmt: skip
def test_what_is_doubtful_is_refused_with_its_reason(tmp_path: Path, text: str, rig: Rig, said: str) -> None:
    with pytest.raises(LogError, match=said):
        read(tmp_path, text, rig)


def test_a_hole_in_time_becomes_a_gap_if_that_is_allowed(tmp_path: Path) -> None:
    lines = table("%.6f").splitlines()
    (tmp_path / "a.csv").write_text("\n".join(lines[:21] + lines[26:]) + "\n")
    with pytest.raises(LogError, match="about 5 samples are missing before row 20"):
        load(tmp_path / "a.csv", XY_RIG, None, print)
    record = load(tmp_path / "a.csv", XY_RIG, None, print, gaps=True)
    assert record.missing is not None
    np.testing.assert_array_equal(np.flatnonzero(record.missing), np.arange(20, 25))
    np.testing.assert_allclose(record.si()[25:], np.column_stack([X, Y])[25:])


@pytest.mark.promise("a table with empty rows", "as pandas writes NaN in every channel", "gaps, if they are allowed")
def test_rows_that_are_empty_in_every_channel_become_gaps(tmp_path: Path) -> None:
    lines = table("%.6f").splitlines()
    lines[21:23] = [line.partition(",")[0] + ",," for line in lines[21:23]]
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(LogError, match=r"x is not a number at row 20 .*2 rows in all.* --gaps"):
        load(tmp_path / "a.csv", XY_RIG, None, print)
    record = load(tmp_path / "a.csv", XY_RIG, None, print, gaps=True)
    assert record.missing is not None
    np.testing.assert_array_equal(np.flatnonzero(record.missing), [20, 21])


def test_a_table_of_one_row_is_too_short(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="1 samples; there is nothing to import"):
        read(tmp_path, "time,x,y\n0,1,2\n")


def test_a_spreadsheet_is_refused_with_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"save the sheet as \.csv"):
        read(tmp_path, "PK", name="a.xlsx")
