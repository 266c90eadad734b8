"""Good inputs of every target: where a fuzzer begins."""

from __future__ import annotations

import io
import json
import struct
import tempfile
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
from mat_variables import small_variables
from mf4_files import small_mf4s
from sessions import make_block, make_estimate, make_info, make_status, make_stream, write_log
from targets import _STARTS, ANSWER_PLACES, GOOD_ANSWER, ROOT, _chunk, _message

from daq.base.console.file_kinds import LOG_MAGIC
from daq.log import codec as codec
from daq.log import scan
from drivers.can.slcan_codec import encode_line
from drivers.contract.reading import Gap, Notice
from drivers.serial import cobs

_ROWS = np.arange(12.0).reshape(6, 2)
_PAIR = ("b1x", "b1y")  # the rig of the importers' target


def seeds(name: str) -> list[bytes]:
    """At least one."""
    return _MAKERS[name]()


def _cobs() -> list[bytes]:
    return [b"".join(cobs.encode(body) for _, body in _STARTS["serial16"]), cobs.encode(bytes(300))]


def _slcan() -> list[bytes]:
    fd = b"".join(encode_line(i, d, len(d) > 8) for i, d in _STARTS["fd16"])
    return [fd, b"".join(encode_line(i, d, False, stamp_ms=7) for i, d in _STARTS["classic"]), b"\rz\r\x07V1013\r"]


def _serial() -> list[bytes]:
    return [b"".join(bytes((len(body), 0x90)) + body for _, body in _STARTS["serial16"]), b"\x14\x00" + bytes(20)]


def _can() -> list[bytes]:
    out = []
    for k, layout in enumerate(("fd16", "fd24", "classic")):
        frames = [bytes((0x20 * (1 if len(d) == 64 else 0) | (i - 0x2FF),)) + d for i, d in _STARTS[layout]]
        out.append(bytes((k,)) + b"".join(frames))
    return out


PART_HEAD = b"\x02\x20"  # for the target "parts": from which sample on, and how many
LOG_HEAD = b"\0" + LOG_MAGIC  # for the target "mcap": a file


def _whole_log() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        write_log(path, make_stream(4, 20))
        return path.read_bytes()


def _mcap() -> list[bytes]:
    blocks = [
        (codec.RAW_CHANNEL, codec.encode_blocks([make_block(k, 4)])) for k in range(11, 60, 5)
    ]  # a hole after each
    messages = [(codec.GAP_CHANNEL, codec.encode_gap(Gap(4, 7, "crc"))), *_events(7), *blocks]
    return [b"\0" + _whole_log(), b"\2" + b"".join(bytes((c, len(d))) + d for c, d in messages)]


def _events(index: int) -> list[tuple[int, bytes]]:
    good = make_estimate(index)
    short = replace(good, parameters=dict(list(good.parameters.items())[::2]))  # a length of one byte
    return [
        (codec.ESTIMATE_CHANNEL, codec.encode_estimate(short)),
        (codec.STATUS_CHANNEL, codec.encode_status(make_status(index))),
        (codec.NOTICE_CHANNEL, codec.encode_notice(Notice(1, "info", "a", "b"), 5)),
    ]  # fmt: skip


def small_logs() -> list[bytes]:
    """What a log begins with, and many chunks of one or two messages; all that comes before the end."""
    raw = _whole_log()
    first = raw[len(LOG_MAGIC) : raw.index(scan.ZSTD_SIGNATURE) - scan.SIGNATURE_AT]
    start = [
        (codec.SESSION_CHANNEL, codec.encode_session("dev", 0, {})),
        (codec.INFO_CHANNEL, codec.encode_info(make_info())),
    ]
    chunks = [start + [(codec.RAW_CHANNEL, codec.encode_blocks([make_block(0, 4)]))]]
    for k in range(4, 400, 4):
        if k % 40 == 0:
            chunks += [[event] for event in _events(k)]
        gap = [(codec.GAP_CHANNEL, codec.encode_gap(Gap(k, 2, "crc")))] if k % 28 == 0 else []
        block = make_block(k + 2 * len(gap), 4 - 2 * len(gap))
        chunks.append([*gap, (codec.RAW_CHANNEL, codec.encode_blocks([block]))])
    return [LOG_HEAD + first + b"".join(_chunk(b"".join(_message(c, d) for c, d in chunk)) for chunk in chunks)]


