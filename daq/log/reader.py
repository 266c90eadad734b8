"""A log as one object (`read_log`): what it says of the session, and its samples when they are asked for."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.dates import LATEST_NS, UNKNOWN_START
from daq.base.contract.errors import LogError
from daq.base.contract.scaling import Scaling, now_at
from daq.base.contract.sink import ClockState, Status
from drivers.contract import Gap, Info, Notice, Reading

from .codec import RawBlock
from .entries import Entry, Head, LoggedEstimate, walk
from .place import being_written
from .scan import Findings

if TYPE_CHECKING:
    from daq.rig.rig import Rig

MOST_EVENTS = 2_000_000  # gaps, notices, estimates, damage: a few kB of a hostile file can unpack to any number
LARGEST_SAMPLES = 64 << 30  # bytes of samples() or counts() that we are willing to allocate


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
    """A log. Its samples are read from the file when they are asked for.

    path : of the file.
    head : device, clock offset and metadata of the session.
    info : first description of the device: channels, rate, scaling.
    first, stop : absolute sample index of the first sample, and of the one after the last.
    lost_samples : samples of each channel that are missing between `first` and `stop`.
    gaps : index, count and reason of each gap, in order.
    notices : what the operator was told, in order.
    estimates : all logged estimates, in order.
    clocks : (sample index, mapping of device to host clock) for each statement of the clock.
    last_status : the last status; None if there is none.
    findings : what the pass over the file found.
    started_ns : Unix time of the first sample, ns; None of a recording whose source says no date.
    growing : another process is writing the log; it was read up to `stop`.
    others : samples under a later description of the device that is no continuation of `info` (another rate, channels
        or unit); `counts` and `samples` leave them out like a gap.
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
    clocks: tuple[tuple[int, ClockState], ...]
    last_status: Status | None
    findings: Findings = field(repr=False)
    growing: bool = False
    others: tuple[Other, ...] = ()
    started_ns: int | None = None

    @property
    def started(self) -> datetime | None:
        """Time of the first sample, UTC, to the microsecond; None if it is not known."""
        return None if self.started_ns is None else datetime.fromtimestamp(self.started_ns // 1000 / 1e6, UTC)

    @property
    def rate_hz(self) -> float:
        """Sampling rate as the device states it, Hz."""
        return self.info.rate_hz

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the logged channels, in the order of the columns of `samples()`."""
        return tuple(s.name for s in self.info.signals)

    @property
    def n_samples(self) -> int:
        """Number of samples of each channel that are there."""
        return self.stop - self.first - self.lost_samples

    @property
    def seconds(self) -> float:
        """Length of the log in device time, s; gaps included."""
        return (self.stop - self.first) / self.rate_hz

    @property
    def clock(self) -> ClockState | None:
        """The last statement of how device and host clock go together; None if there is none."""
        return self.clocks[-1][1] if self.clocks else None

    @property
    def complete(self) -> bool:
        """Whether the log was closed, and every part of it is intact."""
        return self.findings.complete

    @property
    def damage(self) -> tuple[str, ...]:
        """What is wrong with the file, one line each."""
        return tuple(self.findings.damage)

    @property
    def metadata(self) -> dict[str, str]:
        """Versions, link and command of the session."""
        return self.head.metadata

    @property
    def attachments(self) -> dict[str, bytes]:
        """The attached files by name: rig file, DBC, modules of custom laws."""
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
        """Text of the attached DBC; None if there is none."""
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

    def samples(self, rig: Rig | None = None, note: Callable[[str], None] = warnings.warn) -> NDArray[np.float64]:
        """Samples in SI units, as the estimator takes them.

        Parameters
        ----------
        rig : Rig, optional
            Select the channels of this rig, in its order, and check them against it. None: every channel of the log
            in the order of `channels`, with values at full scale kept.
        note : callable, optional
            Called with one line for each thing to know: missing samples, values at full scale, a rate that is not
            that of the rig file. It issues a warning unless given.

        Returns
        -------
        (stop - first, channels) float64
            m/s^2, m/s, m or N; NaN in the rows of a gap and, with a rig, where a value is at full scale.

        Raises
        ------
        LogError
            A channel of the rig is missing or in another unit, the log holds no samples, the band of the rig does not
            lie below half the sampling rate, or the samples do not fit into memory.
        """
        if rig is None:
            return self._in_si(list(range(len(self.channels))), keep_clipped=True)[0]
        from .rig_samples import rig_samples

        return rig_samples(self, rig, note)

    def unclipped(self, columns: list[int]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """(stop - first, columns) in SI with NaN for gaps and values at full scale; (columns,) count of the latter."""
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


def read_log(path: str | Path, *, max_events: int = MOST_EVENTS) -> Recording:
    """Read a log (MCAP), in one pass that checks every chunk; samples are read when they are asked for.

    Parameters
    ----------
    path : path
        The log. One that is being written is read up to where it is now.
    max_events : int
        Gaps, notices, estimates and damage at most; a log with more was not made by Rotorscope.

    Returns
    -------
    Recording
        ``samples(rig)`` is the array that the estimator takes, ``rate_hz`` its sampling rate.

    Raises
    ------
    LogError
        The file is missing, is no Rotorscope log, holds nothing intact or too many events.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from daq import acquire, load_rig, read_log
    >>> rig = load_rig("configs/one_bearing.toml")
    >>> with TemporaryDirectory() as folder:
    ...     summary = acquire(rig, "virtual:", seconds=0.5, out=f"{folder}/bearing.mcap")
    ...     log = read_log(f"{folder}/bearing.mcap")
    ...     y = log.samples(rig)
    >>> y.shape, log.rate_hz, log.complete
    ((6400, 2), 12800.0, True)
    """
    path = Path(path)
    findings, written = Findings(), being_written(path)
    said = _Said()
    for entry, _ in walk(path, findings):
        if entry is not None:
            said.take(entry)
        if said.events + len(findings.damage) > max_events:
            text = f"holds more than {max_events} gaps, notices and estimates; it was not made by Rotorscope"
            raise LogError(f"{path}: {text}")
    if said.info is None and written:
        raise LogError(f"{path}: is being written, and holds nothing yet; try again when samples have come")
    if said.info is None:
        what = "nothing in it is intact" if findings.damage else "it holds no session"
        raise LogError(f"{path}: no Rotorscope log can be read from it: {what}; check that it is the right file")
    return Recording(
        path=path, head=said.head, info=said.info, first=said.first or 0, stop=said.stop, lost_samples=said.lost,
        gaps=tuple(said.gaps), notices=tuple(said.notices), estimates=tuple(said.estimates),
        clocks=tuple(said.clocks), last_status=said.status, findings=findings,
        growing=written and not findings.closed, others=tuple(said.others), started_ns=said.started_ns,
    )  # fmt: skip


class _Said:
    """What the entries of a log say, taken one after the other."""

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
        """Unix time of the first sample, if it is known: before there was a word for it, imports were stamped wrong."""
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
        begun = self.others.pop() if same else Other(block.index, self._deviation, 0)
        self.others.append(replace(begun, samples=begun.samples + len(block.counts)))
