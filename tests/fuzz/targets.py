"""One function per thing that reads foreign bytes: it must return, whatever the bytes, or raise what it documents.

Shared by run.py (atheris, millions of inputs) and test_fuzz.py (hypothesis and the kept cases, in the default suite).
Each target takes bytes and a scratch folder; the folder is all that may be written to (see guard.py).
"""

from __future__ import annotations

import contextlib
import io
import os
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import zstandard
from parsers import Parser, members
from ramp_device import CHANNELS, ramp_device

from daq.base.console.file_kinds import LOG_MAGIC
from daq.base.contract.errors import ConfigError, LogError
from daq.base.contract.part import Part
from daq.exchange import child, formats, uff_file
from daq.exchange.checks import checked
from daq.exchange.columns import Columns
from daq.exchange.formats import read
from daq.log import scan
from daq.log.reader import read_log
from daq.log.recover import recover
from daq.rig.rig import Rig, load_rig
from drivers.can.can_decoder import CanDecoder
from drivers.can.can_frames import EXTENDED_FLAG, CanFrames
from drivers.can.slcan_codec import MAX_LINE, SlcanCodec, encode_line
from drivers.contract.errors import LinkError
from drivers.contract.link_config import CaptureConfig
from drivers.contract.reading import Block, Gap, LinkStats, Reading
from drivers.devices import DEVICE_PROFILES, PacketDecoder
from drivers.foreign.capture import Capture
from drivers.foreign.capture_files import open_capture
from drivers.foreign.mapped import MappedDecoder
from drivers.links.slcan import SlcanDecoder
from drivers.serial import cobs
from drivers.serial.serial_decoder import SerialDecoder
from estimator.effects.engine.expression import compile_law
from estimator.errors import ModelError

ROOT = Path(__file__).parents[2]
RIG = load_rig(ROOT / "configs" / "tiwari_vyas_1997.toml")
PAIR = Rig.parse("""\
schema = 1
[acquisition]
rate_hz = 25600.0
full_scale = 50.0
[band]
low = 20.0
high = 900.0
[[channel]]
name = "b1x"
node = "bearing1"
direction = "x"
kind = "acceleration"
unit = "g"
[[channel]]
name = "b1y"
node = "bearing1"
direction = "y"
kind = "acceleration"
unit = "g"
""")  # small files are cheap: what is imported has two channels
GOOD_ANSWER = {
    "names": np.frombuffer(b'["b1x", "b1y"]', np.uint8),
    "about": np.frombuffer(b'{"units": {"b1x": "g"}, "rates": [], "time": "time", "started": null}', np.uint8),
    "column 0": np.arange(6.0), "column 1": np.arange(6.0), "time": np.arange(6) / 25_600,
}  # fmt: skip
ANSWER_PLACES = tuple(GOOD_ANSWER)
ONE = Rig.parse(PAIR.text[: PAIR.text.rindex("[[channel]]")])
Target = Callable[[bytes, Path], None]


def _start(layout: str) -> list[tuple[int, bytes]]:
    frames = ramp_device(layout, 8000.0 if layout == "classic" else 25_600.0, None, rows=16).next(4)
    return [(f.identifier, f.data) for f in frames]


_STARTS = {layout: _start(layout) for layout in ("serial16", "fd16", "fd24", "classic")}


def assert_axis(readings: list[Reading], at: int) -> int:
    """Every sample in one block or one gap, in order; the index that follows."""
    for reading in readings:
        if isinstance(reading, Block):
            assert reading.index == at
            at += len(reading.counts)
        elif isinstance(reading, Gap):
            assert reading.index == at
            assert reading.count > 0
            at += reading.count
    return at


def cobs_codec(data: bytes, folder: Path) -> None:
    """Any cut gives the same bodies, and the decoder keeps no more than a frame."""
    cut = data[0] * len(data) // 256 if data else 0
    parts, one = cobs.Deframer(), cobs.Deframer()
    pieces = [parts.feed(data[:cut]), parts.feed(data[cut:])]
    whole = one.feed(data)
    assert len(parts._tail) <= cobs.MAX_FRAME
    assert sum(len(p.stops) for p in pieces) == len(whole.stops)
    assert b"".join(_bodies(p) for p in pieces) == _bodies(whole)


