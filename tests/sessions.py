"""A small session with everything that a log can hold, for the tests of this folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.sink import ClockState, Session, Sink, Status
from daq.log.writer import LogWriter
from drivers.contract.reading import Block, Gap, Info, LinkStats, Notice, Reading, Signal
from estimator.model.rig import Channel, Model
from estimator.results import Estimate, Parameter

RATE_HZ = 25600.0
CHANNELS = tuple(Channel(f"b{n}{d}", f"bearing{n}", d) for n in (1, 2) for d in "xy")
MODEL = Model(channels=CHANNELS, band=(150.0, 8000.0), name="test rig")
RIG_TEXT = "# a rig, with a comment that must survive: Ünïcode\nschema = 1\n"
DBC_TEXT = 'VERSION ""\n'


def make_info(bits: int = 16, rate_hz: float = RATE_HZ) -> Info:
    signals = tuple(Signal(c.name, "m/s^2", 490.5 / 2 ** (bits - 1) * (1 + i / 100)) for i, c in enumerate(CHANNELS))
    return Info(signals, rate_hz, "SN 7", bits)


def make_session(bits: int = 16, rate_hz: float = RATE_HZ) -> Session:
    attachments = {"rig.toml": RIG_TEXT.encode(), "own.dbc": DBC_TEXT.encode()}
    return Session(
        model=MODEL,
        info=make_info(bits, rate_hz),
        device="dev1",
        attachments=attachments,
        metadata={"rotorscope": "0.1.0", "link": "virtual:"},
    )


def counts_at(index: int, n: int, bits: int = 16) -> NDArray[np.int32]:
    """(n, 4) counts that depend on the absolute index alone, noisy enough not to compress away."""
    i = np.arange(index, index + n, dtype=np.uint64)[:, None]
    channel = np.arange(4, dtype=np.uint64) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (i * np.uint64(0x9E3779B97F4A7C15) + channel) >> np.uint64(40)
    return (mixed.astype(np.int64) % (2**bits - 2) - (2 ** (bits - 1) - 1)).astype(np.int32)


def make_block(index: int, n: int, bits: int = 16, device: bool = True, t0_ns: int = 10**12) -> Block:
    t_ns = t0_ns + round((index + n) * 1e9 / RATE_HZ)
    return Block(index, counts_at(index, n, bits), t_ns, round(index * 1e9 / RATE_HZ) if device else None)


def make_estimate(index: int) -> Estimate:
    parameters = {
        "bearing1.x.kL": Parameter(1e7 + index / 3, 1e4, "N/m"),
        "bearing1.x.c": Parameter(
            value=None, sd=None, unit="N s/m", identifiable=False, reason="relative standard deviation over 50 %"
        ),
        "bearing1.y.kL": Parameter(float("nan"), 0.0, "N/m"),
    }
    extra = {"lag": 0.1} if index % 3 else None
    return Estimate(
        index=index,
        parameters=parameters,
        samples=index / 7,
        log_likelihood=-1.5 if index % 2 else None,
        status="ok",
        extra=extra,
    )


def make_status(index: int) -> Status:
    link = LinkStats(frames=index // 64, bytes=index * 9, crc_errors=1, other={"odd": 2})
    clock = ClockState(123456789, 25601.28, 50.0, 700_000)
    return Status(
        t_host_ns=10**12 + index,
        index=index,
        rate_hz=25600.0,
        link=link,
        clock=clock,
        lag_s={"estimator": 0.01},
        dropped={"log": 3},
    )


def make_stream(blocks: int = 40, rows: int = 320) -> list[Reading]:
    """Blocks with two gaps, an event without loss and a notice."""
    out: list[Reading] = []
    index = 1000
    for k in range(blocks):
        if k == blocks // 3:
            out += [Gap(index, 37, "crc"), Notice(10**12 + 5, "warning", "crc", "a frame was damaged")]
            index += 37
        if k == blocks // 2:
            out += [Gap(index, 0, "duplicate"), Gap(index, 64, "sequence"), Gap(index + 64, 6, "device_lost")]
            index += 70
        out.append(make_block(index, rows))
        index += rows
    return out


def feed(sink: Sink, stream: list[Reading], session: Session | None = None) -> None:
    """The calls that the core loop makes, without its timing."""
    sink.start(session or make_session())
    for k, reading in enumerate(stream):
        sink.readings([reading])
        if k % 10 == 9 and isinstance(reading, Block):
            sink.estimate(make_estimate(reading.index))
            sink.status(make_status(reading.index))


def write_log(path: Path, stream: list[Reading] | None = None, session: Session | None = None) -> list[Reading]:
    stream = make_stream() if stream is None else stream
    writer = LogWriter(path, live=False)
    feed(writer, stream, session)
    writer.close()
    assert writer.health().notices == ()
    return stream


def truth(stream: list[Reading]) -> tuple[int, NDArray[np.int32]]:
    """First index and all counts, gaps as the least int32."""
    blocks = [r for r in stream if isinstance(r, Block)]
    first, stop = blocks[0].index, blocks[-1].index + len(blocks[-1].counts)
    out = np.full((stop - first, blocks[0].counts.shape[1]), np.iinfo(np.int32).min, dtype=np.int32)
    for block in blocks:
        out[block.index - first : block.index - first + len(block.counts)] = block.counts
    return first, out
