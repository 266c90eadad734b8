"""Files of others, format by format: names, units, rate, time and date as they say them; or why they cannot be used."""

from __future__ import annotations

import subprocess
import sys
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import scipy.sparse
from asammdf import MDF, Signal
from scipy.io import wavfile

from daq.base.contract.dates import unix_ns
from daq.base.contract.errors import LogError
from daq.exchange import child
from daq.exchange.checks import Record, checked, load
from daq.exchange.formats import by_channel, of_answer
from daq.rig.rig import Rig

RATE_HZ = 1000.0
TEXT = """schema = 1
[band]
low = 10.0
high = 400.0
[acquisition]
rate_hz = 1000.0
FULL
[[channel]]
name = "x"
node = "bearing1"
direction = "x"
unit = "m/s^2"
X
[[channel]]
name = "y"
node = "bearing1"
direction = "y"
unit = "m/s^2"
"""
Y = np.random.default_rng(0).standard_normal((400, 2))
TIME_S = np.arange(400) / RATE_HZ
X_ONLY = {"x": Y[:, 0], "y": Y[:, 1]}
STARTED_UTC = "2024-05-31T11:05:00Z"


def rig(x: str = "", full: str = "") -> Rig:
    return Rig.parse(TEXT.replace("\nX", f"\n{x}").replace("FULL", full))


def read(path: Path, of: Rig | None = None, said: list[str] | None = None) -> Record:
    """As `load`, but in this process, which is quicker."""
    of, note = of or rig(), ([] if said is None else said).append
    reader = child.READER_OF_SUFFIX.get(path.suffix)
    if reader is None:
        return load(path, of, None, note)
    aliases = {c.name: c.alias for c in of.file.channel if c.alias}
    try:
        found = reader(path, ["x", "y", *aliases.values()])
    except child.UnusableError as error:
        raise LogError(f"{path}: {error}") from error
    columns = by_channel(of_answer(path, child.answer(found)), aliases)
    return checked(path, columns, of, None, note)


def refused(path: Path, said: str, of: Rig | None = None) -> None:
    with pytest.raises(LogError, match=said):
        read(path, of)


def assert_read(record: Record, y: np.ndarray = Y, atol: float = 1e-9) -> None:
    assert record.rate_hz == pytest.approx(RATE_HZ, rel=1e-6)
    np.testing.assert_allclose(record.si(), y, atol=atol)


def mat(folder: Path, **values: Any) -> Path:
    scipy.io.savemat(folder / "a.mat", values)
    return folder / "a.mat"


@pytest.mark.parametrize("name", ["rate_hz", "fs", "Fs", "FS", "SampleRate", "sampling_rate", "Sample_Frequency"])
def test_a_rate_by_its_usual_names(tmp_path: Path, name: str) -> None:
    assert_read(read(mat(tmp_path, **X_ONLY, **{name: RATE_HZ})))
    np.savez(tmp_path / "a.npz", **X_ONLY, **{name: RATE_HZ})
    assert_read(read(tmp_path / "a.npz"))


@pytest.mark.parametrize(("name", "value"), [("fs", 1.0), ("Ts", 1.0), ("rate_hz", 1e6)])
def test_a_rate_in_another_unit_is_refused(tmp_path: Path, name: str, value: float) -> None:
    np.savez(tmp_path / "a.npz", **X_ONLY, **{name: value})
    with pytest.raises(LogError, match="where the rig file expects 1000 Hz: is it in [km]Hz"):
        read(tmp_path / "a.npz")


