"""capture: on a real recording of somebody else's device, in three containers, and on damaged files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import can
import cantools
import numpy as np
import psutil
import pytest
from asammdf import MDF
from ramp_device import Record, read_all

from drivers.contract.errors import LinkError, LinkOpenError
from drivers.contract.link_config import CaptureConfig
from drivers.contract.reading import Info
from drivers.foreign.capture_files import open_capture
from drivers.links.links import make_driver

DATA = Path(__file__).parents[2] / "data" / "canedge_imu"
SIGNALS = {f"imu_{axis.lower()}": f"gnss_imu.Acceleration{axis}" for axis in "XYZ"}
FILES = ("canedge_imu.log", "canedge_imu.blf", "11111111_00000012_00000001.MF4")


def capture(path: Path, **options: object) -> Record:
    driver = make_driver(
        CaptureConfig(str(path), **options),  # type: ignore[arg-type]
        dbc=(DATA / "canmod-gps.dbc").read_bytes(),
        signals=SIGNALS,
    )
    driver.open()
    record = read_all(driver, Record(ramp=False))
    driver.close()
    return record


@pytest.mark.parametrize("name", FILES)
def test_real_recording(name: str) -> None:
    record = capture(DATA / name)
    assert [(s.name, s.unit, s.scale, s.offset) for s in record.infos[0].signals] == [
        (channel, "m/s^2", 0.125, 0.0) for channel in SIGNALS
    ]
    assert record.infos[0].rate_hz == 99.4, "ten frames 10 ms apart, then a pause of 0.6 ms"
    assert [(gap.index, gap.count, gap.reason) for gap in record.gaps][0] == (25, 41, "source")
    assert len(record.gaps) <= 2
    assert record.codes() <= {"coarse_stamps"}
    # the oracle: python-can's reader and cantools, one frame at a time
    message = cantools.database.load_file(DATA / "canmod-gps.dbc").get_message_by_frame_id(9)
    with can.LogReader(DATA / name) as reader:
        frames = [m for m in reader if m.arbitration_id == 9 and not m.is_extended_id]
    want = np.array([[message.decode(m.data)[s.split(".")[1]] for s in SIGNALS.values()] for m in frames])
    got = np.concatenate([block.counts for block in record.blocks]) * 0.125
    assert np.array_equal(got, want)
    # samples lie at their recorded times, true to a sample, over the stalls in the recording
    times = np.array([m.timestamp for m in frames])
    index = np.concatenate([block.index + np.arange(len(block.counts)) for block in record.blocks])
    lag = (times - times[0]) * 99.397 - index
    low, high = np.percentile(lag - np.median(lag), [0.5, 98.0])
    assert low > -1.0
    assert high < 1.2  # a frame may be late, and catch up


def test_containers_agree() -> None:
    log, blf = (capture(DATA / name) for name in FILES[:2])
    assert log.gaps == blf.gaps
    assert np.array_equal(log.blocks[0].counts, blf.blocks[0].counts)


def test_host_time_of_a_block_is_the_recorded_time() -> None:
    record = capture(DATA / FILES[0])
    first = record.blocks[0]
    assert first.t_host_ns / 1e9 == pytest.approx(1635188466.525 + (len(first.counts) - 1) * 0.01, abs=0.05)


def test_damaged_log_is_counted_and_read_on(tmp_path: Path) -> None:
    lines = (DATA / FILES[0]).read_text().splitlines(keepends=True)[:6000]
    lines[100] = "garbage\n"
    lines[200] = "(1635188454.9) can0 009#ABC R\n"
    path = tmp_path / "cut.log"
    path.write_bytes("".join(lines).encode() + os.urandom(3000))
    record = capture(path)
    assert "capture_damaged" in record.codes()
    assert record.samples > 250


def test_cut_blf_ends_with_a_notice(tmp_path: Path) -> None:
    path = tmp_path / "cut.blf"
    path.write_bytes((DATA / "canedge_imu.blf").read_bytes()[:120_000])
    record = capture(path)
    assert record.samples > 1000
    assert "capture_damaged" in record.codes()


def test_a_library_that_complains_of_every_frame_is_silenced(tmp_path: Path) -> None:
    """In a process of its own: pytest listens to all logs."""
    path = tmp_path / "a.asc"
    path.write_text("base hex timestamps absolute\n" + 9 * " 0.2 CANFD 1 Rx 301 1 0 9 2 00 01\n")
    script = (
        "from drivers.foreign.capture_files import open_capture; "
        f"print(len(next(open_capture({str(path)!r}, None)).frames))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("9\n", "")


def test_cut_mf4_of_an_unfinished_recording_is_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "cut.mf4"  # the logger writes no lengths: where it ends is where it ended
    path.write_bytes((DATA / FILES[2]).read_bytes()[:1_000_000])
    assert capture(path).samples > 1000


def test_a_damaged_asc_line_costs_that_line_alone(tmp_path: Path) -> None:
    lines = [f" {0.01 * k:.4f} 1  300x Rx   d 2 {k:02X} 00" for k in range(1, 6)]
    lines[2] = lines[2].replace(" 03 ", " 0Z ")
    path = tmp_path / "a.asc"
    path.write_text("date Mon Jan 1 00:00:00 2024\nbase hex timestamps absolute\n" + "\n".join(lines))
    batches = list(open_capture(str(path), None))
    assert [int(b) for batch in batches for b in batch.frames.payload[:, 0]] == [1, 2, 4, 5]  # the first line, too
    assert [(batch.damaged, "0Z" in batch.why) for batch in batches if batch.damaged] == [(1, True)]


def test_what_may_be_a_damaged_frame_of_an_asc_is_reported_and_other_events_are_not(tmp_path: Path) -> None:
    """python-can leaves out in silence every line that it does not know."""
    others = [
        "date Mon Jan 1 00:00:00 2024", "base hex timestamps absolute", "internal events logged", "// version 9.0.0",
        "Begin Triggerblock Mon Jan 1 00:00:00 2024", " 0.000000 Start of measurement", "",
        " 0.0159 CAN 1 Status:chip status error active - TxErr: 8 RxErr: 0", " 0.016 L1 3C Rx 2 00 00 checksum = ff",
        " 0.016 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%", " 0.017 SV: 3 0 1 ::a = 5", " 0.018 1 ErrorFrame",
        " 0.018 1  J1939TP FEE3p 6 0 0 - Rx d 23 A0 0F A6", " 0.019 log trigger event", "End TriggerBlock",
    ]  # fmt: skip
    good = " 0.02 1  300x Rx   d 2 07 00"
    bad = [
        " 0.02 1  3\ufffd0x Rx   d 2 07 00", " 0 02 1  300x Rx   d 2 07 00", " 0.02 1  300x Rz   d 2 07 00",
        " 0.02 q  300x Rx   d 2 07 00", " 0.02 1  300x Rx   d 2 07", " 0.02 CANFE 1 Rx 301 1 0 9 2 00 01",
        "0 Rx d 2 07", " 0.02 CANFD 1 Rx 301 1 0 9 12 00 01 02", "\x00\x00\x00",
    ]  # fmt: skip
    path = tmp_path / "a.asc"
    path.write_text("\n".join(others))
    assert [batch.damaged for batch in open_capture(str(path), None)] == [0]
    for line in bad:
        path.write_text("\n".join([*others, good, line, good]), encoding="utf-8")
        (batch,) = open_capture(str(path), None)
        assert (batch.damaged, len(batch.frames)) == (1, 3), line  # and the error frame
        assert f"line {len(others) + 2} is neither" in batch.why or "a frame of" in batch.why


def test_junk_is_left_at_a_stop_not_read_to_its_end(tmp_path: Path) -> None:
    """Each batch has an end, so that whoever closes it gets a turn."""
    for suffix in (".asc", ".log"):
        path = tmp_path / f"a{suffix}"
        path.write_text(10_000 * "junk\n")
        assert [batch.damaged for batch in open_capture(str(path), None)] == [4096, 4096, 1808]


def test_cut_mf4_of_a_finished_recording_does_not_open(tmp_path: Path) -> None:
    path = tmp_path / "whole.mf4"
    with MDF(DATA / FILES[2]) as mdf:
        mdf.save(path)
    (tmp_path / "cut.mf4").write_bytes(path.read_bytes()[:1_000_000])
    with pytest.raises(LinkOpenError, match="not a .mf4 file"):
        capture(tmp_path / "cut.mf4")


def test_an_mf4_file_may_be_left_before_its_end() -> None:
    before = {child.pid for child in psutil.Process().children()}
    batches = open_capture(str(DATA / FILES[2]), None)
    assert len(next(batches).frames) > 1000
    batches.close()
    batches.close()
    assert next(batches, None) is None
    assert {child.pid for child in psutil.Process().children()} <= before


def test_what_cannot_be_read_is_said(tmp_path: Path) -> None:
    with pytest.raises(LinkOpenError, match="check the path"):
        capture(tmp_path / "none.log")
    os.mkfifo(tmp_path / "pipe.log")
    with pytest.raises(LinkOpenError, match="save the traffic first"):
        capture(tmp_path / "pipe.log")
    (tmp_path / "data.txt").write_text("x")
    with pytest.raises(LinkOpenError, match="use .log, .blf, .asc, .mf4"):
        capture(tmp_path / "data.txt")
    (tmp_path / "data.blf").write_text("not one")
    with pytest.raises(LinkOpenError, match="not a .blf file"):
        capture(tmp_path / "data.blf")


def test_signal_map_errors_name_the_remedy() -> None:
    dbc = (DATA / "canmod-gps.dbc").read_bytes()
    config = CaptureConfig("x.log")
    for signals, text in [
        ({"a": "gnss_imu.AccelerationQ"}, "did you mean 'Acceleration"),
        ({"a": "gnss_imo.AccelerationX"}, "did you mean 'gnss_imu'"),
        ({"a": "AccelerationX"}, "write Message.Signal"),
        ({}, "empty"),
    ]:
        with pytest.raises(LinkError, match=text):
            make_driver(config, dbc=dbc, signals=signals)
    with pytest.raises(LinkError, match="cannot be read"):
        make_driver(config, dbc=b"BO_ nonsense", signals={"a": "b.c"})
    with pytest.raises(LinkError, match="set link.dbc"):
        make_driver(config, signals={"a": "b.c"})


def test_given_rate_is_a_check_of_the_true_one() -> None:
    record = capture(DATA / FILES[0], rate_hz=50.0)
    assert isinstance(record.infos[0], Info)
    assert record.infos[0].rate_hz == 99.4
    assert "rate_untrue" in record.codes()
