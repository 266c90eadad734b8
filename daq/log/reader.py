"""A log as one object (`read_log`): facts of the session, and samples that are read on request."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.base.console.file_kinds import content, other_kind
from daq.base.console.memory import roomy
from daq.base.contract.errors import LogError
from daq.base.contract.part import WHOLE_RECORD, Part, beyond
from daq.base.contract.scaling import Scaling, now_at
from daq.base.contract.sink import ClockState, Status
from drivers.contract import Gap, Info, Notice, Reading

from .codec import RawBlock
from .entries import Entry, Head, LoggedEstimate, Other, Said, walk
from .part import Span, beginning, inside, span
from .place import being_written
from .scan import Findings, ends_closed

if TYPE_CHECKING:
    from daq.rig.rig import Rig

MOST_EVENTS = 2_000_000  # gaps, notices, estimates, damage: a few kB of a hostile file can unpack to any number
LARGEST_SAMPLES = 64 << 30  # bytes that samples() or counts() may allocate


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A log. Its samples are read from the file when they are asked for.

    path : of the file.
    head : device, clock offset and metadata of the session.
    info : first description of the device: channels, rate, scaling.
    first, stop : absolute sample index of the first sample, and of the one after the last.
    lost_samples : samples of each channel that are missing between `first` and `stop`.
    gaps : index, count and reason of each gap, in order.
    notices : notices to the operator, in order.
    estimates : all logged estimates, in order.
    clocks : (sample index, mapping of device to host clock) for each statement of the clock.
    last_status : the last status; None if there is none.
    findings : what the pass over the file found.
    started_ns : Unix time of the first sample, ns; None of a recording whose source says no date.
    growing : another process is writing the log; it was read up to `stop`.
    others : samples under a later description of the device that is no continuation of `info` (another rate, channels
        or unit); `counts` and `samples` leave them out like a gap.
    device_info : `info` with all channels of the device.
    span : the part of the log that was read; None: all of it. Everything else is of that part alone.
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
    device_info: Info = field(kw_only=True, repr=False)
    span: Span | None = field(default=None, kw_only=True)

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
    def from_s(self) -> float | None:
        """Where a part begins, s of device time from the first sample of the log; None if it is the whole log."""
        return None if self.span is None else (self.first - self.span.origin) / self.rate_hz

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
        """Faults of the file, one line each."""
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
            columns, start = self._columns(info), block.index - self.first
            if not isinstance(columns, str):
                out[start : start + len(block.counts)] = block.counts[:, columns]
        return out

    def samples(
        self,
        rig: Rig | None = None,
        note: Callable[[str], None] = warnings.warn,
        *,
        dtype: type[np.float64] | type[np.float32] = np.float64,
    ) -> NDArray[np.float64]:
        """Samples in SI units, as the estimator takes them.

        Parameters
        ----------
        rig : Rig, optional
            Select the channels of this rig, in its order, and check them against it. None: every channel of the log
            in the order of `channels`, with values at full scale kept.
        note : callable, optional
            Called with one line for each thing to know: missing samples, values at full scale, a rate that is not
            that of the rig file. It issues a warning unless given.
        dtype : type, optional
            ``numpy.float32`` takes half the memory and rounds a sample by 6e-8 of its value, less than any sensor.

        Returns
        -------
        (stop - first, channels) of `dtype`
            m/s^2, m/s, m or N; NaN in the rows of a gap and, with a rig, where a value is at full scale.

        Raises
        ------
        LogError
            A channel of the rig is missing or in another unit, the log holds no samples, the band of the rig does not
            lie below half the sampling rate, or the samples do not fit into memory.
        """
        if rig is None:
            return self._in_si(list(range(len(self.channels))), keep_clipped=True, dtype=dtype)[0]
        from .rig_samples import rig_samples

        return rig_samples(self, rig, note, dtype)[0]

    def unclipped(
        self, columns: list[int], dtype: type[np.float64] | type[np.float32] = np.float64
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """(stop - first, columns) in SI with NaN for gaps and values at full scale; (columns,) count of the latter."""
        return self._in_si(columns, keep_clipped=False, dtype=dtype)

    def _in_si(
        self, columns: list[int], keep_clipped: bool, dtype: type[np.float64] | type[np.float32]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        self._affordable(np.dtype(dtype).itemsize)
        out = roomy((self.stop - self.first, len(columns)), dtype)
        at, hits, scaling, of = 0, np.zeros(len(columns), np.int64), None, None
        for block, info in self._blocks():
            if info is not of:
                there, of = self._columns(info), info
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
        """Readings of the link, in order, a piece at a time: for replay. Memory does not grow with the log.

        joined : blocks as the log holds them, several of the link in one; False: as they came.
        """
        columns: list[int] = []  # of a block that are chosen; [] for all
        for entry in self._entries():
            if isinstance(entry, Info):
                there = [] if self.info is self.device_info else self._columns(entry)
                columns = [] if isinstance(there, str) else there
                yield replace(entry, signals=tuple(entry.signals[k] for k in columns)) if columns else entry
            elif isinstance(entry, RawBlock):
                if columns:
                    entry = replace(entry, counts=entry.counts[:, columns])
                if joined:
                    yield entry.joined()
                else:
                    yield from entry.parts()
            elif isinstance(entry, Gap | Notice):
                yield entry

    def estimate_bytes(self) -> Iterator[bytes]:
        """The logged estimates in order, as the log holds them."""
        return (logged.data for logged in self.estimates)

    def again(self) -> Findings:
        """Findings for another pass over the bytes that the first pass saw: a log may be growing."""
        return beginning(self.findings)

    def _columns(self, info: Info) -> list[int] | str:
        """Columns of the log's channels in a description of its device, or why its samples do not continue."""
        there = now_at(self.device_info, info)
        if isinstance(there, str) or self.info is self.device_info:
            return there
        names = [s.name for s in self.device_info.signals]
        return [there[names.index(name)] for name in self.channels]

    def _blocks(self) -> Iterator[tuple[RawBlock, Info]]:
        info = self.device_info
        for entry in self._entries():
            if isinstance(entry, Info):
                info = entry
            elif isinstance(entry, RawBlock):
                yield entry, info

    def _entries(self) -> Iterator[Entry]:
        return _entries(self.path, self.again(), self.span)

    def _affordable(self, item_bytes: int) -> None:
        needed = (self.stop - self.first) * max(1, len(self.channels)) * item_bytes
        sparse = self.lost_samples > 100 * self.n_samples + 10_000_000
        if needed > LARGEST_SAMPLES or sparse:
            raise LogError(
                f"{self.path}: its {self.n_samples} samples spread over {self.stop - self.first} indices, "
                "too many to hold at once; replay it, or export the part between the gaps"
            )


