"""Good inputs of every target: where a fuzzer begins."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from targets import _STARTS, CHANNELS, ROOT

from drivers import cobs
from drivers.slcan_codec import encode_line

_ROWS = np.arange(40.0).reshape(10, 4)


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


def _mcap() -> list[bytes]:
    import tempfile
    from dataclasses import replace

    from sessions import make_block, make_estimate, make_status, make_stream, write_log

    from daq import log_codec as codec
    from drivers.reading import Gap, Notice

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        write_log(path, make_stream(4, 20))
        raw = path.read_bytes()
    good = make_estimate(7)
    short = replace(good, parameters=dict(list(good.parameters.items())[::2]))  # a length of one byte
    blocks = [(codec.RAW, codec.encode_blocks([make_block(k, 4)])) for k in range(11, 60, 5)]  # a hole after each
    messages = [
        (codec.GAP, codec.encode_gap(Gap(4, 7, "crc"))), (codec.ESTIMATE, codec.encode_estimate(short)), *blocks,
        (codec.STATUS, codec.encode_status(make_status(7))),
        (codec.NOTICE, codec.encode_notice(Notice(1, "info", "a", "b"), 5)),
    ]  # fmt: skip
    return [b"\0" + raw, b"\2" + b"".join(bytes((c, len(d))) + d for c, d in messages)]


def _rig() -> list[bytes]:
    return [path.read_bytes() for path in sorted((ROOT / "configs").glob("*.toml"))] + [_CUSTOM]


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
    lines = ["time," + ",".join(CHANNELS)] + [f"{k / 25600:.9f},{k},1,-2.5e3,0" for k in range(10)]
    return ["\n".join(lines).encode(), b"# x\nb1x [m/s^2];b1y;b2x;b2y\n1;2;3;4\n5;6;7;nan\n"]


def _npz() -> list[bytes]:
    out = []
    for save in (np.savez, np.savez_compressed):
        buffer = io.BytesIO()
        save(buffer, rate_hz=25600.0, **{n: _ROWS[:, k] for k, n in enumerate(CHANNELS)})
        out.append(buffer.getvalue())
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
        values = {n: _ROWS[:, k] for k, n in enumerate(CHANNELS)}
        savemat(buffer, values | {"rate_hz": 25600.0}, **options)  # type: ignore[arg-type]
        out.append(buffer.getvalue())
    return out


def _file(pattern: str, write: object = None) -> list[bytes]:
    return [path.read_bytes()[:20_000] for path in sorted((ROOT / "tests" / "data").glob(pattern))] or [b""]


def _uff() -> list[bytes]:
    import tempfile

    import pyuff

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.uff"
        for k, name in enumerate(CHANNELS):
            data = pyuff.prepare_58(
                binary=0, func_type=1, ver_num=1, load_case_id=0, rsp_ent_name=name, rsp_node=1, rsp_dir=1,
                ref_ent_name="NONE", ref_node=0, ref_dir=0, data=_ROWS[:, k], x=np.arange(10) / 25600, id1=name,
                id2="", id3="", id4="", id5="", ord_data_type=4, orddenom_spec_data_type=0, z_axis_spec_data_type=0,
                abscissa_spacing=1, abscissa_min=0.0, abscissa_inc=1 / 25600, num_pts=10,
            )  # fmt: skip
            pyuff.UFF(str(path)).write_sets(data, mode="add")
        return [path.read_bytes()]


def _mf4() -> list[bytes]:
    import tempfile

    from asammdf import MDF, Signal

    t = np.arange(10) / 25600
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mf4"
        with MDF() as file:
            file.append([Signal(_ROWS[:, k], t, name=n, unit="m/s^2") for k, n in enumerate(CHANNELS)])
            file.save(path, compression=1)
        return [path.read_bytes()]


_ASC = b"""date Mon Jan 1 00:00:00 2024
base hex timestamps absolute
 0.1 1 300 Rx d 8 00 01 02 03 04 05 06 07
"""
_MAKERS = {
    "cobs": _cobs, "slcan": _slcan, "serial": _serial, "can": _can, "mapped": lambda: [bytes(range(60))],
    "mcap": _mcap, "rig": _rig, "expression": _expression, "csv": _csv, "npz": _npz, "wav": _wav, "mat": _mat,
    "uff": _uff, "mf4": _mf4, "candump": lambda: _file("canedge_imu/*.log"), "blf": lambda: _file("canedge_imu/*.blf"),
    "asc": lambda: [_ASC],
}  # fmt: skip