def _bodies(found: cobs.Bodies) -> bytes:
    good = [(a, b) for a, b in zip(found.starts.tolist(), found.stops.tolist(), strict=True) if b >= 0]
    return b"".join(found.data[a:b].tobytes() + b"|" for a, b in good)


def slcan(data: bytes, folder: Path) -> None:
    """Any cut gives the same frames; and behind a good start, as a device's lines, through to the samples."""
    cut = data[0] * len(data) // 256 if data else 0
    parts, one = SlcanCodec(), SlcanCodec()
    a, b, whole = parts.feed(data[:cut], 0), parts.feed(data[cut:], 0), one.feed(data, 0)
    assert len(parts._tail) <= MAX_LINE
    assert [*a.frames.ids, *b.frames.ids] == [*whole.frames.ids]
    assert a.frames.payload.tobytes() + b.frames.payload.tobytes() == whole.frames.payload.tobytes()
    layout = "classic" if cut % 2 else "fd16"
    decoder = SlcanDecoder(CanDecoder(LinkStats(), unchecked=True))
    start = b"".join(encode_line(i, d, len(d) > 8) for i, d in _STARTS[layout])
    at = assert_axis(decoder.feed(start, 0), 0)
    at = assert_axis(decoder.feed(data[:cut], 20_000_000), at)
    assert_axis(decoder.feed(data[cut:], 40_000_000), at)


def devices(data: bytes, folder: Path) -> None:
    """Each device of others: any cut of its packets, through to the samples."""
    cut = data[0] * len(data) // 256 if data else 0
    for profile in DEVICE_PROFILES.values():
        inner = MappedDecoder(LinkStats(), profile.dbc, {"b1x": profile.signals[0]}, rate_hz=100.0)
        decoder, at = PacketDecoder(inner, profile.make()), 0
        for k, part in enumerate((data[:cut], data[cut:], data)):
            at = assert_axis(decoder.feed(part, k * 20_000_000), at)


def serial(data: bytes, folder: Path) -> None:
    """Bodies with right check sums and any content, cut by lengths in the data; then plain bytes."""
    decoder = SerialDecoder(LinkStats())
    first = b"".join(cobs.encode(body) for _, body in _STARTS["serial16"])
    at = assert_axis(decoder.feed(first, 0), 0)
    t_ns, start, wire = 1_000_000, 0, b""
    while start < len(data):
        length, kind = data[start], data[start + 1] if start + 1 < len(data) else 0
        body = data[start + 2 : start + 2 + length]
        start += 2 + length
        t_ns += 1_000_000 * (1 + length)
        if kind < 0x80 and body:  # a sample frame of the right shape, with a hostile head
            body = b"\1\1\4" + body[:1].ljust(1, b"\1") + (body[1:].ljust(20, b"\0"))[:20] + bytes(8 * (body[0] or 1))
        wire += cobs.encode(body) if kind < 0xF0 else body
        if kind & 1 or start >= len(data):  # else one read brings more than one frame
            at, wire = assert_axis(decoder.feed(wire, t_ns), at), b""


def can_decoder(data: bytes, folder: Path) -> None:
    """Frames of any identifier and content behind a good start, in each layout."""
    layout = ("fd16", "fd24", "classic")[data[0] % 3] if data else "fd16"
    decoder = CanDecoder(LinkStats())
    good = [(i, d, 0) for i, d in _STARTS[layout]]
    at = assert_axis(decoder.feed(CanFrames.build(good), 0), 0)
    t_ns, start, frames = 1_000_000, 1, list[tuple[int, bytes, int]]()
    while start < len(data):
        head, more = data[start], data[start + 1] if start + 1 < len(data) else 0
        length = (8, 64, 12, 64, 8, 64, more % 65, 64)[head >> 5]
        payload = data[start + 1 : start + 1 + length]
        start += 1 + length
        t_ns += 1_000_000 << (head & 15)
        frames.append((0x2FF + head % 8, payload.ljust(length, b"\0"), t_ns))
        if not head & 16 or start >= len(data):  # else one read brings more than one frame
            at, frames = assert_axis(decoder.feed(CanFrames.build(frames), t_ns), at), []