def test_what_holds_no_numbers_is_called_so(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", x=np.array([{}] * 400), y=Y[:, 1], rate_hz=RATE_HZ)
    with pytest.raises(LogError, match="Python objects, not numbers"):
        read(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", x=Y[:, 0].astype(str), y=Y[:, 1], rate_hz=RATE_HZ)
    with pytest.raises(LogError, match="x holds text or objects"):
        read(tmp_path / "b.npz")
    np.savez(tmp_path / "c.npz", **X_ONLY, t=np.arange(400).astype("timedelta64[ms]"))
    assert_read(read(tmp_path / "c.npz"))
    scipy.io.savemat(tmp_path / "a.mat", {"x": scipy.sparse.csc_matrix(Y[:, :1]), "y": Y[:, 1], "fs": RATE_HZ})
    assert_read(read(tmp_path / "a.mat"))


@pytest.mark.promise("a file of another kind than its ending", "spreadsheet, gzip, MDF, log", "called by its kind")
@pytest.mark.parametrize(
    ("name", "head", "said"),
    [
        ("a.csv", b"PK\x03\x04", "a ZIP archive or a spreadsheet: unpack it, or save the sheet"),
        ("a.txt", b"\x1f\x8b\x08", "compressed with gzip: unpack it first"),
        ("a.mat", b"MDF     4.10", r"an MDF file by its first bytes: name it \.mf4"),
        ("a.csv", b"\x89MCAP0\r\n", r"a log by its first bytes: name it \.mcap"),
        ("a.npz", b"x,y\n1,2\n", "no archive of numpy; write it with"),
    ],
)  # fmt: skip
def test_a_file_of_another_kind_than_its_ending_is_called_so(tmp_path: Path, name: str, head: bytes, said: str) -> None:
    (tmp_path / name).write_bytes(head + bytes(range(256)))
    with pytest.raises(LogError, match=said):
        load(tmp_path / name, rig(), None, print)


def test_sound_without_samples_is_called_so(tmp_path: Path) -> None:
    wavfile.write(tmp_path / "a.wav", 1000, np.empty((0, 2), np.int16))
    refused(tmp_path / "a.wav", "holds no samples")


def test_a_struct_by_the_names_of_its_fields(tmp_path: Path) -> None:
    assert_read(read(mat(tmp_path, data={"x": Y[:, 0], "y": Y[:, 1], "Fs": RATE_HZ}), rig()))
    assert_read(read(mat(tmp_path, d={"a": {"x": Y[:, 0], "y": Y[:, 1]}, "dt": 1 / RATE_HZ})))
    two = mat(tmp_path, a=X_ONLY, b={"x": 2 * Y[:, 0]}, fs=RATE_HZ)
    refused(two, r'x is there 2 times, as a.x, b.x; say which one by alias = "a.x"')
    assert_read(read(two, rig('alias = "b.x"')), Y * [2, 1])
    assert_read(read(mat(tmp_path, m=Y[:, ::-1], y=Y[:, 1], fs=RATE_HZ), rig('alias = "m(:,2)"')))


def test_channels_as_structs_with_data_in_them(tmp_path: Path) -> None:
    one = {n: {"data": Y[:, k], "fs": RATE_HZ} for k, n in enumerate("xy")}
    assert_read(read(mat(tmp_path, run=one)))
    several = np.array([(n, Y[:, k]) for k, n in enumerate("xy")], dtype=[("Name", "O"), ("Data", "O")])
    assert_read(read(mat(tmp_path, channels=several, Fs=RATE_HZ)))


@pytest.mark.promise("a time vector beside a rate", "a hole, a contradiction", "refused")
def test_a_time_vector_beside_a_rate_has_to_agree_with_it(tmp_path: Path) -> None:
    assert_read(read(mat(tmp_path, **X_ONLY, fs=RATE_HZ, time=TIME_S)))
    assert_read(read(mat(tmp_path, **X_ONLY, fs=RATE_HZ, t_ms=1e3 * TIME_S)))
    refused(mat(tmp_path, **X_ONLY, fs=2000.0, time=TIME_S), "says a rate of 2000 Hz, but its time gives 1000 Hz")
    hole = np.where(TIME_S > 0.2, TIME_S + 0.05, TIME_S)
    refused(mat(tmp_path, **X_ONLY, fs=RATE_HZ, time=hole), "about 50 samples are missing before row 201")
    refused(mat(tmp_path, **X_ONLY, fs=RATE_HZ, Fs=500.0), "fs says 1000 Hz, Fs 500 Hz; remove the one")
    refused(mat(tmp_path, **X_ONLY, time=1e3 * TIME_S), r'in ms the .*1000 Hz.*"time \[ms\]"')
    np.savez(tmp_path / "a.npz", **X_ONLY, rate_hz=RATE_HZ, time=hole)
    refused(tmp_path / "a.npz", "50 samples are missing")


def mf4(folder: Path, signals: list[list[Signal]], start: datetime | None = None) -> Path:
    with MDF(version="4.10") as file:
        for group in signals:
            file.append(group)
        file.header.start_time = start or datetime(1970, 1, 1, tzinfo=UTC)
        file.save(folder / "a.mf4", overwrite=True)
    return folder / "a.mf4"


def both(scale: float = 1.0, unit: str = "m/s^2") -> list[Signal]:
    return [Signal(scale * Y[:, k], TIME_S + 1.5, name=n, unit=unit) for k, n in enumerate("xy")]


def test_mf4_in_two_groups_is_asked_for_and_read_by_its_alias(tmp_path: Path) -> None:
    path = mf4(tmp_path, [both(), both(2.0)])
    refused(path, r'x is in 2 groups of the file, 0.*, 1.*, with other data in each; .* alias = "0/x"')
    assert_read(read(mf4(tmp_path, [both(), both()])))  # twice the same
    lone = mf4(tmp_path, [both(), [both(2.0)[0]]])
    assert_read(read(lone, rig('alias = "1/x"')), Y * [2, 1])


def test_mf4_units_and_date(tmp_path: Path) -> None:
    said: list[str] = []
    record = read(mf4(tmp_path, [both(1e3, "mm/s²")], datetime(2024, 5, 31, 11, 4, 58, 500_000, UTC)), said=said)
    assert_read(record)
    assert said[0] == 'x is in "mm/s²" there, and in "m/s^2" in the rig file: converted'
    assert record.started_ns == unix_ns(STARTED_UTC)
    assert read(mf4(tmp_path, [both()])).started_ns is None


@pytest.mark.promise("an MF4 over an angle", "master of another kind than time", "refused")
def test_mf4_over_an_angle_is_refused(tmp_path: Path) -> None:
    angle = [Signal(Y[:, 0], TIME_S, name="x", master_metadata=("Angle", 2)), Signal(Y[:, 1], TIME_S, name="y")]
    refused(mf4(tmp_path, [angle]), r'x was recorded over an angle \(master channel "Angle"\), not over time')


def test_mf4_masters_say_their_unit(tmp_path: Path) -> None:
    for unit, factor in (("ms", 1e3), ("s", 1.0), ("", 1.0)):
        signals = [Signal(Y[:, k], factor * TIME_S, name=n) for k, n in enumerate("xy")]
        path = mf4(tmp_path, [signals])
        with MDF(path) as file:
            file.groups[0].channels[0].unit = unit
            found = child.of_mf4(file, ["x", "y"])
        record = checked(path, of_answer(path, child.answer(found)), rig(), None, print)
        assert record.rate_hz == pytest.approx(RATE_HZ)
    with MDF(path) as file:
        file.groups[0].channels[0].unit = "deg"
        with pytest.raises(child.UnusableError, match='x was recorded over "time" in deg, which is no unit of time'):
            child.of_mf4(file, ["x", "y"])


UFF_HEAD = """    -1
    58
{name}
NONE
31-May-24 11:05:00
NONE
NONE
    1         1    0         0 {name}                  1   1 NONE               0   0
         2{n:10d}         1  0.00000e+00  1.00000e-03  0.00000e+00
        17    0    0    0 Time                 s
        12    0    0    0 Acc                  {unit}
         0    0    0    0 NONE                 NONE
         0    0    0    0 NONE                 NONE
"""


def uff(folder: Path, n: int, length: float | None, unit: str = "NONE", fill: str = " 0.00000e+00") -> Path:
    parts = []
    if length is not None:
        factors = f"  {length:.17E}  1.00000000000000000E+00  1.00000000000000000E+00".replace("E", "D")
        parts.append(f"    -1\n   164\n         9own                           2\n{factors}\n  0.0D+00\n    -1\n")
    for k, name in enumerate("xy"):
        cells = [f"{v:13.5e}" for v in Y[:n, k]] + [fill.rjust(13)] * (-n % 6)
        lines = ["".join(cells[i : i + 6]) for i in range(0, len(cells), 6)]
        parts.append(UFF_HEAD.format(name=name, n=n, unit=unit) + "\n".join(lines) + "\n    -1\n")
    (folder / "a.uff").write_text("".join(parts))
    return folder / "a.uff"


@pytest.mark.promise("units of dataset 164", "mm and N", "converted")
def test_uff_filled_lines_units_and_date(tmp_path: Path) -> None:
    record = read(uff(tmp_path, 397, None))
    assert_read(record, Y[:397], atol=1e-4)
    assert record.started_ns is not None
    refused(uff(tmp_path, 397, None, fill=" 1.00000e+00"), "402 values, its header says 397")
    assert_read(read(uff(tmp_path, 396, 1e3)), Y[:396] * 1e-3, atol=1e-6)
    assert_read(read(uff(tmp_path, 396, 1 / 0.0254)), Y[:396] * 0.0254, atol=1e-5)
    assert_read(read(uff(tmp_path, 396, 1e3, "g")), Y[:396] * 9.80665, atol=1e-3)  # its own word counts
    refused(uff(tmp_path, 396, 17.0), "dataset 164 has units of its own")


def test_sound_of_floats(tmp_path: Path) -> None:
    wavfile.write(tmp_path / "a.wav", 1000, (Y / 10).astype(np.float32))
    said: list[str] = []
    assert_read(read(tmp_path / "a.wav", rig(full="full_scale = 50.0"), said), 5 * Y, atol=1e-4)
    assert "floats within +-1: 1 is taken as full scale, 50 m/s^2" in said[0]
    assert_read(read(tmp_path / "a.wav", said=said), Y / 10, atol=1e-6)
    assert "if 1 is full scale, say acquisition.full_scale" in said[-1]
    wavfile.write(tmp_path / "a.wav", 1000, Y.astype(np.float32))
    assert_read(read(tmp_path / "a.wav", rig(full="full_scale = 50.0"), said), atol=1e-6)
    assert "taken as values in the rig's units, not as parts of full scale" in said[-1]


def test_the_date_of_a_broadcast_wave_file(tmp_path: Path) -> None:
    wavfile.write(tmp_path / "a.wav", 1000, Y.astype(np.float32))
    whole = (tmp_path / "a.wav").read_bytes()
    head = bytes(320) + b"2024-05-31" + b"11:05:00" + bytes(264)
    (tmp_path / "a.wav").write_bytes(whole[:12] + b"bext" + len(head).to_bytes(4, "little") + head + whole[12:])
    start = datetime(2024, 5, 31, 11, 5).astimezone()  # without a zone: of this computer's
    assert read(tmp_path / "a.wav").started_ns == round(start.timestamp()) * 10**9


def test_hdf5_and_matlab_7_3(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file.create_group("run")
        for k, name in enumerate("xy"):
            group.create_dataset(name, data=Y[:, k]).attrs["unit"] = "g"
        group.attrs["sample_rate"] = RATE_HZ
        file.attrs["started"] = STARTED_UTC
    record = read(tmp_path / "a.h5")
    assert_read(record, Y * 9.80665)
    assert record.started_ns == unix_ns(STARTED_UTC)
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        for name, values in (("data/x", Y[:, :1].T), ("data/y", Y[:, 1:].T), ("data/Fs", [[RATE_HZ]])):
            file.create_dataset(name, data=values)
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    (tmp_path / "a.mat").write_bytes(head + (tmp_path / "a.mat").read_bytes()[len(head) :])
    assert_read(read(tmp_path / "a.mat"))


def test_tdms(tmp_path: Path) -> None:
    nptdms = pytest.importorskip("nptdms")
    about = {"wf_increment": 1 / RATE_HZ, "unit_string": "g", "wf_start_time": np.datetime64("2024-05-31T11:05:00")}
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as file:
        file.write_segment([nptdms.ChannelObject("run", n, Y[:, k], about) for k, n in enumerate("xy")])
    record = read(tmp_path / "a.tdms")
    assert_read(record, Y * 9.80665)
    assert record.started_ns == unix_ns(STARTED_UTC)


def test_parquet(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    stamps = np.datetime64("2024-05-31T11:05:00", "us") + np.arange(400) * np.timedelta64(1000, "us")
    parquet.write_table(pyarrow.table({"timestamp": stamps, "x": Y[:, 0], "y": Y[:, 1]}), tmp_path / "a.parquet")
    record = read(tmp_path / "a.parquet")
    assert_read(record)
    assert record.started_ns == unix_ns(STARTED_UTC)
    exact = [Decimal(f"{value:.6f}") for value in Y[:, 1]]
    lasting = pyarrow.array(np.arange(400), pyarrow.duration("ms"))
    parquet.write_table(pyarrow.table({"time": lasting, "x": Y[:, 0], "y": exact}), tmp_path / "a.parquet")
    assert_read(read(tmp_path / "a.parquet"), np.round(Y, 6), 1e-6)


@pytest.mark.parametrize("ending", ["h5", "tdms", "parquet"])
def test_a_command_has_the_memory_to_read_it(tmp_path: Path, ending: str) -> None:
    """The libraries claim addresses for pools and threads, of which a command that reads a small file grants few."""
    path = tmp_path / f"a.{ending}"
    if ending == "h5":
        with pytest.importorskip("h5py").File(path, "w") as file:
            file["x"], file["y"] = Y.T
    elif ending == "tdms":
        tdms = pytest.importorskip("nptdms")
        with tdms.TdmsWriter(path) as file:
            file.write_segment([tdms.ChannelObject("run", n, Y[:, k]) for k, n in enumerate("xy")])
    else:
        parquet, table = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow").table
        parquet.write_table(table({"x": Y[:, 0], "y": Y[:, 1]}), path)
    (tmp_path / "rig.toml").write_text(TEXT.replace("\nX", "").replace("FULL", ""))
    command = f"-m daq import a.{ending} --rig rig.toml --rate 1000 --out a.mcap"
    done = subprocess.run([sys.executable, *command.split()], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "0.4 s of 2 channels at 1000 Hz" in done.stdout, done.stderr


@pytest.mark.parametrize("ending", ["h5", "tdms", "parquet"])
def test_a_reader_that_is_not_installed_is_named(tmp_path: Path, ending: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("h5py", "nptdms", "pyarrow"):
        (tmp_path / f"{name}.py").write_text("raise ImportError")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{Path(__file__).parents[3]}")
    (tmp_path / f"a.{ending}").write_bytes(b"anything")
    with pytest.raises(LogError, match=r"needs \w+: pip install 'rotorscope\[formats\]'; or export it to .csv"):
        load(tmp_path / f"a.{ending}", rig(), None, print)
