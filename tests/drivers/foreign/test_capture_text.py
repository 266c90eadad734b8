"""candump and ASC files as recorders, shells and options of theirs write them."""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ramp_device import Record, read_all

from drivers.contract.errors import LinkOpenError
from drivers.contract.link_config import CaptureConfig
from drivers.foreign.asc import when
from drivers.foreign.candump import are_differences, candump_batches
from drivers.foreign.reorder import Reorder
from drivers.links.links import make_driver, parse_link
from drivers.protocol.device_info import Expected

DBC = b"""VERSION ""
NS_ :
BS_:
BU_: d
BO_ 256 Acc_B: 2 d
 SG_ X : 0|16@1- (1,0) [0|0] "m/s^2" d
"""
K = range(120)
PLAIN = [f"(170000000{k // 100}.{10_000 * (k % 100):06d}) can0 100#{k:02X}00" for k in K]
ASC = ["date Tue Nov 14 10:13:20.000 pm 2023", "base hex  timestamps absolute", "internal events logged"]


def asc(t_s: float, k: int, bus: int = 1, direction: str = "Rx", name: str = "100") -> str:
    return f"{t_s:.6f} {bus}  {name}             {direction}   d 2 {k:02X} 00"


def read(path: Path, lines: Sequence[str] | bytes, bus: str | None = None) -> Record:
    path.write_bytes(lines if isinstance(lines, bytes) else "\n".join(lines).encode())
    driver = make_driver(
        CaptureConfig(str(path), bus=bus), dbc=DBC, signals={"x": "Acc_B.X"}, expected=Expected(100.0)
    )  # fmt: skip
    driver.open()
    record = read_all(driver, Record(ramp=False))
    driver.close()
    return record


def samples(record: Record) -> np.ndarray:
    out = np.full(record.next_index, -1)
    for block in record.blocks:
        out[block.index : block.index + len(block.counts)] = block.counts[:, 0]
    return out