_DBC = b"""VERSION ""
BU_: A
BO_ 256 M: 8 A
 SG_ a : 0|16@1- (0.01,0) [0|0] "m/s^2" A
 SG_ b : 16|32@1- (1,0) [0|0] "" A
 SG_ c : 55|16@0+ (0.5,-3) [0|0] "" A
BO_ 512 N: 8 A
 SG_ d : 0|64@1- (1,0) [0|0] "" A
SIG_VALTYPE_ 256 b : 1;
"""


def mapped(data: bytes, folder: Path) -> None:
    """Other makers' frames: any content, any times."""
    decoder = MappedDecoder(LinkStats(), _DBC, {"b1x": "M.a", "b1y": "M.b", "b2x": "M.c"}, rate_hz=100.0)
    frames, t_ns = [], 0
    for k in range(0, len(data), 10):
        step, piece = data[k : k + 2], data[k + 2 : k + 10]
        t_ns += int.from_bytes(step, "little", signed=True) << (12 if len(step) > 1 and step[1] & 1 else 22)
        frames.append((256 if k % 30 else (512 | EXTENDED_FLAG), piece, t_ns))
    at = 0
    for part in (frames[: len(frames) // 2], frames[len(frames) // 2 :]):
        at = assert_axis(decoder.feed(CanFrames.build(part), 0, final=part is not frames), at)


def _log(data: bytes, path: Path) -> None:
    """A file of any bytes; or any records behind a right check sum; or any messages in right records."""
    kind, rest = (data[0] % 3, data[1:]) if data else (0, b"")
    if kind == 0:
        path.write_bytes(rest)
    else:
        path.write_bytes(LOG_MAGIC + _chunk(rest if kind == 1 else b"".join(_records(rest))))


def recover_log(data: bytes, folder: Path) -> None:
    """What is recovered is a complete log, and says of every sample what the damaged one says."""
    path, mended = folder / "a.mcap", folder / "b.mcap"
    _log(data, path)
    mended.unlink(missing_ok=True)
    with contextlib.suppress(LogError):
        told = recover(path, mended)
        before, after = read_log(path), read_log(mended)
        assert after.complete, after.damage
        assert (after.first, after.stop, after.n_samples) == (before.first, before.stop, before.n_samples)
        assert told.samples == before.n_samples
        assert after.notices[-1].code == "recovered"
        with contextlib.suppress(LogError):
            assert np.array_equal(before.counts(), after.counts())


def mcap(data: bytes, folder: Path) -> None:
    path = folder / "a.mcap"
    _log(data, path)
    with contextlib.suppress(LogError):
        log = read_log(path)
        with contextlib.suppress(LogError):
            counts, samples = log.counts(), log.samples()
            assert len(counts) == len(samples) == log.stop - log.first
        at = None
        for reading in log.readings():
            if isinstance(reading, Block | Gap) and not (isinstance(reading, Gap) and not reading.count):
                assert at is None or reading.index >= at
                at = reading.index + (len(reading.counts) if isinstance(reading, Block) else reading.count)
        for reading in log.readings(joined=False):
            assert not isinstance(reading, Block) or len(reading.counts) > 0


def parts(data: bytes, folder: Path) -> None:
    """A part of a log, of whatever the first bytes say; what is there lies in the part."""
    path, (start, length) = folder / "a.mcap", ((*data[:2], 0, 0))[:2]
    _log(data[2:], path)
    with contextlib.suppress(LogError, ConfigError):
        log = read_log(path, part=Part(from_s=start / 2e4, seconds=(1 + length) / 2e4))
        with contextlib.suppress(LogError):
            assert len(log.counts()) == len(log.samples()) == log.stop - log.first
        blocks = [reading for reading in log.readings(joined=bool(length % 2)) if isinstance(reading, Block)]
        assert all(log.first <= b.index and b.index + len(b.counts) <= log.stop for b in blocks)


def _chunk(records: bytes) -> bytes:
    packed = zstandard.compress(records)
    head = scan.CHUNK_HEAD.pack(0, 0, len(records), zlib.crc32(records), 4, b"zstd")
    content = head + scan.SIZE_STRUCT.pack(len(packed)) + packed
    return scan.RECORD_STRUCT.pack(scan.CHUNK_OPCODE, len(content)) + content


def _records(data: bytes) -> Iterator[bytes]:
    """The session's opening messages, then messages with the data's channel numbers, lengths and content."""
    from sessions import make_block, make_info

    from daq.log import codec as codec

    yield _message(codec.SESSION_CHANNEL, codec.encode_session("dev", 0, {}))
    yield _message(codec.INFO_CHANNEL, codec.encode_info(make_info()))
    yield _message(codec.RAW_CHANNEL, codec.encode_blocks([make_block(0, 4)]))
    while data:
        channel, length, data = data[0] % 9, (data[1] if len(data) > 1 else 0), data[2:]
        yield _message(channel, data[:length])
        data = data[length:]


def _message(channel: int, data: bytes) -> bytes:
    return scan.RECORD_STRUCT.pack(scan.MESSAGE_OPCODE, 22 + len(data)) + struct.pack("<HIQQ", channel, 0, 0, 0) + data


def rig(data: bytes, folder: Path) -> None:
    with contextlib.suppress(ConfigError):
        Rig.parse(data.decode("utf-8", "replace"), folder)


_HARMLESS = {"math", "_power", "_square", "_sign", "_heaviside", "_clip", "_where", "float", "abs", "max", "min"}


def expression(data: bytes, folder: Path) -> None:
    """What is let through is called: it can only be arithmetic."""
    with contextlib.suppress(ModelError):
        law, used = compile_law.__wrapped__(data.decode("utf-8", "replace"), ("k", "g"))
        assert set(law.__code__.co_names) <= _HARMLESS | set(dir(__import__("math"))), law.__code__.co_names
        assert used <= {*"xvt", "xo", "vo", "phase", "k", "g", "pi", "e"}
        with contextlib.suppress(ArithmeticError, ValueError, TypeError):  # plain Python is stricter than compiled code
            value = law(0.5, -2.0, 0.25, 1.0, 3.0, 0.1, 1.0, np.array([2.0, 0.5]))
            assert isinstance(value, float)


def _put(data: bytes, path: Path) -> None:
    """write_bytes at a third of the time."""
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    try:
        assert os.write(fd, data) == len(data)
    finally:
        os.close(fd)


def _import(suffix: str) -> Target:
    def target(data: bytes, folder: Path) -> None:
        path = folder / f"a{suffix}"
        _put(data, path)
        rate_hz = None if len(data) % 4 == 2 else 25_600.0
        with contextlib.suppress(LogError):
            record = checked(path, read(path, ("b1x", "b1y")), PAIR, rate_hz, lambda text: None, bool(len(data) % 2))
            assert record.si().shape == (record.samples, 2)

    return target


def _array(data: bytes) -> np.ndarray:
    """A member as numpy has it of an archive."""
    if not data.startswith(np.lib.format.MAGIC_PREFIX):
        return data  # type: ignore[return-value]
    return np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)


def npz_members(data: bytes, folder: Path) -> None:
    """Members of an archive, each read by itself."""
    path = folder / "a.npz"
    for member in members(data):
        _alone(path, lambda member=member: formats.of_npz(path, {"m": _array(member)}, ("m",)))


def answer_members(data: bytes, folder: Path) -> None:
    """Members of answers of the process that reads .mat and .mf4: each in a good one, where its first byte says."""
    path = folder / "a.mf4"
    for member in members(data):
        place = ANSWER_PLACES[member[0] % len(ANSWER_PLACES)] if member else "time"
        columns = _columns(lambda: formats.of_answer(path, GOOD_ANSWER | {place: _array(member[1:])}))  # noqa: B023
        if columns is not None:
            _check(path, columns, PAIR, None)


def uff_sets(data: bytes, folder: Path) -> None:
    """A file of data sets 58, each read by itself."""
    import pyuff

    path = folder / "a.uff"
    _put(data, path)
    try:
        file = pyuff.UFF(str(path))
        kinds = file.get_set_types()
    except Exception:  # noqa: BLE001 - import_formats tells it, whatever it is
        return
    for k in np.flatnonzero(kinds == 58).tolist():
        _alone(path, lambda k=k: uff_file.of_uff(path, [file.read_sets(k)], ("b1x",)))


def _columns(read_one: Callable[[], Columns]) -> Columns | None:
    try:
        return read_one()
    except Exception:  # noqa: BLE001 - import_formats.read tells it, whatever it is
        return None


def _alone(path: Path, read_one: Callable[[], Columns]) -> None:
    """The first column of what is read, as the only channel."""
    columns = _columns(read_one)
    if columns is not None:
        values = {"b1x": next(iter(columns.values.values()))}
        rate_hz = 25_600.0 if columns.rate_hz is None else None
        _check(path, replace(columns, values=values, units={}), ONE, rate_hz)


def _check(path: Path, columns: Columns, rig: Rig, rate_hz: float | None) -> None:
    with contextlib.suppress(LogError):
        record = checked(path, columns, rig, rate_hz, lambda text: None)
        assert record.si().shape == (record.samples, len(rig.model.channels))


def _answered(path: Path, names: Sequence[str]) -> Columns:
    """A file of a status, and what the process that reads .mat and .mf4 said or wrote with it."""
    data, out = path.read_bytes(), path.with_suffix(".npz")
    status = (
        (0, 0, 0, child.REFUSED_STATUS, child.UNUSABLE_STATUS, child.NO_MEMORY_STATUS, 1, -11)[data[0] % 8]
        if data
        else 0
    )
    out.write_bytes(data[1:])
    return formats.answered(path, out, status, data[1:].decode("utf-8", "replace"))


formats.READER_OF_SUFFIX[".answer"] = _answered


def _parse(suffix: str) -> Target:
    """The library, and what comes of its answer; with a child process that lives on."""
    imported = _import(".answer")

    def target(data: bytes, folder: Path) -> None:
        path, out = folder / f"b{suffix}", folder / "c.npz"
        _put(data, path)
        status = PARSER.parse(path, out)
        if status == 0:
            imported(b"\0" + out.read_bytes(), folder)

    return target


def _parse_parts(suffix: str) -> Target:
    """Parts of such files, see parts.py, in the same way; what comes of each is checked in there."""

    def target(data: bytes, folder: Path) -> None:
        path = folder / f"d{suffix}"
        _put(data, path)
        PARSER.parse_parts(path, sum(1 for _ in members(data)))

    return target


PARSER = Parser()


FOREIGN_DBC = b'VERSION ""\nNS_ :\nBS_:\nBU_: d\nBO_ 768 Acc: 8 d\n SG_ X : 0|16@1- (0.01,0) [0|0] "m/s^2" d\n'


def _capture(suffix: str) -> Target:
    def target(data: bytes, folder: Path) -> None:
        path = folder / f"a{suffix}"
        _put(data, path)
        with contextlib.suppress(LinkError):
            driver = Capture(CaptureConfig(str(path)), LinkStats(), FOREIGN_DBC, {"x": "Acc.X"}, expected=None)
            with contextlib.suppress(LinkError):
                driver.open()
            driver.close()
            decoder = CanDecoder(LinkStats())
            for batch in open_capture(str(path), {"Acc": 0x300}):
                assert batch.damaged >= 0
                assert len(batch.holes) == len(batch.frames) + 1
                decoder.feed(batch.frames, 0)

    return target


TARGETS: dict[str, Target] = {
    "cobs": cobs_codec, "slcan": slcan, "serial": serial, "can": can_decoder, "mapped": mapped, "mcap": mcap,
    "recover": recover_log, "devices": devices,
    "parts": parts, "lvm": _import(".lvm"),
    "rig": rig, "expression": expression, "csv": _import(".csv"), "npz": _import(".npz"),
    "npz-members": npz_members, "uff-sets": uff_sets, "wav": _import(".wav"),
    "mat": _import(".mat"), "uff": _import(".uff"), "mf4": _import(".mf4"),
    "answer": _import(".answer"), "answer-members": answer_members,
    "mat-parse": _parse(".mat"), "mf4-parse": _parse(".mf4"),
    "mat-variables": _parse_parts(".mats"), "mf4-files": _parse_parts(".mf4s"),
    "candump": _capture(".log"), "blf": _capture(".blf"), "asc": _capture(".asc"), "mf4can": _capture(".mf4"),
}  # fmt: skip
assert tuple(c.name for c in RIG.model.channels) == CHANNELS
