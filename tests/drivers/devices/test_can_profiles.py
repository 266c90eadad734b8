"""The DBC of accelerometers on CAN, on frames built from the public descriptions; cantools is not asked."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from ramp_device import Record

from drivers.can.can_frames import EXTENDED_FLAG, CanFrames
from drivers.contract.reading import LinkStats
from drivers.foreign.mapped import MappedDecoder
from drivers.protocol.device_info import Expected

DBC_BYTES = (Path(__file__).parents[3] / "configs" / "accelerometers.dbc").read_bytes()
STEP_NS = 10_000_000
ACCELERATION_G = np.round(np.random.default_rng(0).uniform(-1.5, 1.5, (300, 2)), 3)
Frame = tuple[int, bytes, int]


def j1939(x: float, y: float, t_ns: int) -> list[Frame]:
    """PGN 61485: 0.01 m/s^2 a bit from -320 m/s^2 on, low byte first; priority 2, source 0x80."""
    data = struct.pack("<4H", *(round((v + 320) / 0.01) for v in (x, y, 9.81)), 0xFFFF)
    return [(EXTENDED_FLAG | 2 << 26 | 61485 << 8 | 0x80, data, t_ns)]


def canopen(x: float, y: float, t_ns: int) -> list[Frame]:
    return [(0x181, struct.pack("<3h", *(round(1000 * v) for v in (x, y, 1.0))), t_ns)]


def floats(x: float, y: float, t_ns: int) -> list[Frame]:
    return [(256, struct.pack(">2f", x, y), t_ns), (257, struct.pack(">f", 9.81), t_ns + 200_000)]


def witmotion(x: float, y: float, t_ns: int) -> list[Frame]:
    accelerations = struct.pack("<BB3h", 0x55, 0x51, *(round(v / 16 * 32768) for v in (x, y, 1.0)))
    return [(0x50, accelerations, t_ns), (0x50, struct.pack("<BB3h", 0x55, 0x52, 9, 9, 9), t_ns + 300_000)]


@pytest.mark.parametrize(
    ("make", "signals", "unit", "tolerance"),
    [
        (j1939, ("ACS.Lateral", "ACS.Longitudinal"), "m/s^2", 0.005),
        (canopen, ("CANopenTPDO1.X", "CANopenTPDO1.Y"), "g", 1e-9),
        (floats, ("FloatXY.X", "FloatXY.Y"), "m/s^2", 1e-6),
        (witmotion, ("WitMotion.X", "WitMotion.Y"), "g", 16 / 65536),
    ],
)
def test_frames_of_the_descriptions_come_out_in_their_units(
    make: object, signals: tuple[str, str], unit: str, tolerance: float
) -> None:
    frames = [f for k, row in enumerate(ACCELERATION_G.tolist()) for f in make(*row, k * STEP_NS)]  # type: ignore[operator]
    by_channel = dict(zip("xy", signals, strict=True))
    decoder = MappedDecoder(LinkStats(), DBC_BYTES, by_channel, Expected(100.0), recorded=True)
    record = Record(ramp=False)
    record.take(decoder.feed(CanFrames.build(frames), 0, final=True))
    scale = np.array([s.scale for s in record.infos[-1].signals])
    offset = np.array([s.offset for s in record.infos[-1].signals])
    found = np.concatenate([b.counts for b in record.blocks]) * scale + offset
    np.testing.assert_allclose(found, ACCELERATION_G, rtol=0, atol=tolerance * 1.001)
    assert {s.unit for s in record.infos[-1].signals} == {unit}
    assert not record.gaps
