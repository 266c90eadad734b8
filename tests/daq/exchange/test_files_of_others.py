"""Files as the instruments and programs of others write them: the right values at the right times, or the reason."""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.base.contract.errors import ConfigError, LogError
from daq.exchange.checks import Record, load
from daq.rig.rig import Rig

RATE_HZ, N = 100.0, 300
K = np.arange(N)
X = np.round(200 * np.sin(0.46 * K) + 20 * np.cos(1.4 * K)).astype(np.int16)
Y = np.round(150 * np.sin(0.32 * K) + 30 * np.cos(1.2 * K)).astype(np.int16)
START_NS = 1_700_000_000 * 10**9  # 2023-11-14 22:13:20 UTC
RIG_TEXT = """schema = 1
[band]
low = 1.0
high = 40.0
[acquisition]
rate_hz = 100.0
full_scale = 500.0
[[channel]]
name = "b1x"
node = "bearing1"
direction = "x"
unit = "m/s^2"
[[channel]]
name = "b2x"
node = "bearing2"
direction = "x"
unit = "m/s^2"
"""


@pytest.fixture(autouse=True)
def in_utc(monkeypatch: pytest.MonkeyPatch) -> None:
    import time

    monkeypatch.setenv("TZ", "UTC")
    time.tzset()


def read(path: Path, notes: list[str] | None = None, rig: str = RIG_TEXT) -> Record:
    return load(path, Rig.parse(rig), None, ([] if notes is None else notes).append)


def check(record: Record, x: Any = X, y: Any = Y, started_ns: int | None = None, rate: float = RATE_HZ) -> None:
    assert record.rate_hz == pytest.approx(rate, rel=1e-6)
    np.testing.assert_allclose(record.si(), np.column_stack([x, y]).astype(float), atol=1e-4)
    assert record.started_ns == started_ns


def table(path: Path, head: str, time: Callable[[int], str], separator: str = ",", minus: str = "-") -> Path:
    rows = [separator.join([time(k), f"{X[k]:.2f}", f"{Y[k]:.2f}"]) for k in range(N)]
    path.write_text(head + "\n" + "\n".join(rows).replace("-", minus) + "\n", encoding="utf-8")
    return path


def serial(k: int, of: float) -> str:
    return f"{of + k / RATE_HZ / 86400:.12f}"


TABLES_OF_OTHERS: dict[str, tuple[str, Callable[[int], str], int | None]] = {
    "days of a spreadsheet": ("time,b1x,b2x", lambda k: serial(k, 25569 + START_NS / 86400e9), START_NS),
    "an American date": ("time,b1x,b2x", lambda k: f"11/14/2023 10:13:{20 + k / RATE_HZ:06.3f} PM", START_NS),
    "hours with a comma": ('"Time, h",b1x,b2x', lambda k: f"{k / RATE_HZ / 3600:.11f}", None),
}


@pytest.mark.promise("days as times", "Excel, American dates", "read, with the date")
@pytest.mark.parametrize("kind", TABLES_OF_OTHERS)
def test_times_of_spreadsheets(tmp_path: Path, kind: str) -> None:
    head, time, started_ns = TABLES_OF_OTHERS[kind]
    check(read(table(tmp_path / "a.csv", head, time)), started_ns=started_ns)
    other = RIG_TEXT.replace("[acquisition]\nrate_hz = 100.0\nfull_scale = 500.0\n", "")
    check(read(tmp_path / "a.csv", rig=other), started_ns=started_ns)


def test_the_minus_of_typesetting(tmp_path: Path) -> None:
    check(read(table(tmp_path / "a.csv", "time,b1x,b2x", lambda k: f"{k / RATE_HZ:.2f}", minus="\u2212")))


@pytest.mark.parametrize(
    "head",
    ["Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3", "Chn Identifier Flg DLC D0...1...2 Time Dir", "Time,ID,DLC,Data0"],
)
def test_a_table_of_can_frames_is_called_one(tmp_path: Path, head: str) -> None:
    (tmp_path / "a.csv").write_text(head + "\n" + ",".join("1" * len(head.split(","))) + "\n")
    with pytest.raises(LogError, match="a table of CAN frames; export it as"):
        read(tmp_path / "a.csv")


def test_a_pcan_trace_says_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "a.trc").write_text(";$FILEVERSION=2.1\n")
    with pytest.raises(LogError, match=r"a PCAN trace: convert it to \.asc"):
        read(tmp_path / "a.trc")


