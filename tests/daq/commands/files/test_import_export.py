"""Files in and out: whole round trips for every format, exactness, and a clear refusal of everything doubtful."""

import json
import re
import time
import weakref
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from daq.base.contract.sink import Session
from daq.commands.cli.app import main
from daq.commands.files.importers import power_of_two
from daq.exchange.child import REFUSED_STATUS, refusal
from daq.log.reader import read_log
from daq.log.writer import LogWriter
from drivers.contract import Block

RATE = 5120.0
RIG = """schema = 1
[band]
low = 100.0
high = 2000.0
[acquisition]
rate_hz = 5120.0
full_scale = 100.0
[[channel]]
name = "b1x"
node = "bearing1"
direction = "x"
unit = "g"
[[channel]]
name = "b1y"
node = "bearing1"
direction = "y"
unit = "m/s^2"
"""
FACTORS = np.array([9.80665, 1.0])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "rig.toml").write_text(RIG)
    return tmp_path


def samples(n: int = 4000) -> np.ndarray:
    return np.random.default_rng(1).standard_normal((n, 2)) * [3.0, 40.0]


def write_npz(path: Path, y: np.ndarray, **more: object) -> Path:
    np.savez(path, allow_pickle=False, **({"b1x": y[:, 0], "b1y": y[:, 1], "rate_hz": RATE} | more))  # type: ignore[arg-type]
    return path


def write_csv(path: Path, y: np.ndarray, time: np.ndarray | None = None, header: str = "b1x,b1y") -> Path:
    table = y if time is None else np.column_stack([time, y])
    np.savetxt(path, table, delimiter=",", header=("" if time is None else "time,") + header, comments="", fmt="%.9g")
    return path


def load(folder: Path, file: Path, *options: str) -> int:
    return main(["import", str(file), "--rig", str(folder / "rig.toml"), "--out", str(folder / "log.mcap"), *options])


