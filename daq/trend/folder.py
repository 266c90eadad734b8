"""The sessions of a folder of segments, each read as one log."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from daq.base.contract.errors import LogError
from daq.log.codec import RawBlock
from daq.log.entries import Head, LoggedEstimate, Said, walk
from daq.log.scan import Findings
from drivers.contract import Gap, Info, Notice, Reading

from .names import NUMBER_KEY, SCHEDULE_KEY, SEGMENTS_KEY, segments

SCHEDULE_GAP, MISSING_GAP = "schedule", "log"  # reasons of a gap between two segments


@dataclass(frozen=True, slots=True, kw_only=True)
class Beginning:
    """How a segment begins. first : index of its first sample or gap; started_ns : Unix time, None if not known."""

    path: Path
    head: Head
    info: Info
    first: int
    started_ns: int | None
    attachments: Mapping[str, bytes]

    @property
    def session(self) -> str:
        """Name of the session of the segment; a plain log is a separate session."""
        return self.head.metadata.get(SEGMENTS_KEY, str(self.path))

    @property
    def number(self) -> int:
        """Number of the segment in its session, from 1."""
        text = self.head.metadata.get(NUMBER_KEY, "1")
        return int(text) if text.isdecimal() else 1


def beginning(path: Path) -> Beginning | None:
    """How a segment begins, without reading the rest; None if it holds no sample. Raises LogError if it is no log."""
    findings, said = Findings(partial=True), Said()
    for entry, _ in walk(path, findings):
        if entry is not None:
            said.take(entry)
        if isinstance(entry, RawBlock):
            break
    if said.info is None or said.first is None:
        return None
    return Beginning(
        path=path, head=said.head, info=said.info, first=said.first, started_ns=said.started_ns,
        attachments={name: content for name, (_, content) in findings.attachments.items()},
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class LoggedSession:
    """The segments of one session as one log, for replay. Memory does not grow with their number.

    path : the folder. parts : how each segment begins, in order. lost_end : name of a segment behind them of which
    nothing can be read, as a full disk leaves it; "" if there is none.
    """

    path: Path
    parts: Sequence[Beginning]
    lost_end: str = ""
    found: dict[Path, Findings] = field(default_factory=dict, repr=False)  # of the segments that were read to the end
    growing: bool = False

    @property
    def head(self) -> Head:
        """Of the first segment."""
        return self.parts[0].head

    @property
    def rate_hz(self) -> float:
        """Sampling rate, Hz."""
        return self.parts[0].info.rate_hz

    @property
    def first(self) -> int:
        """Index of the first sample."""
        return self.parts[0].first

    @property
    def stop(self) -> int:
        """Index of the first sample of the last segment: its length is not known before it is read."""
        return self.parts[-1].first

    @property
    def started_ns(self) -> int | None:
        """Unix time of the first sample, ns; None if it is not known."""
        return self.parts[0].started_ns

    @property
    def rig_text(self) -> str:
        """The rig file of the session. Raises LogError if no segment holds it."""
        text = self.attachments.get("rig.toml")
        if text is None:
            raise LogError(f"{self.path}: no segment holds an intact rig file; give one with --rig")
        return text.decode("utf-8", "replace")

    @property
    def attachments(self) -> Mapping[str, bytes]:
        """The attached files of the first segment that holds the rig file."""
        return next((part.attachments for part in self.parts if "rig.toml" in part.attachments), {})

    @property
    def complete(self) -> bool:
        """Whether every segment was read to its end, closed and intact, and the end of the session is among them."""
        return not self.lost_end and all(
            part.path in self.found and self.found[part.path].complete for part in self.parts
        )

    @property
    def damage(self) -> list[str]:
        """Faults of segments that were closed, one line each."""
        return [f"{path.name}: {text}" for path, own in self.found.items() if own.closed for text in own.damage]

    @cached_property
    def notices(self) -> list[Notice]:
        """The notices in the last segment."""
        return [entry for entry, _ in walk(self.parts[-1].path, Findings()) if isinstance(entry, Notice)]

    @property
    def unlike(self) -> str:
        """Why the estimates of these samples cannot be the logged ones; "" if they can."""
        if SCHEDULE_KEY in self.head.metadata:
            return f"holds {self.head.metadata[SCHEDULE_KEY]}, and the estimates are of all samples"
        numbers = [part.number for part in self.parts]
        if numbers[0] != 1:
            return f"begins with segment {numbers[0]} of its session: those before are removed"
        lacking = next((a + 1 for a, b in zip(numbers, numbers[1:], strict=False) if b != a + 1), None)
        return "" if lacking is None else f"lacks segment {lacking} of its session"

    def readings(self, joined: bool = True) -> Iterator[Reading]:
        """Readings of the link in order; missing samples between two segments are a gap."""
        stop: int | None = None
        reason = SCHEDULE_GAP if SCHEDULE_KEY in self.head.metadata else MISSING_GAP
        for part in self.parts:
            findings = Findings()
            for entry, _ in walk(part.path, findings):
                if isinstance(entry, RawBlock | Gap):
                    if stop is not None and entry.index > stop:
                        yield Gap(stop, entry.index - stop, reason)
                    stop = entry.stop if isinstance(entry, RawBlock) else max(stop or 0, entry.index + entry.count)
                if isinstance(entry, RawBlock):
                    yield from [entry.joined()] if joined else entry.parts()
                elif isinstance(entry, Info | Gap | Notice):
                    yield entry
            self.found[part.path] = findings

    def estimate_bytes(self) -> Iterator[bytes]:
        """The logged estimates in order, as the segments hold them."""
        for part in self.parts:
            for entry, _ in walk(part.path, Findings()):
                if isinstance(entry, LoggedEstimate):
                    yield entry.data


def sessions(folder: Path) -> list[LoggedSession]:
    """The sessions of a folder, in the order of their times. Raises LogError if it holds none."""
    found: dict[str, list[Beginning]] = {}
    lost_ends: dict[str, str] = {}
    before = ""
    for segment in segments(folder):
        begins = beginning(segment.path)
        if begins is not None:
            before = begins.session
            found.setdefault(before, []).append(begins)
        lost_ends[before] = "" if begins is not None else segment.path.name
    if not found:
        raise LogError(f"{folder}: holds no segments; give a folder that `rotorscope run --segment` wrote, or a log")
    ordered = {session: sorted(parts, key=lambda part: part.number) for session, parts in found.items()}
    return [LoggedSession(path=folder, parts=ordered[one], lost_end=lost_ends[one]) for one in ordered]