SCREEN = [line.replace(" can0 100#", "  can0  100   [2]  ")[:-2] + " 00" for line in PLAIN]
FORMS = {
    "a raw length code": [line + "_9" for line in PLAIN], "with direction": [line + " R" for line in PLAIN],
    "on the screen": [" " + line for line in SCREEN],
    "on the screen with -x": [line.replace("can0  ", "can0  RX - -  ") for line in SCREEN],
    "on the screen with -tA": [re.sub(r"\(17000000(\d\d)", r"(2023-11-14 22:13:\1", line) for line in SCREEN],
    "on the screen in colours": [f" \x1b[31m{line}\x1b[0m" for line in SCREEN],
    "between remarks": ["# by me", *PLAIN[:60], "// half of it", "# " + 3000 * "-", *PLAIN[60:]],
    "neighbours swapped": [PLAIN[k ^ 1] for k in K],
    "differences": ["(000.000000) can0 100#0000", *(f"(000.010000) can0 100#{k:02X}00" for k in K[1:])],
    "differences that vary": [f"(000.{0 if k == 0 else 10_000 + 30 * (-1) ** k:06d}) can0 100#{k:02X}00" for k in K],
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_candump_in_other_forms(form: str, tmp_path: Path) -> None:
    record = read(tmp_path / "a.log", FORMS[form])
    assert samples(record).tolist() == list(K)
    assert "capture_damaged" not in record.codes()


@pytest.mark.promise("CAN XL frames", "between the frames of a candump log", "left out, said; no samples, no losses")
def test_frames_of_can_xl_are_left_out(tmp_path: Path) -> None:
    xl = [line.replace("100#", "45123#81:00:12345678#" + 2048 * "11") for line in PLAIN]
    record = read(tmp_path / "a.log", [line for pair in zip(PLAIN, xl, strict=True) for line in pair])
    assert samples(record).tolist() == list(K)
    assert record.codes() == {"can_xl"}
    with pytest.raises(LinkOpenError, match="holds no frame"):
        read(tmp_path / "b.log", xl)


@pytest.mark.promise("text of another encoding", "UTF-16, byte order marks", "every frame read")
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("suffix", [".log", ".asc"])
def test_in_another_encoding(encoding: str, suffix: str, tmp_path: Path) -> None:
    lines = PLAIN if suffix == ".log" else [*ASC, *(asc(0.01 * k, k) for k in K)]
    record = read(tmp_path / f"a{suffix}", "\r\n".join(lines).encode(encoding))
    assert samples(record).tolist() == list(K)
    assert not record.notices


@pytest.mark.promise("stamps that are differences", "candump -td with a hole", "added up, the hole a gap, said")
def test_a_hole_in_differences_is_a_hole(tmp_path: Path) -> None:
    lines = [f"(000.{0 if k == 0 else 510_000 if k == 60 else 10_000:06d}) can0 100#{k:02X}00" for k in K]
    record = read(tmp_path / "a.log", lines)
    assert [(gap.index, gap.count) for gap in record.gaps] == [(60, 50)]
    assert "delta_times" in record.codes()


@pytest.mark.promise("frames out of order", "shuffled within ten frames", "each frame once, at its time, said")
@pytest.mark.parametrize("seed", range(8))
def test_frames_that_are_shuffled_are_each_there_once(seed: int, tmp_path: Path) -> None:
    random, lines = np.random.default_rng(seed), list(PLAIN)
    for k in range(0, len(lines), 20):
        lines[k : k + 10] = random.permutation(lines[k : k + 10]).tolist()
    record = read(tmp_path / "a.log", lines)
    assert samples(record).tolist() == list(K)
    assert "unsorted" in record.codes()


@pytest.mark.parametrize("seed", range(8))
def test_frames_of_two_identifiers_that_are_shuffled_are_sorted(seed: int, tmp_path: Path) -> None:
    random = np.random.default_rng(seed)
    lines = [each for one in PLAIN for each in (one, one.replace("0000) can0 100#", "0500) can0 200#"))]
    for k in range(0, len(lines), 16):
        lines[k : k + 8] = random.permutation(lines[k : k + 8]).tolist()
    (tmp_path / "a.log").write_text("\n".join(lines))
    sort = Reorder()
    parts = [sort.take(batch) for batch in candump_batches(tmp_path / "a.log")]
    rest = sort.rest()
    assert rest is not None
    times = np.concatenate([part.frames.t_ns for part in (*parts, rest)])
    assert len(times) == 2 * len(PLAIN)
    assert (np.diff(times) > 0).all()


@given(st.lists(st.integers(0, 10**9), min_size=1, max_size=40))
def test_times_that_rise_are_no_differences(steps_us: list[int]) -> None:
    """Unless frames come faster than a bus can carry them."""
    stamps = np.cumsum(np.array(steps_us, np.int64) * 1000 + 20_000).tolist()
    assert not are_differences(stamps)


@pytest.mark.promise(
    "a recording of another kind",
    "BusMaster, PCAN, candump without times",
    "the true reason, and what to convert it to",
)
@pytest.mark.parametrize(
    ("lines", "text"),
    [
        (["***BUSMASTER Ver 3.2.2***", "13:33:00:0000 Rx 1 0x100 s 4 18 FC"], "BusMaster"),
        (["  can0  100   [2]  18 FC"] * 9, "candump -L"),
        ([";$FILEVERSION=1.1"], "PCAN"), ([*ASC, asc(0, 0)], "name it .asc"),
        (["junk"] * 9, "9 records cannot be read"),
        ([], "holds no frame"),
        ([line.replace("100#", "101#") for line in PLAIN], "of 0x101, and none of Acc_B"),
    ],
)  # fmt: skip
def test_what_it_is_and_what_to_do_is_said(lines: list[str], text: str, tmp_path: Path) -> None:
    with pytest.raises(LinkOpenError, match=text):
        read(tmp_path / "a.log", lines)


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("a.log", b"LOGG\x90", "name it .blf"), ("a.asc", b"MDF     4.10", "name it .mf4"),
        ("a.log", b"\x1f\x8b\x08", "gzip: unpack"), ("a.blf", b"PK\x03\x04", "a ZIP archive: unpack"),
        ("a.asc", PLAIN[0].encode(), "a candump log by its first line: name it .log"),
    ],
)  # fmt: skip
def test_a_file_under_the_ending_of_another_kind_is_called_so(
    tmp_path: Path, name: str, content: bytes, text: str
) -> None:
    with pytest.raises(LinkOpenError, match=text):
        read(tmp_path / name, content)


@pytest.mark.promise(
    "two buses in a recording",
    "each frame on both, or two devices",
    "refused with the choice; `?bus=` as the file counts",
)
def test_two_buses_are_refused_and_one_is_read(tmp_path: Path) -> None:
    both = [line for one in PLAIN for line in (one, one.replace("can0", "can1"))]
    choices = r"choose one: --link 'capture:.*\?bus=can0' or --link 'capture:.*\?bus=can1'$"
    with pytest.raises(LinkOpenError, match=choices):
        read(tmp_path / "a.log", both)
    assert samples(read(tmp_path / "a.log", both, "can1")).tolist() == list(K)
    with pytest.raises(LinkOpenError, match="no bus 1 in it: it has can0, can1"):
        read(tmp_path / "a.log", both, "1")
    lines = [*ASC, *(asc(0.01 * k + 0.003 * bus, bus * k, bus) for k in K for bus in (1, 2))]
    assert samples(read(tmp_path / "a.asc", lines, "1")).tolist() == list(K), "as the file counts them"