def lvm(
    columns: str, units: str = "m/s^2\tm/s^2", step: str = "0.01\t0.01", segments: int = 1, comma: bool = False
) -> str:
    out = f"LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t{',' if comma else '.'}\nX_Columns\t{columns}\n"
    out += "Date\t2020/01/01\n***End_of_Header***\t\n\t\n"
    for _ in range(segments):
        out += "Channels\t2\t\nSamples\t300\t300\t\nDate\t2023/11/14\t2023/11/14\t\nTime\t22:13:20\t22:13:20\t\n"
        out += f"Y_Unit_Label\t{units}\t\nX0\t0.0E+0\t0.0E+0\t\nDelta_X\t{step}\t\n***End_of_Header***\t\t\t\n"
        titles = {"Multi": "X_Value\tb1x\tX_Value\tb2x"}.get(columns, "X_Value\tb1x\tb2x")
        out += f"{titles}\tComment\n"
        for k in range(N):
            t = "" if columns == "No" else f"{k / RATE_HZ:.6f}"
            cells = [t, f"{X[k]:.3f}", *([t] if columns == "Multi" else []), f"{Y[k]:.3f}"]
            out += "\t".join(c.replace(".", ",") if comma else c for c in cells) + "\n"
        out += "\n"
    return out


@pytest.mark.parametrize("ending", ["lvm", "txt"])
@pytest.mark.parametrize("columns", ["No", "One", "Multi"])
def test_labview(tmp_path: Path, columns: str, ending: str) -> None:
    path = tmp_path / f"a.{ending}"
    path.write_text(lvm(columns, "g\tmm/s^2", comma=columns == "One"))
    check(read(path), X * 9.80665, Y * 1e-3, START_NS)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (lvm("No").replace("Time\t22:13:20\t22:13:20", "Time\t22:13:20\t22:13:21"), "begin at different times"),
        (lvm("One", segments=2), "holds 2 segments"), (lvm("No", step="0.01\t0.02"), "different Delta_X"),
        (lvm("One", step="0.02\t0.02"), "says a rate of 50 Hz, but its time gives 100 Hz"),
        (lvm("No").replace("b1x", "b9x"), 'no channel "b1x"'),
        (lvm("No").replace(f"\n\t{X[3]:.3f}", "\n\tNaNny", 1), r"\d+: b1x: .NaNny. is not a number"),
        ("time,b1x\n0,1\n", "no LabVIEW measurement file"), ("LabVIEW Measurement\n", "no segment"),
    ],
)  # fmt: skip
def test_labview_that_is_doubtful_is_refused(tmp_path: Path, text: str, why: str) -> None:
    (tmp_path / "a.lvm").write_text(text)
    with pytest.raises(LogError, match=why):
        read(tmp_path / "a.lvm")


def wav(data: bytes, kind: int, bits: int, extensible: bool) -> bytes:
    width = 2 * bits // 8
    head = struct.pack("<HHIIHH", 0xFFFE if extensible else kind, 2, 100, 100 * width, width, bits)
    if extensible:
        head += struct.pack("<HHIH", 22, bits, 3, kind) + bytes.fromhex("000000001000800000AA00389B71")
    body = b"WAVEfmt " + struct.pack("<I", len(head)) + head + b"data" + struct.pack("<I", len(data)) + data
    return b"RIFF" + struct.pack("<I", len(body)) + body


@pytest.mark.parametrize("extensible", [False, True])
def test_sound_of_24_bits_and_of_floats(tmp_path: Path, extensible: bool) -> None:
    share, notes = np.column_stack([X, Y]) / 500.0, list[str]()
    counts = np.rint(share * 2**23).astype(int).ravel().tolist()
    data = b"".join(c.to_bytes(3, "little", signed=True) for c in counts)
    (tmp_path / "a.wav").write_bytes(wav(data, 1, 24, extensible))
    check(read(tmp_path / "a.wav"))
    (tmp_path / "b.wav").write_bytes(wav(share.astype("<f4").tobytes(), 3, 32, extensible))
    check(read(tmp_path / "b.wav", notes))
    assert notes == ["its samples are floats within +-1: 1 is taken as full scale, 500 m/s^2"]


