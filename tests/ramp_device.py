"""A source whose samples say which they are, and a reader that checks every promise of the driver seam."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from promises import PATIENCE_S

from drivers.contract.reading import GAP_REASONS, Block, Driver, Gap, Info, Notice, Reading
from drivers.links.links import make_driver, parse_link
from drivers.served.serve import serve
from drivers.simulated.simulated import DeviceConfig, SimulatedDevice

PERIOD = 16_000  # the ramp's, in counts; fits 15 bits
CHANNELS = ("b1x", "b1y", "b2x", "b2y")


class Ramp:
    """Sample i of channel c is (i + 100 c) mod PERIOD - PERIOD / 2 counts: a block tells where it comes from."""

    def __init__(self, scale: float, channels: int = 4) -> None:
        self._next = 0
        self._scale = scale
        self._channels = channels

    def __call__(self, n: int) -> NDArray[np.float64]:
        index = np.arange(self._next, self._next + n)[:, None] + 100 * np.arange(self._channels)
        self._next += n
        return (index % PERIOD - PERIOD // 2) * self._scale


def ramp_device(
    layout: str, rate_hz: float = 25_600.0, seconds: float | None = 1.0, **config: object
) -> SimulatedDevice:
    settings = DeviceConfig(rate_hz, CHANNELS, layout=layout, seconds=seconds, **config)  # type: ignore[arg-type]
    return SimulatedDevice(Ramp(settings.signals()[0].scale), settings)


@dataclass
class Record:
    """Takes readings and checks them as they come; `offset` is (sample - index) mod PERIOD of the last block."""

    infos: list[Info] = field(default_factory=list)
    notices: list[Notice] = field(default_factory=list)
    gaps: list[Gap] = field(default_factory=list)
    blocks: list[Block] = field(default_factory=list)
    samples: int = 0
    next_index: int = 0
    offset: int | None = None
    ramp: bool = True

    def take(self, readings: Iterable[Reading]) -> None:
        for reading in readings:
            if isinstance(reading, Info):
                self.infos.append(reading)
            elif isinstance(reading, Notice):
                assert "\n" not in reading.text
                self.notices.append(reading)
            elif isinstance(reading, Gap):
                assert reading.index == self.next_index
                assert reading.count > 0
                assert reading.reason in GAP_REASONS
                self.next_index += reading.count
                self.gaps.append(reading)
            else:
                self._block(reading)

    def _block(self, block: Block) -> None:
        assert self.infos, "a block before the first info"
        assert block.index == self.next_index
        assert block.counts.dtype == np.int32
        assert block.counts.shape[1] == len(self.infos[-1].signals)
        self.next_index += len(block.counts)
        self.samples += len(block.counts)
        self.blocks.append(block)
        if self.ramp:
            steps = np.diff(block.counts, axis=0) % PERIOD
            assert (steps == 1).all()
            assert (np.diff(block.counts[0]) % PERIOD == 100).all()
            self.offset = (int(block.counts[0, 0]) + PERIOD // 2 - block.index) % PERIOD

    def lost(self, reason: str) -> int:
        return sum(gap.count for gap in self.gaps if gap.reason == reason)

    def codes(self) -> set[str]:
        return {notice.code for notice in self.notices}


def read_all(driver: Driver, record: Record | None = None, seconds: float = PATIENCE_S) -> Record:
    """Read until the driver is exhausted."""
    record = record or Record()
    deadline = time.monotonic() + seconds
    while not driver.exhausted:
        assert time.monotonic() < deadline, "never exhausted"
        record.take(driver.read(0.1))
    return record


class Served:
    """A device on a link, in a thread; use as a context manager."""

    def __init__(self, link: str, device: SimulatedDevice, speed: float | None = None) -> None:
        self.stop = threading.Event()
        self.url = ""
        self._ready = threading.Event()
        self.thread = threading.Thread(target=serve, args=(link, device, speed, self.stop, self._started))
        self.thread.start()
        assert self._ready.wait(PATIENCE_S)

    def _started(self, url: str) -> None:
        self.url = url
        self._ready.set()

    def __enter__(self) -> Served:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop.set()
        self.thread.join()

    def driver(self, options: str = "") -> Driver:
        driver = make_driver(parse_link(self.url + options))
        driver.open()
        return driver


def read_for(driver: Driver, record: Record, seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        record.take(driver.read(0.3))


def read_until(driver: Driver, record: Record, done: Callable[[Record], bool], seconds: float = PATIENCE_S) -> Record:
    deadline = time.monotonic() + seconds
    while not done(record):
        assert time.monotonic() < deadline, f"waited in vain: {record.samples} samples, {record.codes()}"
        record.take(driver.read(0.1))
    return record