def tiny_logs() -> list[bytes]:
    """Whole logs of a chunk or two, an attachment and a footer: the time goes with the length."""
    start = [
        (codec.SESSION_CHANNEL, codec.encode_session("dev", 0, {})),
        (codec.INFO_CHANNEL, codec.encode_info(make_info())),
    ]
    block = (codec.RAW_CHANNEL, codec.encode_blocks([make_block(0, 4)]))
    gap, more = (
        (codec.GAP_CHANNEL, codec.encode_gap(Gap(4, 2, "crc"))),
        (codec.RAW_CHANNEL, codec.encode_blocks([make_block(6, 4)])),
    )
    one = _chunk(b"".join(_message(c, d) for c, d in [*start, block, gap, more, *_events(9)]))
    two = _chunk(b"".join(_message(c, d) for c, d in [*start, block]))
    rest = _chunk(b"".join(_message(c, d) for c, d in [gap, more]))
    rig = bytes(16) + b"\x08\0\0\0rig.toml\x01\0\0\0t" + struct.pack("<Q", 10) + b"schema = 1"
    rig += struct.pack("<I", zlib.crc32(rig))
    attached = scan.RECORD_STRUCT.pack(scan.ATTACHMENT_OPCODE, len(rig)) + rig
    return [_closed(LOG_HEAD + one), _closed(LOG_HEAD + attached + two + rest), LOG_HEAD + two + rest]


def _closed(log: bytes) -> bytes:
    """With a footer, and an index that says nothing."""
    footer = scan.RECORD_STRUCT.pack(scan.FOOTER_OPCODE, 20) + struct.pack("<QQ", len(log) - 1, 0)
    return log + footer + struct.pack("<I", zlib.crc32(footer)) + LOG_MAGIC


def log_ends() -> list[bytes]:
    """Index and footer."""
    raw = _whole_log()
    data_end = scan.RECORD_STRUCT.pack(0x0F, 4)
    return [raw[raw.index(data_end) :], raw[-37:]]


def _rig() -> list[bytes]:
    return [path.read_bytes() for path in sorted((ROOT / "configs").glob("*.toml"))] + [_CUSTOM]


def small_rigs() -> list[bytes]:
    """A table or two each, since the time goes with the length."""
    start = b"schema = 1\n[band]\nlow = 20\nhigh = 900.0\n"
    cap = b'[[channel]]\nname = "b1x"\nnode = "bearing1"\ndirection = "x"\nkind = "acceleration"\nunit = "g"\n'
    spare = b'[[channel]]\nname = "f"\nnode = "bearing1"\ndirection = "y"\nkind = "force"\nunit = "N"\n'
    return [start + cap + part for part in (spare, *_TABLES)]


_TABLES: tuple[bytes, ...] = (
    b"[acquisition]\nrate_hz = 2e4\nfull_scale = 50\nnoise = 0.1\n",
    b'[rig]\nname = "a"\nshaft = "none"\nspeed_rpm = 900.5\nmass = { disc = 2.0, bearing1 = { x = 1, y = 1.5 } }\n',
    b"[rig.bearing]\nballs = 8\nball_diameter_mm = 4.8\npitch_diameter_mm = 19\ngroove_radius_mm = 2.5\n",
    b"[model.linear.bearing1.x]\nkL = { value = 1e7, min = 1, max = 1e9 }\nc = 20\nS = 0.1\n",
    b'[model]\neffects = ["quintic", "cubic"]\n[model.cubic]\nat = ["bearing1.x"]\nkNL = { value = 1e9, min = 0 }\n',
    b'[[model.custom]]\nname = "s"\nexpression = "k*x**3"\nparameters = { k = { value = 1e6, unit = "N/m^3" } }\n',
    b'[link]\nurl = "can:socketcan:can0"\nsignals = { b1x = "M.a" }\ndbc = "a.dbc"\n',
    b'[estimator]\nmethod = "spectral"\n',
)

RIG_HEAD = b"schema = 1\n"