def uff(
    path: Path, binary: int = 0, unit: str = "s", steps: tuple[float, float] = (0.01, 0.01),
    starts: tuple[float, float] = (0.0, 0.0), **more: Any,
) -> Path:  # fmt: skip
    import pyuff

    for name, values, step, start in (("b1x", X, steps[0], starts[0]), ("b2x", Y, steps[1], starts[1])):
        about: dict[str, Any] = {"x": start + K * step, "abscissa_spacing": 1, "abscissa_inc": step} | more
        pyuff.UFF(str(path)).write_sets(
            pyuff.prepare_58(
                binary=binary, func_type=1, ver_num=1, load_case_id=0, rsp_ent_name=name, rsp_node=1, rsp_dir=1,
                ref_ent_name="NONE", ref_node=0, ref_dir=0, data=values.astype(float), id1=name, id2="", id3="",
                id4="", id5="", ord_data_type=4, abscissa_min=start, num_pts=N, abscissa_axis_units_lab=unit,
                **({"abscissa_spec_data_type": 17, "orddenom_spec_data_type": 0, "z_axis_spec_data_type": 0} | about),
            ),
            "add",
        )  # fmt: skip
    return path


@pytest.mark.promise(
    "universal files", "ms, uneven times, two rates, another abscissa", "read, or refused with the reason"
)
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pyuff leaves its files open
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("binary", [0, 1])
def test_universal_files_with_times_of_their_own(tmp_path: Path, binary: int) -> None:
    check(read(uff(tmp_path / "a.uff", binary, "ms", (10.0, 10.0))))
    check(read(uff(tmp_path / "b.uff", binary, x=K / RATE_HZ, abscissa_spacing=0, steps=(0.5, 0.5), abscissa_inc=0.5)))
    hole = K / RATE_HZ + np.where(K > 200, 0.5, 0.0)
    for refused, why in (
        (uff(tmp_path / "c.uff", binary, x=hole, abscissa_spacing=0), "about 50 samples are missing before row 201"),
        (uff(tmp_path / "d.uff", binary, steps=(0.01, 0.02)), "b1x is sampled at 100 Hz, b2x at 50 Hz"),
        (uff(tmp_path / "g.uff", binary, starts=(0.0, 0.5)), "records begin 0.5 s apart"),
        (uff(tmp_path / "e.uff", binary, "fortnights"), "no unit of time"),
        (uff(tmp_path / "f.uff", binary, abscissa_spec_data_type=18), "over something that is no time"),
    ):
        with pytest.raises(LogError, match=why):
            read(refused)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("binary", [0, 1])
def test_a_universal_file_that_ends_inside_a_dataset_is_cut(tmp_path: Path, binary: int) -> None:
    whole = uff(tmp_path / "a.uff", binary)
    whole.write_bytes(whole.read_bytes()[:-1500])
    with pytest.raises(LogError, match="its last dataset 58 has no end; the file is cut"):
        read(whole)


