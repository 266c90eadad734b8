"""The entries of a log in order: for reading, replay and recovery."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError

from daq.base.contract.dates import LATEST_NS, UNKNOWN_START
from daq.base.contract.errors import LogError
from daq.base.contract.scaling import now_at
from daq.base.contract.sink import ClockState, Status
from drivers.contract import Gap, Info, Notice
from estimator.results import Estimate

from . import codec as codec
from .codec import RawBlock
from .scan import Findings, Message, scan

LOST_IN_LOG = "log"  # reason of a gap that the log does not explain: the chunk that held these samples is damaged


@dataclass(frozen=True, slots=True)
class Head:
    """The Session message. wall_offset_ns : Unix time = host monotonic time + this."""

    device: str = ""
    wall_offset_ns: int = 0
    metadata: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class LoggedEstimate:
    """An estimate and the very bytes that the log holds for it."""

    estimate: Estimate
    data: bytes


Entry = Head | Info | RawBlock | Gap | Notice | LoggedEstimate | Status


def walk(
    path: Path, findings: Findings, everything: bool = False, at: int = 0
) -> Iterator[tuple[Entry | None, Message | None]]:  # fmt: skip
    """Entries in order, each with its message; unexplained jumps of the index become gaps (message None).

    at : the byte to begin at: 0, or where a chunk begins. Head and Info come when they are new. Blocks never overlap
    and never go back. Preview and repetitions are left out, or with `everything` come as (None, message).
    """
    decoder = _Decoder()
    for messages in scan(path, findings, at):
        _check_topics(path, findings)
        for message in messages:
            try:
                entry = decoder.entry(message)
            except (DecodeError, ValueError) as error:
                findings.damage.append(f"a message of channel {message.channel} makes no sense: {error}")
                continue
            if entry is None:
                if everything and (1 <= message.channel <= len(codec.LOG_TOPICS) or message.channel in findings.topics):
                    yield None, message
                continue
            missing = decoder.missing_before(entry)
            if missing is not None:
                findings.damage.append(f"{missing.count} samples from {missing.index} are missing without a gap record")
                yield missing, None
            if isinstance(entry, RawBlock | Gap) and not decoder.advance(entry):
                findings.damage.append(f"what is said of sample {entry.index} goes back in the index, and is left out")
                continue
            yield entry, message


def _check_topics(path: Path, findings: Findings) -> None:
    expected = {number: topic.name for number, topic in enumerate(codec.LOG_TOPICS, 1)}
    if any(expected.get(number) != name for number, name in findings.topics.items() if number in expected):
        raise LogError(f"{path}: an MCAP file, but not a Rotorscope log; use `rotorscope import` for other data")


class _Decoder:
    def __init__(self) -> None:
        self._head = self._info = b""
        self._wall_offset_ns = 0
        self._next: int | None = None  # the index that follows what was seen
        self._channels = -1

    def entry(self, message: Message) -> Entry | None:
        data = message.data
        match message.channel:
            case codec.RAW_CHANNEL:
                block = codec.decode_block(data)
                if block.counts.shape[1] != self._channels:
                    raise ValueError(f"{block.counts.shape[1]} columns where {self._channels} signals were announced")
                return block
            case codec.GAP_CHANNEL:
                return self._gap(codec.decode_gap(data))
            case codec.ESTIMATE_CHANNEL:
                return LoggedEstimate(codec.decode_estimate(data), data)
            case codec.STATUS_CHANNEL:
                return codec.decode_status(data)
            case codec.NOTICE_CHANNEL:
                return codec.decode_notice(data, message.log_time - self._wall_offset_ns)
            case codec.SESSION_CHANNEL if data != self._head:
                head = Head(*codec.decode_session(data))
                self._head = data
                self._wall_offset_ns = head.wall_offset_ns
                return head
            case codec.INFO_CHANNEL if data != self._info:
                info = codec.decode_info(data)
                if not info.rate_hz > 0 or not np.isfinite(info.rate_hz) or not 1 <= info.count_bits <= 32:
                    raise ValueError(f"a rate of {info.rate_hz} Hz, {info.count_bits} bits")
                self._info, self._channels = data, len(info.signals)
                return info
        return None

    def _gap(self, gap: Gap) -> Gap:
        if gap.index < 0 or gap.count < 0:
            raise ValueError(f"a gap of {gap.count} samples from {gap.index}")
        return gap

    def missing_before(self, entry: Entry) -> Gap | None:
        """The unexplained gap before this entry; None if there is none."""
        if not isinstance(entry, RawBlock | Gap) or (isinstance(entry, Gap) and not entry.count):
            return None
        expected = self._next
        if expected is None or entry.index <= expected:
            return None
        self._next = entry.index
        return Gap(expected, entry.index - expected, LOST_IN_LOG)

    def advance(self, entry: RawBlock | Gap) -> bool:
        """Move over a block or a gap; False if it goes back."""
        if isinstance(entry, Gap) and not entry.count:
            return True
        if self._next is not None and entry.index < self._next:
            return False
        self._next = entry.stop if isinstance(entry, RawBlock) else entry.index + entry.count
        return True


@dataclass(frozen=True, slots=True)
class Other:
    """Samples under a description that differs from that of the log in rate, channels or unit."""

    index: int
    what: str
    samples: int

    def __str__(self) -> str:
        return f"from sample {self.index} on the device has {self.what}: {self.samples} samples"


class Said:
    """Content of a log, collected entry by entry."""

    def __init__(self) -> None:
        self.head = Head()
        self.info: Info | None = None
        self.status: Status | None = None
        self.first: int | None = None
        self.stop = self.lost = 0
        self.gaps: list[Gap] = []
        self.notices: list[Notice] = []
        self.estimates: list[LoggedEstimate] = []
        self.clocks: list[tuple[int, ClockState]] = []
        self.others: list[Other] = []
        self._first_ns = 0  # host time of the first sample
        self._deviation = ""  # of the description in force from the first one

    @property
    def events(self) -> int:
        events = len(self.gaps) + len(self.notices) + len(self.estimates)
        return events + len(self.clocks) + len(self.others)

    @property
    def started_ns(self) -> int | None:
        """Unix time of the first sample, ns; None if it is not known. Old imports without a flag have wrong stamps."""
        about = self.head.metadata
        recorded = about.get("command") == "import" or about.get("link_kind") == "capture"
        if not self._first_ns or about.get("started") == UNKNOWN_START or (recorded and "imported" not in about):
            return None
        started_ns = self._first_ns + self.head.wall_offset_ns
        return started_ns if 0 <= started_ns < LATEST_NS else None  # of a hostile file

    def take(self, entry: Entry) -> None:
        """The next entry of the log."""
        match entry:
            case RawBlock():
                self.first = entry.index if self.first is None else self.first
                if not self._first_ns and self.info is not None:
                    rows = entry.index - self.first + entry.part_rows[0] - 1  # the part came with its last row
                    self._first_ns = entry.part_host_ns[0] - round(1e9 * rows / self.info.rate_hz)
                self.stop = entry.stop
                if self._deviation:
                    self._count_other(entry)
            case Gap():
                self.gaps.append(entry)
                if entry.count:
                    self.first = entry.index if self.first is None else self.first
                    self.lost += entry.count
                    self.stop = entry.index + entry.count
            case Info():
                self.info = self.info or entry
                there = now_at(self.info, entry)
                self._deviation = there if isinstance(there, str) else ""
            case Notice():
                self.notices.append(entry)
            case LoggedEstimate():
                self.estimates.append(entry)
            case Status():
                self.status = entry
                if entry.clock is not None:
                    self.clocks.append((entry.index, entry.clock))
            case Head():
                self.head = entry

    def _count_other(self, block: RawBlock) -> None:
        same = bool(self.others) and self.others[-1].what == self._deviation
        last = self.others.pop() if same else Other(block.index, self._deviation, 0)
        self.others.append(replace(last, samples=last.samples + len(block.counts)))
