"""Readings of a link driver, and the contract that every driver keeps (the driver seam).

A driver turns bytes of one link into *readings*: blocks of raw counts with an absolute sample index, gaps, notices
and the device's description of itself. It never raises on wire data and never loses a sample without a `Gap`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Signal:
    """One channel as the link delivers it: SI value = counts * scale + offset.

    name : of the channel, as the device gives it.
    unit : SI unit of the value; "" if the device does not say.
    scale, offset : SI value of one count, and of count zero.
    """

    name: str
    unit: str
    scale: float
    offset: float = 0.0


@dataclass(frozen=True, slots=True)
class Info:
    """The device's description of itself; sent once before the first block and again after every change.

    signals : the channels, in the order of the columns of a block.
    rate_hz : nominal sampling rate, Hz.
    serial_number : of the device; "" if it has none.
    count_bits : counts beyond +-(2**(bits-1) - 1) cannot be distinguished from a clipped sensor.
    """

    signals: tuple[Signal, ...]
    rate_hz: float
    serial_number: str = ""
    count_bits: int = 16


@dataclass(frozen=True, slots=True)
class Block:
    """Consecutive samples of all channels.

    index : absolute sample index of row 0; monotonic for the life of the driver, over device counter wraps
        and device restarts.
    counts : (n, channels) int32, raw.
    t_host_ns : host monotonic clock when the last byte of the block was read.
    t_device_ns : the device's own clock at row 0, unwrapped; None if the device sends none.
    """

    index: int
    counts: NDArray[np.int32]
    t_host_ns: int
    t_device_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Gap:
    """`count` samples from `index` on that will never come. reason : one of GAP_REASONS."""

    index: int
    count: int
    reason: str


GAP_REASONS = (
    "sequence", "crc", "device_lost", "restart", "reconnect", "overflow", "duplicate", "version", "silent",
    "source", "stuck",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Notice:
    """Something an operator should read.

    t_host_ns : host monotonic time, ns.
    level : info | warning | error.
    code : short, stable, snake_case: for programs.
    text : one line for the operator.
    """

    t_host_ns: int
    level: str
    code: str
    text: str


Reading = Info | Block | Gap | Notice


@dataclass(slots=True, kw_only=True)
class LinkStats:
    """Running totals of a link since it was opened; only ever grow.

    frames, bytes : received.
    crc_errors : frames dropped because they were damaged.
    resyncs : times that the start of a frame was searched anew in a byte stream.
    reconnects : times that a lost link was opened again.
    restarts : restarts of the device.
    duplicates : frames dropped because they came twice.
    lost_samples : of each channel.
    other : counters of one kind of link, by name.
    """

    frames: int = 0
    bytes: int = 0
    crc_errors: int = 0
    resyncs: int = 0
    reconnects: int = 0
    restarts: int = 0
    duplicates: int = 0
    lost_samples: int = 0
    other: dict[str, int] = field(default_factory=dict)

    def count(self, name: str, number: int = 1) -> None:
        """Add to one of the link's own counters."""
        self.other[name] = self.other.get(name, 0) + number


class Driver(Protocol):
    """One link. Construct without I/O; `open` connects; `read` is called from one thread only.

    Raises (see drivers/errors.py): `open` LinkUnavailable | LinkOpenError, one line saying what was tried and what to
    do. `read` never raises on wire data or on a lost link: it reports a Notice, reconnects by itself with back-off
    and no busy loop, and accounts for what was missed with a Gap.
    """

    kind: str
    stats: LinkStats

    def open(self) -> None: ...
    def close(self) -> None: ...  # idempotent, wakes a blocked read within 0.2 s

    def read(self, timeout_s: float) -> list[Reading]:
        """Readings that have arrived, in order; [] after `timeout_s` with none.

        The first read after `close` returns the samples that were held until it is known whether any is missing.
        """
        ...

    @property
    def exhausted(self) -> bool:
        """True once a finite source (a capture, a replay) has delivered everything."""
        ...