def test_a_universal_file_without_its_library_says_what_to_type(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.uff"
    path.write_text("    -1\n")
    monkeypatch.setitem(sys.modules, "pyuff", None)
    with pytest.raises(ConfigError) as refused:
        read(path)
    assert str(refused.value) == f"{path}: needs pyuff, which is not installed: pip install 'rotorscope[formats]'"


@pytest.mark.promise(
    "units and rates beside samples", "arrays of structs, datenum", "converted; different rates refused"
)
def test_channels_of_matlab_say_their_units_and_rates(tmp_path: Path) -> None:
    import scipy.io

    kind = [(name, object) for name in ("name", "data", "unit", "fs")]
    for rates, why in (((100.0, 100.0), ""), ((100.0, 50.0), "ch.b1x.fs says 100 Hz, ch.b2x.fs 50 Hz")):
        of = np.array([("b1x", X * 1.0, "g", rates[0]), ("b2x", Y * 1.0, "mg", rates[1])], dtype=kind)
        scipy.io.savemat(tmp_path / "a.mat", {"ch": of})
        if why:
            with pytest.raises(LogError, match=why):
                read(tmp_path / "a.mat")
        else:
            check(read(tmp_path / "a.mat"), X * 9.80665, Y * 9.80665e-3)
    scipy.io.savemat(tmp_path / "b.mat", {"b1x": {"data": X, "unit": "g"}, "b2x": {"data": Y, "unit": "mg"}, "fs": 100})
    check(read(tmp_path / "b.mat"), X * 9.80665, Y * 9.80665e-3)
    scipy.io.savemat(tmp_path / "c.mat", {"b1x": X, "b2x": Y, "t": 719529 + START_NS / 86400e9 + K / RATE_HZ / 86400})
    record = read(tmp_path / "c.mat")
    assert record.started_ns == pytest.approx(START_NS, abs=1e6)
    check(record, started_ns=record.started_ns, rate=record.rate_hz)
    assert record.rate_hz == pytest.approx(RATE_HZ, rel=1e-4)
    scipy.io.savemat(tmp_path / "d.mat", {"d": np.vstack([X, Y]), "fs": 100.0})
    rig = RIG_TEXT.replace('name = "b1x"', 'name = "b1x"\nalias = "d(1,:)"')
    check(read(tmp_path / "d.mat", rig=rig.replace('name = "b2x"', 'name = "b2x"\nalias = "d(2,:)"')))


@pytest.mark.promise(
    "one unit beside several channels",
    "in a struct, a .mat, an .npz, a group of HDF5",
    "converted; another text is none",
)
@pytest.mark.parametrize(("unit", "factor"), [("mm/s^2", 1e-3), ("g", 9.80665), ("SI", 1.0)])
def test_one_unit_beside_several_channels(tmp_path: Path, unit: str, factor: float) -> None:
    """A file's one unit was passed over, and values were a thousand times too large."""
    import scipy.io

    both: dict[str, Any] = {"b1x": X, "b2x": Y, "fs": 100.0}
    scipy.io.savemat(tmp_path / "a.mat", {"run": {**both, "unit": unit}})
    scipy.io.savemat(tmp_path / "b.mat", {**both, "Units": unit})
    np.savez(tmp_path / "c.npz", **both, units=unit)
    files = [tmp_path / "a.mat", tmp_path / "b.mat", tmp_path / "c.npz"]
    for file in files:
        check(read(file), X * factor, Y * factor)
    own = {"b1x": {"data": X, "unit": "mg"}, "b2x": {"data": Y, "unit": "mg"}, "unit": unit, "fs": 100.0}
    scipy.io.savemat(tmp_path / "d.mat", own)
    check(read(tmp_path / "d.mat"), X * 9.80665e-3, Y * 9.80665e-3)


def test_a_column_of_time_stamps_is_the_time_whatever_its_name(tmp_path: Path) -> None:
    def stamp(k: int) -> str:
        return f"{np.datetime64(START_NS, 'ns') + np.timedelta64(10 * k, 'ms')}"

    check(read(table(tmp_path / "a.csv", "recorded at,b1x,b2x", stamp)), started_ns=START_NS)
    check(read(table(tmp_path / "b.csv", "Uhrzeit;b1x;b2x", lambda k: f"22:13:{20 + k / RATE_HZ:06.3f}", ";")))
    created = table(tmp_path / "c.csv", "created,b1x,b2x", lambda _: "2023-11-14 22:13:20")
    with pytest.raises(LogError, match="--rate"):
        read(created)
    assert load(created, Rig.parse(RIG_TEXT), 100.0, [].append).rate_hz == RATE_HZ


@pytest.mark.promise("channels that begin at different times", "times and starts of their own", "refused")
def test_channels_with_times_and_starts_of_their_own_are_refused(tmp_path: Path) -> None:
    import scipy.io

    of = {name: {"Data": values, "Time": K / RATE_HZ} for name, values in (("b1x", X), ("b2x", Y))}
    scipy.io.savemat(tmp_path / "a.mat", of)
    check(read(tmp_path / "a.mat"))
    of["b2x"]["Time"] = K / 50.0
    scipy.io.savemat(tmp_path / "b.mat", of)
    with pytest.raises(LogError, match=r"b2x has times of its own \(b2x.Time\), others than b1x.Time"):
        read(tmp_path / "b.mat")
    starts = (("b1x", X, "22:13:20"), ("b2x", Y, "22:13:21"))
    of = {n: {"Data": v, "fs": RATE_HZ, "start_time": t} for n, v, t in starts}
    scipy.io.savemat(tmp_path / "c.mat", of)
    with pytest.raises(LogError, match="its channels begin at different times"):
        read(tmp_path / "c.mat")


def test_a_table_without_a_header_is_called_one(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("0.00,1,2\n0.01,3,4\n")
    with pytest.raises(LogError, match="has no header: its first line is numbers; write the names"):
        read(tmp_path / "a.csv")


def test_columns_of_a_matrix_in_an_archive(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", d=np.column_stack([X, Y]), fs=100.0)
    rig = RIG_TEXT.replace('name = "b1x"', 'name = "b1x"\nalias = "d(:,1)"')
    check(read(tmp_path / "a.npz", rig=rig.replace('name = "b2x"', 'name = "b2x"\nalias = "d(:,2)"')))


def test_a_row_that_an_mf4_calls_invalid_is_no_sample(tmp_path: Path) -> None:
    from asammdf import MDF, Signal

    invalid = np.isin(K, [100, 101])
    with MDF(version="4.10") as file:
        file.append([
            Signal(X.astype(float), K / RATE_HZ, name="b1x", unit="m/s^2", invalidation_bits=invalid),
            Signal(Y, K / RATE_HZ, name="b2x", unit="m/s^2", conversion={"a": 0.5, "b": 1.0}),
        ])  # fmt: skip
        file.save(tmp_path / "a.mf4", overwrite=True)
    with pytest.raises(LogError, match="b1x is not a number at row 100 .*2 rows in all"):
        read(tmp_path / "a.mf4")


def hdf5(path: Path, attributes: dict[str, Any], of_time: dict[str, Any] | None = None, **more: float) -> Path:
    import h5py

    with h5py.File(path, "w") as file:
        for name, values in (("b1x", X), ("b2x", Y)):
            data = file.create_dataset(f"run/{name}", data=values)
            for key, value in (
                attributes | {k.partition("__")[2]: v for k, v in more.items() if k[:3] == name}
            ).items():
                data.attrs[key] = value
        if of_time is not None:
            time = file.create_dataset("run/time", data=K * of_time.get("step", 0.01))
            time.attrs["units"] = of_time["units"]
    return path


def test_attributes_of_hdf5(tmp_path: Path) -> None:
    pytest.importorskip("h5py")
    notes: list[str] = []
    check(read(hdf5(tmp_path / "a.h5", {"units": "g", "fs": 100.0})), X * 9.80665, Y * 9.80665)
    netcdf = {"scale_factor": 0.5, "add_offset": 1.0, "fs": 100.0}
    check(read(hdf5(tmp_path / "b.h5", netcdf)), X * 0.5 + 1, Y * 0.5 + 1)
    check(read(hdf5(tmp_path / "c.h5", {}, {"units": "ms", "step": 10.0})))
    check(read(hdf5(tmp_path / "d.h5", {}, {"units": "seconds since 2023-11-14 22:13:20"})), started_ns=START_NS)
    check(read(hdf5(tmp_path / "e.h5", {"fs": 100.0}, b2x__gain=0.25), notes))
    assert notes == ["b2x has gain = 0.25 beside it, which is not applied: check that it is in it"]
    for file, why in (
        (hdf5(tmp_path / "f.h5", {}, b1x__fs=100.0, b2x__fs=200.0), "run/b1x/fs says 100 Hz, run/b2x/fs 200 Hz"),
        (hdf5(tmp_path / "g.h5", {"fs": 100.0}, b1x___FillValue=float(X[7])), "b1x is not a number at row 7"),
    ):
        with pytest.raises(LogError, match=why):
            read(file)


def test_a_scaled_channel_of_tdms(tmp_path: Path) -> None:
    tdms = pytest.importorskip("nptdms")
    scaling = {
        "wf_increment": 0.01, "unit_string": "g", "NI_Scaling_Status": "unscaled", "NI_Number_Of_Scales": 1,
        "NI_Scale[0]_Scale_Type": "Linear", "NI_Scale[0]_Linear_Slope": 0.5, "NI_Scale[0]_Linear_Y_Intercept": 1.0,
        "NI_Scale[0]_Linear_Input_Source": 0xFFFFFFFF,
    }  # fmt: skip
    with tdms.TdmsWriter(tmp_path / "a.tdms") as file:
        file.write_segment([tdms.ChannelObject("g", n, v, scaling) for n, v in (("b1x", X), ("b2x", Y))])
    late = scaling | {"wf_start_offset": 0.5}
    with tdms.TdmsWriter(tmp_path / "b.tdms") as file:
        file.write_segment([tdms.ChannelObject("g", n, v, a) for n, v, a in (("b1x", X, scaling), ("b2x", Y, late))])
    with pytest.raises(LogError, match="its channels begin up to 0.5 s apart"):
        read(tmp_path / "b.tdms")
    check(read(tmp_path / "a.tdms"), (X * 0.5 + 1) * 9.80665, (Y * 0.5 + 1) * 9.80665)
