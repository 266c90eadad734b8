"""slcan has no check sum: each digit of a frame's head turned into another one. No sample may move."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from ramp_device import PERIOD, ramp_device

from drivers.can.can_decoder import CanDecoder
from drivers.can.slcan_codec import SlcanCodec, encode_line
from drivers.contract.reading import Block, Gap, LinkStats, Reading
from drivers.simulated.simulated import WireFrame

DIGITS = "0123456789ABCDEF"
HEAD = {
    "fd16": 1 + 3 + 1 + 16,
    "fd24": 1 + 3 + 1 + 8,
    "sync_fd": 1 + 3 + 1 + 24,
    "sync": 1 + 3 + 1 + 16,
}  # what is not samples
ROWS = {"fd16": 7, "fd24": 5, "classic": 1}


@cache
def frames(layout: str) -> tuple[WireFrame, ...]:
    rate_hz = 8_000.0 if layout == "classic" else 25_600.0
    return tuple(ramp_device(layout, rate_hz, None).next({"fd16": 60, "fd24": 1700, "classic": 4100}[layout]))


def decode(layout: str, at: int, line: bytes, cut: int) -> tuple[list[Reading], LinkStats]:
    """All frames, with `line` in the place of one; `cut` lines a read."""
    sent, stats, codec, out = frames(layout), LinkStats(), SlcanCodec(), list[Reading]()
    decoder = CanDecoder(stats, unchecked=True)
    lines = [line if k == at else encode_line(f.identifier, f.data, len(f.data) > 8) for k, f in enumerate(sent)]
    for k in range(0, len(lines), cut):
        found = codec.feed(b"".join(lines[k : k + cut]), 0)
        if found.damaged.any():
            decoder.cause("crc")
        out += decoder.feed(found.frames, round(1e9 * (1 + sent[min(k + cut, len(sent)) - 1].due_s)))
    return out, stats


def end_of(readings: list[Reading]) -> int:
    return max(r.index + len(r.counts) for r in readings if isinstance(r, Block))


@pytest.mark.parametrize(
    ("kind", "cut"),
    [pytest.param("fd16", 1, marks=pytest.mark.slow), ("fd16", 7), ("fd24", 800), ("sync_fd", 800), ("sync", 800)],
)
def test_every_flipped_digit_of_a_head(kind: str, cut: int) -> None:
    layout = {"sync_fd": "fd24", "sync": "classic"}.get(kind, kind)
    sent = frames(layout)
    identifier = {"fd16": 0x300, "fd24": 0x301, "sync_fd": 0x305, "sync": 0x303}[kind]
    ours = [k for k, f in enumerate(sent) if f.identifier == identifier]
    at = ours[2] if kind.startswith("sync") else ours[len(ours) // 2]
    good = encode_line(sent[at].identifier, sent[at].data, len(sent[at].data) > 8).decode()
    end = end_of(decode(layout, -1, b"", cut)[0])
    for place in range(1, HEAD[kind]):
        for digit in DIGITS if cut != 800 else DIGITS[place % 3 :: 3]:
            if digit == good[place]:
                continue
            readings, stats = decode(layout, at, (good[:place] + digit + good[place + 1 :]).encode(), cut)
            index = lost = 0
            for reading in readings:
                if isinstance(reading, Block):
                    ramp = np.arange(reading.index, reading.index + len(reading.counts))
                    assert reading.index == index
                    assert ((reading.counts[:, 0] + PERIOD // 2 - ramp) % PERIOD == 0).all(), (place, digit)
                    index += len(reading.counts)
                elif isinstance(reading, Gap):
                    index, lost = index + reading.count, lost + reading.count
            assert index == end, (place, digit)
            assert lost in (0, ROWS[layout]), (place, digit)
            assert stats.restarts == 0
