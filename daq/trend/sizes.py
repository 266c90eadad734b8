"""Lengths of time and sizes as a user types them: 10min, 30d, 500MB, 200GB."""

from __future__ import annotations

import re
from dataclasses import dataclass

from daq.base.contract.errors import ConfigError

SECONDS_OF_UNIT = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "w": 604800.0, "y": 31_557_600.0}
BYTES_OF_UNIT = {"kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
_AMOUNT_PATTERN = re.compile(r"\s*(\d+(?:\.\d+)?)\s*([A-Za-z]+)\s*")
MIN_SEGMENT_S, MIN_SEGMENT_BYTES = 1.0, 10**6
DEFAULT_FREE_BYTES = 10**9  # of the disk stay free where anything may be removed at all


def amount(text: str, option: str) -> tuple[float | None, int | None]:
    """(seconds, None) or (None, bytes). Raises ConfigError that names the option."""
    found = _AMOUNT_PATTERN.fullmatch(text)
    unit = found[2] if found else ""
    value = float(found[1]) if found else 0.0
    seconds = {k.lower(): v for k, v in SECONDS_OF_UNIT.items()}.get(unit.lower())
    size = {k.lower(): v for k, v in BYTES_OF_UNIT.items()}.get(unit.lower())
    if value > 0 and seconds is not None:
        return value * seconds, None
    if value > 0 and size is not None:
        return None, int(value * size)
    units = ", ".join([*SECONDS_OF_UNIT, *BYTES_OF_UNIT])
    raise ConfigError(
        f"{option} {text}: give a number above 0 and a unit, such as 10min, 30d, 500MB or 200GB ({units})"
    )


def duration_s(text: str, option: str) -> float:
    """Seconds. Raises ConfigError for a size, or what is none of both."""
    seconds, _ = amount(text, option)
    if seconds is None:
        raise ConfigError(f"{option} {text}: is a size; give a time, such as 30s, 1h or 7d")
    return seconds


def size_bytes(text: str, option: str) -> int:
    """Bytes. Raises ConfigError for a time, or what is none of both."""
    _, size = amount(text, option)
    if size is None:
        raise ConfigError(f"{option} {text}: is a time; give a size, such as 500MB or 2GB")
    return size


@dataclass(frozen=True, slots=True, kw_only=True)
class Cut:
    """When a segment ends, and which samples are stored.

    seconds, size_bytes : of a segment at most; None: no limit.
    every_s, for_s : of each `every_s` of data the first `for_s` are stored; None: all.
    """

    seconds: float | None = None
    size_bytes: int | None = None
    every_s: float | None = None
    for_s: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Keep:
    """Limits of the segments that are kept. None: no limit.

    age_s : seconds since the end of a segment. size_bytes : of all segments. free_bytes : of the disk.
    alarms_too : segments with an alarm are removed like the others.
    """

    age_s: float | None = None
    size_bytes: int | None = None
    free_bytes: int = 0
    alarms_too: bool = False

    @property
    def anything(self) -> bool:
        """Whether anything may be removed at all."""
        return self.age_s is not None or self.size_bytes is not None or self.free_bytes > 0


def asked_cut(segment: str | None, every: str | None, length: str | None) -> Cut | None:
    """--segment, --every and --for; None if none of them is given. Raises ConfigError."""
    if (every is None) != (length is None):
        raise ConfigError("--every and --for go together: such as --every 1h --for 30s")
    if segment is None and every is None:
        return None
    seconds, size = (None, None) if segment is None else amount(segment, "--segment")
    if seconds is not None and seconds < MIN_SEGMENT_S:
        raise ConfigError(f"--segment {segment}: a segment has {MIN_SEGMENT_S:g} s at least")
    if size is not None and size < MIN_SEGMENT_BYTES:
        raise ConfigError(f"--segment {segment}: a segment has 1MB at least")
    if every is None or length is None:
        return Cut(seconds=seconds, size_bytes=size)
    every_s, for_s = duration_s(every, "--every"), duration_s(length, "--for")
    if not MIN_SEGMENT_S <= for_s < every_s:
        raise ConfigError(f"--for {length}: must be from 1s to below --every {every}")
    return Cut(seconds=seconds, size_bytes=size, every_s=every_s, for_s=for_s)


def asked_keep(limits: list[str], free: str | None, alarms_too: bool) -> Keep:
    """--keep (an age, a size or both), --keep-free, --remove-alarms. Raises ConfigError."""
    age_s, size = None, None
    for text in limits:
        seconds, own = amount(text, "--keep")
        age_s, size = (age_s if seconds is None else seconds), (size if own is None else own)
    free_bytes = size_bytes(free, "--keep-free") if free is not None else DEFAULT_FREE_BYTES if limits else 0
    return Keep(age_s=age_s, size_bytes=size, free_bytes=free_bytes, alarms_too=alarms_too)
