"""What a log says: all of it at once (`read_log`), or piece by piece for replay and recovery (`walk`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from daq.base.contract.errors import LogError
from daq.base.contract.scaling import Scaling, now_at
from daq.base.contract.sink import ClockState, Status
from drivers.contract import Gap, Info, Notice, Reading
from estimator.results import Estimate

from . import codec as codec
from .codec import RawBlock
from .place import being_written
from .scan import Findings, Message, scan

LOST_IN_LOG = "log"  # reason of a gap that the log does not explain: the chunk that held these samples is damaged
MOST_EVENTS = 2_000_000  # gaps, notices, estimates, damage: a few kB of a hostile file can unpack to any number
LARGEST_SAMPLES = 64 << 30  # bytes of samples() or counts() that we are willing to allocate


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


def walk(path: Path, findings: Findings, everything: bool = False) -> Iterator[tuple[Entry | None, Message | None]]:
    """All in order, with the message it came from; unexplained jumps of the index become gaps (message None).

    Head and Info come when they are new. Blocks never overlap and never go back. Preview and repetitions are left out,
    or with `everything` come as (None, message).
    """
    decoder = _Decoder()
    for messages in scan(path, findings):
        _check_topics(path, findings)
        for message in messages:
            try:
                entry = decoder.entry(message)
            except (DecodeError, ValueError) as error:
                findings.damage.append(f"a message of channel {message.channel} makes no sense: {error}")
                continue
            if entry is None:
                if everything and 1 <= message.channel <= len(codec.TOPICS):
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
    expected = {number: topic.name for number, topic in enumerate(codec.TOPICS, 1)}
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
            case codec.RAW:
                block = codec.decode_block(data)
                if block.counts.shape[1] != self._channels:
                    raise ValueError(f"{block.counts.shape[1]} columns where {self._channels} signals were announced")
                return block
            case codec.GAP:
                return self._gap(codec.decode_gap(data))
            case codec.ESTIMATE:
                return LoggedEstimate(codec.decode_estimate(data), data)
            case codec.STATUS:
                return codec.decode_status(data)
            case codec.NOTICE:
                return codec.decode_notice(data, message.log_time - self._wall_offset_ns)
            case codec.SESSION if data != self._head:
                head = Head(*codec.decode_session(data))
                self._head = data
                self._wall_offset_ns = head.wall_offset_ns
                return head
            case codec.INFO if data != self._info:
                info = codec.decode_info(data)
                if not info.rate_hz > 0 or not np.isfinite(info.rate_hz) or not 2 <= info.count_bits <= 32:
                    raise ValueError(f"a rate of {info.rate_hz} Hz, {info.count_bits} bits")
                self._info, self._channels = data, len(info.signals)
                return info
        return None

    def _gap(self, gap: Gap) -> Gap:
        if gap.index < 0 or gap.count < 0:
            raise ValueError(f"a gap of {gap.count} samples from {gap.index}")
        return gap

    def missing_before(self, entry: Entry) -> Gap | None:
        """The unexplained hole between what was seen and this entry."""
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
    """Samples of a description that is not that of the log: rate, channels or unit."""

    index: int
    what: str
    samples: int

    def __str__(self) -> str:
        return f"from sample {self.index} on the device has {self.what}: {self.samples} samples"


@dataclass(frozen=True)
class Recording:
    """A log. Small things are read, samples come when asked for. complete : closed, and every part of it intact.

    gaps : (index, count, reason) in order; estimates : all that were logged; clock : the last that was stated.
    first, stop : absolute sample indices; damage : what is wrong with the file, one line each. info : the first
    description of the device; others : what a later one says otherwise, so that the samples from an index on are no
    continuation, and how many those are: counts() and samples() leave them out like a gap.
    """

    path: Path
    head: Head
    info: Info
    first: int
    stop: int
    lost_samples: int
    gaps: tuple[Gap, ...]
    notices: tuple[Notice, ...]
    estimates: tuple[LoggedEstimate, ...]
    clocks: tuple[tuple[int, ClockState], ...]  # as stated when the stream was at this index
    last_status: Status | None
    findings: Findings = field(repr=False)
    growing: bool = False  # somebody is writing it: it was read up to here
    others: tuple[Other, ...] = ()

    @property
    def rate_hz(self) -> float:
        return self.info.rate_hz

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(s.name for s in self.info.signals)

    @property
    def n_samples(self) -> int:
        """Samples that are there."""
        return self.stop - self.first - self.lost_samples

    @property
    def seconds(self) -> float:
        return (self.stop - self.first) / self.rate_hz

    @property
    def clock(self) -> ClockState | None:
        return self.clocks[-1][1] if self.clocks else None

    @property
    def complete(self) -> bool:
        return self.findings.complete

    @property
    def damage(self) -> tuple[str, ...]:
        return tuple(self.findings.damage)

    @property
    def metadata(self) -> dict[str, str]:
        return self.head.metadata

    @property
    def attachments(self) -> dict[str, bytes]:
        return {name: data for name, (_, data) in self.findings.attachments.items()}

    @property
    def rig_text(self) -> str:
        """The rig file of the session. Raises LogError if it is not in the log or damaged."""
        data = self.attachments.get("rig.toml")
        if data is None:
            raise LogError(f"{self.path}: holds no intact rig file; give one with --rig")
        return data.decode("utf-8", "replace")

    @property
    def dbc(self) -> str | None:
        return next((d.decode("utf-8", "replace") for n, d in self.attachments.items() if n.endswith(".dbc")), None)

    def counts(self) -> NDArray[np.int32]:
        """(stop - first, channels) as the device sent them; rows of a gap are the least int32."""
        self._affordable(4)
        out = np.empty((self.stop - self.first, len(self.channels)), dtype=np.int32)
        out[:] = np.iinfo(np.int32).min
        for block, info in self._blocks():
            columns, start = now_at(self.info, info), block.index - self.first
            if not isinstance(columns, str):
                out[start : start + len(block.counts)] = block.counts[:, columns]
        return out

    def samples(self) -> NDArray[np.float64]:
        """(stop - first, channels) in SI; rows of a gap are NaN."""
        return self._in_si(list(range(len(self.channels))), keep_clipped=True)[0]

    def unclipped(self, columns: list[int]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """The same of these channels with NaN also for what is at full scale; (columns,) how many samples that are."""
        return self._in_si(columns, keep_clipped=False)

    def _in_si(self, columns: list[int], keep_clipped: bool) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        self._affordable(8)
        out = np.empty((self.stop - self.first, len(columns)))
        at, hits, scaling, of = 0, np.zeros(len(columns), np.int64), None, None
        for block, info in self._blocks():
            if info is not of:
                there, of = now_at(self.info, info), info
                scaling = None if isinstance(there, str) else Scaling(info, [there[k] for k in columns])
            if scaling is None:
                continue
            start, counts = block.index - self.first, scaling.select(block.counts)
            out[at:start] = np.nan
            at = start + len(counts)
            scaling.si(counts, out[start:at])
            if not keep_clipped and (clipped := scaling.clipped(counts)) is not None:
                out[start:at][clipped] = np.nan
                hits += clipped.sum(axis=0)
        out[at:] = np.nan
        return out, hits

    def readings(self, joined: bool = True) -> Iterator[Reading]:
        """What the link delivered, in order, a piece at a time: for replay. Memory does not grow with the log.

        joined : blocks as the log holds them, several of the link in one; False: as they came.
        """
        for entry, _ in walk(self.path, self.again()):
            if isinstance(entry, RawBlock) and joined:
                yield entry.joined()
            elif isinstance(entry, RawBlock):
                yield from entry.parts()
            elif isinstance(entry, Info | Gap | Notice):
                yield entry

    def again(self) -> Findings:
        """For another pass over what the first one saw: a log may be growing."""
        return Findings(size=self.findings.size)

    def _blocks(self) -> Iterator[tuple[RawBlock, Info]]:
        info = self.info
        for entry, _ in walk(self.path, self.again()):
            if isinstance(entry, Info):
                info = entry
            elif isinstance(entry, RawBlock):
                yield entry, info

    def _affordable(self, item_bytes: int) -> None:
        needed = (self.stop - self.first) * max(1, len(self.channels)) * item_bytes
        sparse = self.lost_samples > 100 * self.n_samples + 10_000_000
        if needed > LARGEST_SAMPLES or sparse:
            raise LogError(
                f"{self.path}: its {self.n_samples} samples spread over {self.stop - self.first} indices, "
                "too many to hold at once; replay it, or export the part between the gaps"
            )


def read_log(path: str | Path) -> Recording:
    """The log at `path`, after one pass over it that checks every chunk.

    Raises LogError if the file is missing, is no Rotorscope log, or holds nothing intact.
    """
    path = Path(path)
    findings, written = Findings(), being_written(path)
    head, info, status = Head(), None, None
    first: int | None = None
    stop = lost = 0
    gaps: list[Gap] = []
    notices: list[Notice] = []
    estimates: list[LoggedEstimate] = []
    clocks: list[tuple[int, ClockState]] = []
    others: list[Other] = []
    what = ""
    for entry, _ in walk(path, findings):
        match entry:
            case RawBlock():
                first = entry.index if first is None else first
                stop = entry.stop
                if what:
                    begun = others.pop() if others and others[-1].what == what else Other(entry.index, what, 0)
                    others.append(replace(begun, samples=begun.samples + len(entry.counts)))
            case Gap():
                gaps.append(entry)
                if entry.count:
                    if first is None:
                        first = stop = entry.index
                    lost += entry.count
                    stop = entry.index + entry.count
            case Info():
                info = info or entry
                there = now_at(info, entry)
                what = there if isinstance(there, str) else ""
            case Notice():
                notices.append(entry)
            case LoggedEstimate():
                estimates.append(entry)
            case Status():
                status = entry
                if entry.clock is not None:
                    clocks.append((entry.index, entry.clock))
            case Head():
                head = entry
        if len(gaps) + len(notices) + len(estimates) + len(clocks) + len(others) + len(findings.damage) > MOST_EVENTS:
            text = f"holds more than {MOST_EVENTS} gaps, notices and estimates; it was not made by Rotorscope"
            raise LogError(f"{path}: {text}")
    if info is None and written:
        raise LogError(f"{path}: is being written, and holds nothing yet; try again when samples have come")
    if info is None:
        what = "nothing in it is intact" if findings.damage else "it holds no session"
        raise LogError(f"{path}: no Rotorscope log can be read from it: {what}; check that it is the right file")
    return Recording(
        path, head, info, first or 0, stop, lost, tuple(gaps), tuple(notices), tuple(estimates), tuple(clocks), status,
        findings, written and not findings.closed, tuple(others),
    )  # fmt: skip