def refused(folder: Path, file: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    assert load(folder, file, *options) == 4
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert not (folder / "log.mcap").exists()
    return error


def test_a_log_of_an_npz_is_in_si_and_exact_to_far_below_the_noise(folder: Path) -> None:
    y = samples()
    assert load(folder, write_npz(folder / "a.npz", y)) == 0
    log = read_log(folder / "log.mcap")
    assert log.complete
    assert log.rate_hz == RATE
    assert log.channels == ("b1x", "b1y")
    np.testing.assert_allclose(log.samples(), y * FACTORS, rtol=0, atol=2**-29 * np.abs(y * FACTORS).max())
    assert "b1x" in log.rig_text


def test_whole_numbers_go_in_as_they_are(folder: Path) -> None:
    y = np.random.default_rng(0).integers(-32767, 32768, (5000, 2)).astype(np.int16)
    assert load(folder, write_npz(folder / "a.npz", y)) == 0
    np.testing.assert_array_equal(read_log(folder / "log.mcap").counts(), y)


@given(arrays(np.float32, 50, elements=st.floats(1.0, 64.0, width=32)))
def test_single_precision_survives_to_the_last_bit(values: np.ndarray) -> None:
    scale = power_of_two(values)
    counts = np.rint(values.astype(np.float64) / scale)
    assert np.abs(counts).max() < 2**30
    np.testing.assert_array_equal((counts * scale).astype(np.float32), values)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pyuff's writer leaves its file open
@pytest.mark.parametrize("ending", ["npz", "csv", "mat", "wav", "mf4", "uff", "h5", "parquet"])
def test_out_and_in_again(folder: Path, ending: str) -> None:
    if ending in ("h5", "parquet"):
        pytest.importorskip({"h5": "h5py", "parquet": "pyarrow"}[ending])
    y = samples()
    load(folder, write_npz(folder / "a.npz", y))
    (folder / "log.mcap").rename(folder / "first.mcap")
    back = folder / f"back.{ending}"
    assert main(["export", str(folder / "first.mcap"), "--to", str(back)]) == 0
    assert load(folder, back) == 0
    first, second = read_log(folder / "first.mcap"), read_log(folder / "log.mcap")
    assert second.rate_hz == pytest.approx(RATE, rel=1e-9)
    atol = 2e-5 if ending == "wav" else 1e-12  # .wav holds single precision
    np.testing.assert_allclose(second.samples(), first.samples(), rtol=0, atol=atol)


def write_uff(path: Path, y: np.ndarray, binary: int) -> Path:
    import pyuff

    file = pyuff.UFF(str(path))
    for k, name in enumerate(("b1x", "b1y")):
        x = np.arange(len(y)) / RATE
        file.write_sets(
            pyuff.prepare_58(
                binary=binary, func_type=1, ver_num=1, load_case_id=0, rsp_ent_name=name, rsp_node=1, rsp_dir=1,
                ref_ent_name="NONE", ref_node=0, ref_dir=0, data=y[:, k], x=x, id1=name, id2="", id3="", id4="", id5="",
                ord_data_type=4, orddenom_spec_data_type=0, z_axis_spec_data_type=0, abscissa_spacing=1,
                abscissa_min=0.0, abscissa_inc=1 / RATE, num_pts=len(y),
            ),
            mode="add",
        )  # fmt: skip
    return path


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pyuff's writer leaves its file open
def test_uff_dataset_58(folder: Path) -> None:
    y = samples(1000)
    assert load(folder, write_uff(folder / "a.uff", y, binary=1)) == 0
    log = read_log(folder / "log.mcap")
    assert log.rate_hz == pytest.approx(RATE, rel=1e-4)  # text of the file: 1/5120 with few digits
    np.testing.assert_allclose(log.samples(), y * FACTORS, rtol=1e-6, atol=1e-6)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_uff_that_lost_some_characters_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """pyuff reads what is there, by columns of the text, and compares it with nothing."""
    text = write_uff(folder / "whole.uff", samples(1000), binary=0).read_bytes()
    lines = text.split(b"\n")
    for damage in ([*lines[:100], *lines[101:]], [*lines[:100], lines[100][:-20], *lines[101:]]):
        (folder / "a.uff").write_bytes(b"\n".join(damage))
        said = refused(folder, folder / "a.uff", capsys)
        assert "values, its header says 1000; the file is cut or damaged" in said


def test_a_cut_sound_is_refused_wherever_it_is_cut(
    folder: Path, capsys: pytest.CaptureFixture[str], record_property: Callable[[str, object], None]
) -> None:
    """The library takes what there is, and does not say so."""
    from scipy.io import wavfile

    wavfile.write(folder / "whole.wav", int(RATE), samples(3000).astype(np.float32))
    whole = (folder / "whole.wav").read_bytes()
    for cut in (60, 1000, len(whole) // 2, len(whole) - 8, len(whole) - 1):
        (folder / "a.wav").write_bytes(whole[:cut])
        assert "it announces are missing: it is cut" in refused(folder, folder / "a.wav", capsys)
    piped = whole.replace(
        b"data" + (len(whole) - whole.index(b"data") - 8).to_bytes(4, "little"), b"data" + 4 * b"\xff"
    )
    assert piped != whole
    (folder / "a.wav").write_bytes(piped)  # by a program that could not go back to say how long it became
    assert "or was written through a pipe" in refused(folder, folder / "a.wav", capsys)
    row = "cut file of others | `import` of a .wav cut at five places, a .uff that lost a line or a value"
    record_property("reliability", f"{row} | refused, as .npz, .mat and .mf4 are by their libraries | refused")


def test_a_cut_mf4_is_refused_with_its_librarys_reason(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of the half-made object that goes then, it has more to say, and that came last."""
    from asammdf import MDF, Signal

    with MDF() as file:
        file.append([Signal(samples(1000)[:, 0], np.arange(1000) / RATE, name="b1x")])
        file.save(folder / "whole.mf4")
    whole = (folder / "whole.mf4").read_bytes()
    for cut in (64, len(whole) - 100):
        (folder / "a.mf4").write_bytes(whole[:cut])
        said = refused(folder, folder / "a.mf4", capsys)
        assert "cannot be read as .mf4: " in said
        assert "; check that it is whole" in said
        assert "AttributeError" not in said


def test_a_table_whose_last_line_has_no_end_is_read_and_it_is_said(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = write_csv(folder / "a.csv", samples()).read_text()
    (folder / "a.csv").write_text(text[:-3])
    assert load(folder, folder / "a.csv", "--rate", str(RATE)) == 0
    assert "if the file was cut, its last number is wrong" in capsys.readouterr().err


def test_a_table_of_one_endless_line_is_refused_at_once(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with (folder / "a.csv").open("wb") as file:
        file.truncate(2 << 30)  # two gigabytes that take no room
    begin = time.process_time()
    assert "first line does not end within a megabyte" in refused(folder, folder / "a.csv", capsys)
    assert time.process_time() - begin < 2  # its lines were read whole, in ten


def test_pcm_sound_needs_full_scale_and_has_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from scipy.io import wavfile

    counts = np.random.default_rng(0).integers(-32767, 32768, (3000, 2)).astype(np.int16)
    wavfile.write(folder / "a.wav", int(RATE), counts)
    assert load(folder, folder / "a.wav") == 0
    np.testing.assert_allclose(read_log(folder / "log.mcap").samples(), counts * (100 / 32768) * FACTORS, rtol=1e-9)
    (folder / "log.mcap").unlink()
    (folder / "rig.toml").write_text(RIG.replace("full_scale = 100.0\n", ""))
    assert "acquisition.full_scale" in refused(folder, folder / "a.wav", capsys)


def test_what_is_doubtful_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    y = samples()
    holed = y.copy()
    holed[100:110, 1] = np.nan
    assert "b1y is not a number at row 100" in refused(folder, write_npz(folder / "nan.npz", holed), capsys)
    assert "unequal length: b1x 4000, b1y 3990" in refused(
        folder, write_npz(folder / "short.npz", y, b1y=y[:-10, 1]), capsys
    )
    np.savez(folder / "few.npz", b1x=y[:, 0], b1Y=y[:, 1], rate_hz=RATE)
    assert 'no channel "b1y" of the rig; did you mean "b1Y"?' in refused(folder, folder / "few.npz", capsys)
    np.savez(folder / "empty.npz")
    assert "holds no channel; check that it is whole" in refused(folder, folder / "empty.npz", capsys)
    np.savez(folder / "norate.npz", b1x=y[:, 0], b1y=y[:, 1])
    assert "give --rate HZ" in refused(folder, folder / "norate.npz", capsys)
    assert "--rate says 5000" in refused(folder, write_npz(folder / "a.npz", y), capsys, "--rate", "5000")
    slow = write_npz(folder / "slow.npz", y, rate_hz=1000.0)
    assert "not below 500 Hz, half the sampling rate" in refused(folder, slow, capsys)
    assert "holds text" in refused(folder, write_npz(folder / "text.npz", y, b1x=np.array(["abc"] * 4000)), capsys)
    assert "one number is needed" in refused(folder, write_npz(folder / "r.npz", y, rate_hz=np.ones(3)), capsys)
    assert "0 samples" in refused(folder, write_npz(folder / "empty.npz", y[:0]), capsys)
    assert "no such file" in refused(folder, folder / "none.npz", capsys)
    assert 'cannot be read by its ending ".xyz"' in refused(folder, folder / "none.xyz", capsys)
    np.save(folder / "one.npy", y)
    (folder / "one.npy").rename(folder / "one.npz")
    assert "one array without a name" in refused(folder, folder / "one.npz", capsys)
    (folder / "broken.npz").write_bytes(b"PK\x03\x04 not a zip")
    assert "cannot be read as .npz" in refused(folder, folder / "broken.npz", capsys)


def test_csv_mistakes_have_their_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def text(body: str) -> Path:
        (folder / "a.csv").write_text("# a recorder\nb1x,b1y\n" + body)
        return folder / "a.csv"

    assert 'a.csv:4: b1y: "abc" is not a number' in refused(folder, text("1,2\n3,abc\n"), capsys, "--rate", "5120")
    assert "a.csv:4: b1y: the cell is empty" in refused(folder, text("1,2\n3,\n"), capsys, "--rate", "5120")
    assert "a.csv:4: 3 cells where the header has 2" in refused(folder, text("1,2\n3,4,5\n"), capsys, "--rate", "5120")
    assert "b1x is not a number at row 1" in refused(folder, text("1,2\nnan,4\n"), capsys, "--rate", "5120")
    assert "give --rate" in refused(folder, text("1,2\n3,4\n"), capsys)


def test_time_must_be_uniform_without_gaps_and_rising(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    y = samples()
    time = np.arange(4000) / RATE
    assert load(folder, write_csv(folder / "a.csv", y, time)) == 0
    assert read_log(folder / "log.mcap").rate_hz == RATE
    (folder / "log.mcap").unlink()
    gap = np.where(np.arange(4000) < 500, time, time + 20 / RATE)
    assert "20 samples are missing before row 500" in refused(folder, write_csv(folder / "g.csv", y, gap), capsys)
    back = time.copy()
    back[7] = 0
    assert "does not increase at row 7" in refused(folder, write_csv(folder / "b.csv", y, back), capsys)
    warped = time + 0.4 / RATE * np.sin(np.arange(4000) / 300)
    assert "not sampled uniformly" in refused(folder, write_csv(folder / "w.csv", y, warped), capsys)


def test_a_unit_in_the_file_is_converted_and_that_is_said(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    time, y = np.arange(4000) / RATE, samples()
    assert load(folder, write_csv(folder / "a.csv", y, time, "b1x [g],b1y (m/s²)")) == 0
    assert "converted" not in capsys.readouterr().err
    assert load(folder, write_csv(folder / "a.csv", y, time, "b1x [m/s^2],b1y [mg]")) == 0
    assert 'b1x is in "m/s^2" there, and in "g" in the rig file: converted' in capsys.readouterr().err
    np.testing.assert_allclose(read_log(folder / "log.mcap").samples(), y * [1.0, 9.80665e-3], atol=1e-6)
    (folder / "log.mcap").unlink()
    said = refused(folder, write_csv(folder / "a.csv", y, time, "b1x [V],b1y"), capsys)
    assert 'b1x is in "V" there; say what its sensor gives, in the rig file: sensitivity = ' in said


@pytest.mark.promise("volts, and names of others", "`sensitivity`, `offset`, `alias` of the rig file", "converted")
def test_volts_and_names_of_others_by_the_rig_file(folder: Path) -> None:
    more = 'unit = "m/s^2"\nsensitivity = { value = 10.0, unit = "mV/(m/s^2)" }\nalias = "Ch 2, top"\noffset = 3.0'
    (folder / "rig.toml").write_text(RIG.replace('unit = "m/s^2"', more))
    y = samples()
    write_csv(folder / "a.csv", y, np.arange(4000) / RATE, 'b1x,"Ch 2, top [mV]"')
    assert load(folder, folder / "a.csv") == 0
    np.testing.assert_allclose(read_log(folder / "log.mcap").samples()[:, 1], y[:, 1] / 10 - 3.0, atol=1e-6)


@pytest.mark.promise("9.9e37 and one huge value", "in a column", "refused with the row")
def test_a_value_that_stands_for_none_is_refused_and_a_huge_one_too(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    y = samples()
    y[200, 0] = 9.9e37
    said = refused(folder, write_npz(folder / "a.npz", y), capsys)
    assert 'b1x is 9.9e+37, which stands for "no value", at row 200' in said
    y[200, 0] = 1e12
    said = refused(folder, write_npz(folder / "a.npz", y), capsys)
    assert "b1x is 1e+12 at row 200" in said
    assert "a log resolves 2^-30 of the largest value" in said


def test_a_large_constant_costs_no_resolution(folder: Path) -> None:
    y = samples() * 1e-6 + 1e6
    assert load(folder, write_npz(folder / "a.npz", y)) == 0
    np.testing.assert_allclose(read_log(folder / "log.mcap").samples(), y * FACTORS, rtol=0, atol=1e-8)


def test_gaps_only_when_asked_for_and_named_on_the_way_out(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    y = samples()
    y[1000:1200] = np.nan
    file = write_npz(folder / "a.npz", y)
    assert "import with --gaps" in refused(folder, file, capsys)
    assert load(folder, file, "--gaps") == 0
    log = read_log(folder / "log.mcap")
    assert [(g.index, g.count, g.reason) for g in log.gaps] == [(1000, 200, "source")]
    np.testing.assert_array_equal(np.isnan(log.samples()), np.isnan(y))
    capsys.readouterr()
    assert main(["export", str(folder / "log.mcap"), "--to", str(folder / "b.csv")]) == 0
    assert "gap: 200 samples from index 1000 on, t = 0.195312 s" in capsys.readouterr().err


def test_a_channel_at_its_ceiling_is_said(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    y = samples()
    y[:, 1] = np.clip(y[:, 1], -80.0, 80.0)
    assert load(folder, write_npz(folder / "a.npz", y)) == 0
    finding = re.search(r"b1y is clipped at \+-80 m/s\^2 in .*", capsys.readouterr().err)
    assert finding
    assert main(["info", str(folder / "log.mcap"), "--json", str(folder / "i.json")]) == 0
    assert f"warning: {finding[0]}" in capsys.readouterr().out
    facts = json.loads((folder / "i.json").read_text())
    assert [(n["level"], n["code"], n["text"]) for n in facts["notices"]] == [("warning", "clipped", finding[0])]
    assert facts["findings"] == []  # said once


def test_what_makes_a_record_unfit_is_said_by_import_and_info(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    y = samples()
    assert load(folder, write_npz(folder / "a.npz", y, b1y=y[:, 0] * 9.80665)) == 0
    assert "b1x and b1y carry the same signal" in capsys.readouterr().err
    still = np.where(np.arange(4000) < 2000, y[:, 1], y[2000, 1])
    assert load(folder, write_npz(folder / "a.npz", y, b1y=still)) == 0
    said = re.search(r"b1y is frozen: it stands still at.*", capsys.readouterr().err)
    assert said
    log = read_log(folder / "log.mcap")
    writer = LogWriter(folder / "live.mcap", live=False)  # a log that nobody surveyed
    writer.start(Session(model=None, info=log.info, device="", attachments={"rig.toml": RIG.encode()}, metadata={}))  # type: ignore[arg-type]
    writer.readings([Block(0, log.counts(), 10**9)])
    writer.close()
    assert main(["info", str(folder / "live.mcap")]) == 0
    assert said[0][:40] in " ".join(capsys.readouterr().out.split())


def test_the_process_that_reads_lets_go_of_what_it_read_before_it_says_why_not() -> None:
    """Under a bound on memory, what the library had made when it failed may leave no room for a line."""
    held: list[weakref.ref[np.ndarray]] = []

    def read() -> None:
        big = np.zeros(10)
        held.append(weakref.ref(big))
        try:
            raise MemoryError("full")
        except MemoryError as error:
            raise ValueError("damaged") from error

    try:
        read()
    except ValueError as error:
        said, left = refusal(error), held[0]()
    assert said == (REFUSED_STATUS, "damaged")
    assert left is None


def test_another_rate_than_the_rigs_is_said_and_used(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert load(folder, write_npz(folder / "a.npz", samples(), rate_hz=5000.0), "--json", "-") == 0
    captured = capsys.readouterr()
    assert "5000 Hz, where the rig file expects 5120 Hz" in captured.err
    assert json.loads(captured.out)["rate_hz"] == 5000.0
    assert [n.code for n in read_log(folder / "log.mcap").notices] == ["file_odd"]


def test_export_of_nothing_and_to_nowhere(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    load(folder, write_npz(folder / "a.npz", samples()))
    log = str(folder / "log.mcap")
    assert main(["export", log, "--to", str(folder / "b.xyz")]) == 2
    assert main(["export", log, "--to", str(folder / "no" / "b.npz")]) == 2
    assert main(["export", str(folder / "none.mcap"), "--to", str(folder / "b.npz")]) == 4
    assert not list(folder.glob(".*part*"))
