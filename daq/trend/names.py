"""Names of segments: the measured machine, the start (UTC), and a mark for an alarm."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

ALARM_CODE, ALARM_OVER_CODE, ALARM_LEARNED_CODE = "alarm", "alarm_over", "alarm_learned"  # of notices
ALARM_MARK = "_alarm"  # at the end of a segment's name
TREND_FOLDER = "trend"  # beside the segments
ALARM_MEMORY = "alarms.json"  # in it: what was learned
SEGMENTS_KEY, NUMBER_KEY, SCHEDULE_KEY = "segments", "segment", "every"  # of the metadata of a segment
SEGMENT_NAME = re.compile(r"(?P<stem>.*)_(?P<time>\d{8}T\d{6}\.\d{3}Z)(?:-\d+)?(?P<alarm>_alarm)?\.mcap")
_UNFIT_CHARACTERS = re.compile(r"[^\w.-]+")


@dataclass(frozen=True, slots=True)
class Segment:
    """A segment in a folder. start_ns : Unix time of its first sample, by its name."""

    path: Path
    start_ns: int
    alarm: bool


def segment_name(stem: str, start_ns: int) -> str:
    """The file name of a segment. stem : what is measured; start_ns : Unix time of the first sample."""
    time = datetime.fromtimestamp(start_ns // 10**9, UTC)
    return f"{_UNFIT_CHARACTERS.sub('-', stem) or 'log'}_{time:%Y%m%dT%H%M%S}.{start_ns // 10**6 % 1000:03d}Z.mcap"


def segment_of(path: Path) -> Segment | None:
    """The segment that a file is by its name; None if it is none."""
    found = SEGMENT_NAME.fullmatch(path.name)
    if found is None:
        return None
    try:
        time = datetime.strptime(found["time"], "%Y%m%dT%H%M%S.%fZ").replace(tzinfo=UTC)
    except ValueError:
        return None
    return Segment(path, round(time.timestamp() * 1000) * 10**6, bool(found["alarm"]))


def segments(folder: Path) -> list[Segment]:
    """The segments of a folder, in the order of their times."""
    return sorted(_segments(folder), key=lambda segment: (segment.start_ns, segment.path.name))


def _segments(folder: Path) -> Iterator[Segment]:
    for path in folder.iterdir():
        segment = segment_of(path)
        if segment is not None and path.is_file():
            yield segment


def marked(path: Path) -> Path:
    """The name of a segment with an alarm."""
    return path if path.stem.endswith(ALARM_MARK) else path.with_stem(path.stem + ALARM_MARK)