@pytest.mark.promise("own echo in a recording", "T and R, Tx and Rx, TxRq", "each sample once, said")
def test_an_echo_is_taken_once(tmp_path: Path) -> None:
    twice = [line for one in PLAIN for line in (one + " T", one.replace("0000) can0", "0200) can0") + " R")]
    record = read(tmp_path / "a.log", twice)
    assert samples(record).tolist() == list(K)
    assert "own_echo" in record.codes()
    requests = [*ASC, *(asc(0.01 * k + 2e-4 * j, k, direction=way) for k in K for j, way in enumerate(("TxRq", "Tx")))]
    assert samples(read(tmp_path / "a.asc", requests)).tolist() == list(K)
    other = [PLAIN[k // 2][:-4] + f"{k % 2:02X}{k:02X} " + "TR"[k % 2] for k in range(240)]
    with pytest.raises(LinkOpenError, match="two senders"):
        read(tmp_path / "a.log", other)


def test_asc_with_names_commas_and_times_before_the_trigger(tmp_path: Path) -> None:
    lines = [*ASC, *(asc(0.01 * k - 0.5, k, name="Acc_B").replace(".", ",", 1) for k in K)]
    record = read(tmp_path / "a.asc", lines)
    assert samples(record).tolist() == list(K)
    assert not record.notices
    record = read(tmp_path / "a.asc", [*lines, asc(1.0, 0, name="Other")])
    assert record.codes() == {"symbolic_names"}


@pytest.mark.promise("stamps that are differences", ".asc with relative times and other events", "added up")
def test_asc_relative_times_add_up_over_other_events(tmp_path: Path) -> None:
    lines = [ASC[0], "base hex  timestamps relative", ASC[2], asc(0, 0)]
    for k in K[1:]:
        lines += [" 0.006000 1  Statistic: D 0 R 0", asc(0.004 + (0.5 if k == 60 else 0), k)]
    assert [(gap.index, gap.count) for gap in read(tmp_path / "a.asc", lines).gaps] == [(60, 50)]


@pytest.mark.promise("two trigger blocks in an .asc", "stamps begin again at 0", "placed by their dates, said")
@pytest.mark.parametrize(("date", "lost"), [("Tue Nov 14 10:13:30.000 pm 2023", 940), ("somewhen", 99)])
def test_a_trigger_block_that_begins_anew_is_placed_by_its_date(date: str, lost: int, tmp_path: Path) -> None:
    lines = [*ASC, f"Begin Triggerblock {ASC[0][5:]}", *(asc(0.01 * k, k) for k in K[:60]), "End TriggerBlock"]
    lines += [f"Begin Triggerblock {date}", *(asc(0.01 * k, 60 + k) for k in range(60))]
    record = read(tmp_path / "a.asc", lines)
    assert record.samples == 120
    assert sum(gap.count for gap in record.gaps) == lost
    assert "trigger_blocks" in record.codes()


def test_dates_of_an_asc() -> None:
    late = when("Nov 14 10:13:20.000 pm 2023")
    assert late == when("Nov 14 22:13:20.000 2023") == when("Nov. 14 22:13:20 2023")
    assert late is not None
    assert when("Dez 14 22:13:20.5 2023") == pytest.approx(late + 30 * 86_400 + 0.5, abs=3601)
    assert when("nonsense") is None


def test_a_name_with_a_question_mark_is_a_name(tmp_path: Path) -> None:
    path = tmp_path / "what?.log"
    path.write_text("\n".join(PLAIN))
    assert parse_link(f"capture:{path}") == CaptureConfig(str(path))
    assert parse_link(f"capture:{path}?bus=can0") == CaptureConfig(str(path), bus="can0")
    assert parse_link("capture:gone.log?bus=1") == CaptureConfig("gone.log", bus="1")


def test_batches_hold_where_damage_was(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    path.write_text("\n".join([*PLAIN[:5], "junk", "junk", *PLAIN[5:9], "junk"]))
    (batch,) = candump_batches(path)
    assert np.flatnonzero(batch.holes).tolist() == [5, 9]
    assert batch.holes[[5, 9]].tolist() == [2, 1]
    even = np.arange(9) % 2 == 0
    assert batch.pick(even).holes.tolist() == [0, 0, 0, 2, 0, 1]
    front, back = batch.cut(5)
    assert (front.holes.sum(), back.holes.tolist()) == (0, [2, 0, 0, 0, 1])
    assert struct.unpack("<h", back.frames.payload[0, :2].tobytes()) == (5,)


@pytest.mark.promise("error frames and remote requests", "between the frames of a candump log", "no samples, no losses")
def test_error_frames_and_requests_are_no_samples(tmp_path: Path) -> None:
    stamp = [line.partition(" ")[0][:-4] + "3000)" for line in PLAIN]
    other = [f"{s} can0 {f}" for s in stamp[:3] for f in ("20000004#0000000000000000", "100#R4", "100#R")]
    assert samples(read(tmp_path / "a.log", PLAIN)).tolist() == list(K)
    mixed = [line for k, one in enumerate(PLAIN) for line in (one, *(other[3 * k : 3 * k + 3]))]
    assert samples(read(tmp_path / "a.log", mixed)).tolist() == list(K)


def test_fd_frames_in_decimal_with_a_name(tmp_path: Path) -> None:
    head = [line.replace("hex", "dec") for line in ASC]
    line = "{:.6f} CANFD   1 Rx        256  Acc_B      1 0 2  2 {} 0   130000  130   303000 e0006659 46500250"
    assert samples(read(tmp_path / "a.asc", [*head, *(line.format(0.01 * k, k) for k in K)])).tolist() == list(K)