def rig_tables() -> list[bytes]:
    """All that may stand together in one file, each by itself."""
    band = b"[band]\nlow = 20\nhigh = 900.0"
    channel = b'[[channel]]\nname = "%b%b"\nnode = "%b"\ndirection = "%b"\nkind = "%b"\nunit = "%b"'
    kinds = ((b"acceleration", b"g"), (b"force", b"N"), (b"displacement", b"um"))
    channels = [
        channel % (node, axis, node, axis, *kind)
        for kind in kinds for node in (b"bearing1", b"bearing2") for axis in (b"x", b"y")
    ]  # fmt: skip
    effects = [b"[model.%b]\nvalue = 1e3\nmin = 0\nfixed = false" % name for name in (b"quintic", b"clearance")]
    effects += [b"[model.hertz.bearing1.x]\nkH = { value = 1e9, min = 1, max = 1e12 }\npreload = 1e-6"]
    settings = b"kL = { value = 1e7, min = 1, max = 1e9, fixed = true }\nc = 20\nS = 0.1"
    linear = [b"[model.linear.bearing%b]\n%b" % (place, settings) for place in (b"1.x", b"1.y", b"2.x", b"2.y")]
    law = b'[[model.custom]]\nname = "%b"\nexpression = "k*x**3"\nparameters = { k = { value = 1e6, unit = "N/m^3" } }'
    once = [table.strip() for table in _TABLES if b"custom" not in table and b"linear" not in table]
    return [band, *channels, *effects, *linear, *once, *(law % name for name in (b"s", b"t", b"u", b"v"))]


_CUSTOM = b"""schema = 1
[band]
low = 20.0
high = 900
[model]
effects = ["hertz", "cubic"]
[model.cubic]
at = ["bearing1.x"]
kNL = { value = 1e12, min = 0, fixed = true }
[[model.custom]]
name = "soft_stop"
expression = "k*maximum(x - g, 0)"
parameters = { k = { value = 1e6, unit = "N/m" }, g = { value = 1e-7, unit = "m" } }
[[channel]]
name = "b1x"
node = "bearing1"
direction = "x"
kind = "acceleration"
unit = "g"
[link]
url = "can:socketcan:can0"
signals = { b1x = "M.a" }
"""


def _expression() -> list[bytes]:
    return [
        b"k*maximum(x - g, 0)", b"k*where(abs(x) > g, x**3, 0) if v >= 0 else -square(g)*sin(2*pi*t + phase)",
        b"k*hypot(x, xo)**2.5 // g % 3 - power(v, 2) and not x", b"__import__('os').system('true')*k*g*x",
    ]  # fmt: skip


def _csv() -> list[bytes]:
    lines = ["time,b1x,b1y"] + [f"{k / 25600:.9f},{k},-2.5e3" for k in range(6)]
    return ["\n".join(lines).encode(), b"# x\nb1x [g];b1y;b2x\n1;2;3\n5;6;nan\n", b"b1y\tb1x\nnan\tnan\n1\t2\n3\t4\n"]


def _lvm() -> list[bytes]:
    head = "LabVIEW Measurement\nSeparator\tTab\nDecimal_Separator\t{}\nX_Columns\t{}\n***End_of_Header***\n\n"
    head += "Channels\t2\nDate\t2023/11/14\t2023/11/14\nTime\t22:13:20\t22:13:20\nY_Unit_Label\tg\tmg\n"
    head += "X0\t0\t0\nDelta_X\t3.90625E-5\t3.90625E-5\n***End_of_Header***\n"
    no = "X_Value\tb1x\tb1y\tComment\n" + "".join(f"\t{k},5\t-2\n" for k in range(4))
    one = "X_Value\tb1x\tb1y\n" + "".join(f"{k / 25600:.9f}\t{k}\t-2.5e3\n" for k in range(6))
    return [(head.format(",", "No") + no).encode(), (head.format(".", "One") + one).encode()]


def _npz() -> list[bytes]:
    out = []
    for save in (np.savez, np.savez_compressed):
        buffer = io.BytesIO()
        save(buffer, rate_hz=25600.0, **{n: _ROWS[:, k] for k, n in enumerate(_PAIR)})
        out.append(buffer.getvalue())
    return out


def _answer() -> list[bytes]:
    """A status and what comes with it, see targets.py."""
    out = [b"\5\nfull", b"\3\ntruncated", b"\4\nb1y was not sampled at the same times as b1x; resample them"]
    for extra in ({"rate": np.array(25600.0)}, {"time": np.arange(6) / 25600}):
        buffer = io.BytesIO()
        columns = {f"column {k}": _ROWS[:, k] for k in range(2)}
        names, units = (np.frombuffer(json.dumps(v).encode(), np.uint8) for v in (_PAIR, {"b1x": "g"}))
        np.savez(buffer, names=names, units=units, **columns, **extra)
        out += [b"\0" + buffer.getvalue()] * 3
    return out