def read_log(path: str | Path, *, part: Part = WHOLE_RECORD, max_events: int = MOST_EVENTS) -> Recording:
    """Read a log (MCAP), in one pass that checks every chunk; samples are read when they are asked for.

    Parameters
    ----------
    path : path
        The log. One that is being written is read up to where it is now.
    part : Part
        The part of it to read; what lies outside in time is neither read nor checked.
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
    ConfigError
        Nothing lies in the part, or the log does not have one of its channels.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from daq import Part, acquire, load_rig, read_log
    >>> rig = load_rig("configs/one_bearing.toml")
    >>> with TemporaryDirectory() as folder:
    ...     summary = acquire(rig, "virtual:", seconds=0.5, out=f"{folder}/bearing.mcap")
    ...     log = read_log(f"{folder}/bearing.mcap")
    ...     y = log.samples(rig)
    ...     end = read_log(f"{folder}/bearing.mcap", part=Part(from_s=0.4)).samples(rig)
    >>> y.shape, log.rate_hz, log.complete, end.shape
    ((6400, 2), 12800.0, True, (1280, 2))
    """
    path = Path(path)
    findings, of = _part(path, part) if part.of_time else (Findings(), None)
    return _recording(path, part, findings, of, max_events)


def _recording(path: Path, part: Part, findings: Findings, of: Span | None, max_events: int) -> Recording:
    written = being_written(path)
    said = _said(path, _entries(path, findings, of), findings, max_events)
    if said.info is None and written:
        raise LogError(f"{path}: is being written, and holds nothing yet; try again when samples have come")
    if said.info is None:
        if what := other_kind(path):
            raise LogError(f"{path}: {what}")
        if what := content(path):
            raise LogError(f"{path}: {what}")
        what = "nothing in it is intact" if findings.damage else "it holds no session"
        raise LogError(f"{path}: no Rotorscope log can be read from it: {what}; check that it is the right file")
    if of is not None and said.first is None:
        rest = _said(path, _entries(path, beginning(findings), replace(of, first=0, stop=None)), findings, max_events)
        raise beyond(path, (max(rest.stop, of.origin) - of.origin) / said.info.rate_hz)
    if of is not None and not findings.closed:
        findings.closed = ends_closed(path, findings)
    names, info = part.chosen(path, [s.name for s in said.info.signals]), said.info
    if part.channels:
        info = replace(info, signals=tuple(s for s in info.signals if s.name in names))
    return Recording(
        path=path, head=said.head, info=info, first=said.first or 0, stop=said.stop, lost_samples=said.lost,
        gaps=tuple(said.gaps), notices=tuple(said.notices), estimates=tuple(said.estimates),
        clocks=tuple(said.clocks), last_status=said.status, findings=findings,
        growing=written and not findings.closed, others=tuple(said.others), started_ns=said.started_ns,
        device_info=said.info, span=of,
    )  # fmt: skip


def _said(path: Path, entries: Iterator[Entry], findings: Findings, most: int, first_only: bool = False) -> Said:
    """Content of the entries; first_only : up to the first sample. Raises LogError if they are too many."""
    said = Said()
    for entry in entries:
        said.take(entry)
        if said.events + len(findings.damage) > most:
            text = f"holds more than {most} gaps, notices and estimates; it was not made by Rotorscope"
            raise LogError(f"{path}: {text}")
        if first_only and isinstance(entry, RawBlock):
            break
    return said


def _part(path: Path, part: Part) -> tuple[Findings, Span | None]:
    """Where a part of a log is, and the findings of the log's beginning: its attachments."""
    findings = Findings(partial=True)
    said = _said(path, _entries(path, findings, None), findings, MOST_EVENTS, first_only=True)
    if said.info is None or said.first is None:
        return Findings(), None
    of = span(path, part, said.started_ns, said.info, said.first, findings)
    return findings if of.at else beginning(findings), of


def _entries(path: Path, findings: Findings, of: Span | None) -> Iterator[Entry]:
    """The entries of a log, or of a part of it."""
    if of is None:
        yield from (entry for entry, _ in walk(path, findings) if entry is not None)
        return
    info, within = None, False
    for entry, _ in walk(path, findings, at=of.at):
        if entry is None:
            continue
        if isinstance(entry, Info):
            info = entry
        elif isinstance(entry, RawBlock | Gap) and info is not None:
            if of.stop is not None and entry.index >= of.stop:
                return
            kept = inside(entry, of, info)
            within = within or kept is not None
            if kept is not None:
                yield kept
            continue
        if within or isinstance(entry, Head | Info):
            yield entry
