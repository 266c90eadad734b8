"""Dates of recordings: Unix times in a log, and the metadata where the source gives no date."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

SINCE_2001_NS = 10**18  # host times of a recording from here on are Unix times; a computer's uptime is never so long
LATEST_NS = 253_402_300_800 * 10**9  # the year 10000: no time that a text can say
UNKNOWN_START = "unknown"  # metadata "started" of a recording whose source says no date


@dataclass(frozen=True, slots=True)
class Recorded:
    """A log of what was recorded before: it is dated by its samples, and nothing in it is stamped with today.

    wall_offset_ns : Unix time minus host time of the blocks; None: host times since 2001 are Unix times, others have
    no date, and are laid so that the first sample is of now, and metadata "started" says that it is unknown.
    """

    wall_offset_ns: int | None = None


def utc_text(unix_ns: int) -> str:
    """A time as text, to the microsecond: 2023-11-14T22:13:20.000000Z."""
    seconds, rest_ns = divmod(unix_ns, 10**9)
    whole = datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    return f"{whole}.{rest_ns // 1000:06d}Z"


def unix_ns(text: str) -> int | None:
    """The time that an ISO text says; None if it is none, or without a zone."""
    try:
        time = datetime.fromisoformat(text.strip())
    except ValueError:
        return None
    if time.tzinfo is None:
        return None
    whole = time.replace(microsecond=0)
    return round(whole.timestamp()) * 10**9 + time.microsecond * 1000