def _wav() -> list[bytes]:
    from scipy.io import wavfile

    out = []
    for kind in (np.int16, np.int32, np.float32):
        buffer = io.BytesIO()
        wavfile.write(buffer, 25600, _ROWS.astype(kind))
        out.append(buffer.getvalue())
    return out


def _mat() -> list[bytes]:
    from scipy.io import savemat

    out = []
    for options in ({"format": "4"}, {}, {"do_compression": True}):
        buffer = io.BytesIO()
        values = {n: _ROWS[:, k] for k, n in enumerate(_PAIR)}
        savemat(buffer, values | {"rate_hz": 25600.0}, **options)  # type: ignore[arg-type]
        out.append(buffer.getvalue())
    return out


def _file(pattern: str, write: object = None) -> list[bytes]:
    return [path.read_bytes()[:20_000] for path in sorted((ROOT / "tests" / "data").glob(pattern))] or [b""]


def _uff() -> list[bytes]:
    both = b"".join(_set_58(name, column) for name, column in zip(_PAIR, _ROWS.T, strict=True))
    return [both, both[: len(both) // 2]]


def _uff_sets() -> list[bytes]:
    """Of each kind of number, even and not, as text and not."""
    column = _ROWS[:, 0]
    texts = [_set_58("b1x", column + (1j if kind > 4 else 0), kind, even) for kind in (2, 4, 5, 6) for even in (0, 1)]
    return [b"".join(texts), *(_set_58("b1x", column, 4, even, binary=1) for even in (0, 1))]


def _set_58(name: str, column: np.ndarray, kind: int = 4, even: int = 1, binary: int = 0) -> bytes:
    import pyuff

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.uff"
        data = pyuff.prepare_58(
            binary=binary, func_type=1, ver_num=1, load_case_id=0, rsp_ent_name=name, rsp_node=1, rsp_dir=1,
            ref_ent_name="NONE", ref_node=0, ref_dir=0, data=column, x=np.arange(6) / 25600, id1=name,
            id2="", id3="", id4="", id5="", ord_data_type=kind, orddenom_spec_data_type=0, z_axis_spec_data_type=0,
            abscissa_spacing=even, abscissa_min=0.0, abscissa_inc=1 / 25600, num_pts=6,
        )  # fmt: skip
        pyuff.UFF(str(path)).write_sets(data, mode="add")
        return path.read_bytes()


def _npz_members() -> list[bytes]:
    """Columns of some types, a shape and a layout that are none, a text, an empty one."""
    column = _ROWS[:, 0]
    values = [column, column.astype("<f4"), column.astype("<i2"), column.astype(">i4"), column[:, None], column[:0]]
    values += [np.asfortranarray(_ROWS), np.array(["a", "bc"]), np.array(25600.0), column + 1j, column > 2]
    return [b"".join(map(_behind_length, map(_npy, values)))]


def _answer_members() -> list[bytes]:
    """Of those of a good answer some more often than others: names and units are ours to read, and so is a rate."""
    more = [
        ("names", b'["b1y", "b1x"]'), ("names", b'["b1x", 7]'), ("names", b'{"b1x": 1, "b1y": [1e999]}'),
        ("names", b'"b1"'), *(("about", b'{"units": %s, "rates": [], "time": "time", "started": null}' % units)
          for units in (b'{"b1y": "m/s^2"}', b'{"b1x": null, "b1y": {}}', b"[]")),
        *(("about", b'{"units": {}, "rates": %s, "time": "t_ms", "started": %s}' % about)
          for about in ((b'[["fs", 25600]]', b"0"), (b'[["fs", 1], ["dt", 0]]', b'"2024-05-31"'), (b"{}", b"[]"))),
    ]  # fmt: skip
    texts = [(place, np.frombuffer(text, np.uint8)) for place, text in more]
    times = [("time", np.arange(6)), ("time", np.array([7], "M8[ns]")), ("time", np.array([[2.56e4]], ">f4"))]
    members = [*GOOD_ANSWER.items(), *texts, *times]
    return [b"".join(_behind_length(bytes((ANSWER_PLACES.index(place),)) + _npy(v)) for place, v in members)]


def _npy(value: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, value)
    return buffer.getvalue()


def _behind_length(data: bytes) -> bytes:
    return len(data).to_bytes(2, "little") + data


def _mf4can() -> list[bytes]:
    import can

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mf4"
        writer = can.MF4Writer(path, database=None)
        for k, (identifier, data) in enumerate(_STARTS["classic"][:6]):
            writer.on_message_received(can.Message(timestamp=1.7e9 + k, arbitration_id=identifier, data=data))
        writer.stop()
        return [path.read_bytes()]


def _mf4() -> list[bytes]:
    from asammdf import MDF, Signal

    t = np.arange(6) / 25600
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mf4"
        with MDF() as file:
            file.append([Signal(_ROWS[:, k], t, name=n, unit="g") for k, n in enumerate(_PAIR)])
            file.save(path, compression=1)
        return [path.read_bytes()]


def _blf() -> list[bytes]:
    """The start of a real one; and two frames behind a packed and a bare container's head."""
    import can

    buffer = io.BytesIO()
    buffer.close = lambda: None  # type: ignore[method-assign]
    writer = can.BLFWriter(buffer)
    for identifier, data in _STARTS["fd16"][:2]:
        message = can.Message(timestamp=1.7e9, arbitration_id=identifier, data=data, is_fd=len(data) > 8)
        writer.on_message_received(message)
    writer.stop()
    packed = buffer.getvalue()
    size = int.from_bytes(packed[152:156], "little")  # of the container, behind the file's head of 144 bytes
    objects = zlib.decompress(packed[176 : 144 + size])
    bare = packed[:152] + struct.pack("<II", 32 + len(objects), 10) + struct.pack("<H6xI4x", 0, len(objects)) + objects
    return [*_file("canedge_imu/*.blf"), packed, bare]


BLF_HEAD = struct.pack("<4sI136x", b"LOGG", 144)


def blf_containers() -> list[bytes]:
    """Packed and bare, of an object or two; the last begins an object that the one behind it may end."""
    _, packed, bare = _blf()
    objects = bare[176:]
    size = int.from_bytes(objects[8:12], "little")
    pieces = [objects[:size], objects[size:], objects, objects[: size + 40]]
    alone = [struct.pack("<4sHHIIH6xI4x", b"LOBJ", 16, 1, 32 + len(p), 10, 0, len(p)) + p for p in pieces]
    return [packed[144:], bare[144:], *alone]


_ASC_HEAD = b"date Mon Jan 1 00:00:00 2024\nbase hex timestamps absolute\ninternal events logged\n"
_ASC = (
    b" 0.1 1 300 Rx d 8 00 01 02 03 04 05 06 07\n",
    b" 0.2 CANFD 1 Rx 301 1 0 9 12 00 01 02 03 04 05 06 07 08 09 0a 0b\n",
    b" 0.3 1 18FF0001x Rx r 8\n",
    b" 0.4 1 ErrorFrame\n",
)
_MAKERS = {
    "cobs": _cobs, "slcan": _slcan, "serial": _serial, "can": _can, "mapped": lambda: [bytes(range(60))],
    "devices": lambda: [bytes.fromhex("5551000100020003c409ac"), b"0.1, 0.2\n0.3, 0.4\n0.5, 0.6\n"],
    "parts": lambda: [PART_HEAD + data for data in _mcap()],
    "mcap": _mcap, "recover": _mcap, "rig": _rig, "expression": _expression, "csv": _csv, "lvm": _lvm,
    "npz": _npz, "wav": _wav,
    "npz-members": _npz_members, "answer-members": _answer_members, "uff-sets": _uff_sets,
    "mat": _mat, "uff": _uff, "mf4": _mf4, "mf4can": _mf4can, "answer": _answer, "mat-parse": _mat, "mf4-parse": _mf4,
    "mat-variables": lambda: [b"".join(map(_behind_length, small_variables()))],
    "mf4-files": lambda: [b"".join(map(_behind_length, small_mf4s()))],
    "candump": lambda: _file("canedge_imu/*.log"), "blf": _blf,
    "asc": lambda: [_ASC_HEAD + b"".join(_ASC)],
}  # fmt: skip
