"""The part of a record that is asked for: --from, --to, --seconds and --channels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from .dates import utc_text
from .errors import ConfigError

ROW_ROUNDING = 1e-6  # of a sample: 0.1 s at 25600 Hz is row 2560, whatever the floats say
LONGEST_S = 1e12  # longer than any record


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """The part of a record that is read.

    from_s, to_s : s from the start of the record; the sample at `to_s` is not read. None: from the start, to the end.
    from_ns, to_ns : Unix time instead, ns.
    seconds : length from the start of the part, instead of an end.
    channels : names, in the order of the rig file or of the log; () for all.
    """

    from_s: float | None = None
    to_s: float | None = None
    from_ns: int | None = None
    to_ns: int | None = None
    seconds: float | None = None
    channels: tuple[str, ...] = ()

    @classmethod
    def asked(cls, start: str | None, stop: str | None, seconds: float | None, channels: str | None) -> Part:
        """From the texts of the command line. Raises ConfigError: one line, what is wrong and what to write."""
        if stop is not None and seconds is not None:
            raise ConfigError("two ends of the part are said, a time and --seconds: give one of them")
        from_s, from_ns = _time("--from", start)
        to_s, to_ns = _time("the end", stop)
        names = tuple(dict.fromkeys(name.strip() for name in (channels or "").split(",") if name.strip()))
        if channels is not None and not names:
            raise ConfigError("--channels names none: give names with commas between, such as --channels b1x,b1y")
        if seconds is not None and not 0 < seconds < LONGEST_S:
            raise ConfigError(f"--seconds {seconds:g} is no length; give seconds above 0, or leave it out")
        part = cls(from_s=from_s, to_s=to_s, from_ns=from_ns, to_ns=to_ns, seconds=seconds, channels=names)
        if (from_s is not None and to_s is not None and from_s >= to_s) or (from_ns and to_ns and from_ns >= to_ns):
            raise ConfigError(f"--from {start} is not before the end, {stop}: the part is empty")
        if to_s == 0:
            raise ConfigError("the end is the start of the record: the part is empty")
        return part

    @property
    def of_time(self) -> bool:
        """Whether the part leaves out anything by time."""
        return any(t is not None for t in (self.from_s, self.to_s, self.from_ns, self.to_ns, self.seconds))

    @property
    def dated(self) -> bool:
        """Whether a time is a date."""
        return self.from_ns is not None or self.to_ns is not None

    def __bool__(self) -> bool:
        return self.of_time or bool(self.channels)

    def span(self, where: object, started_ns: int | None) -> tuple[float, float]:
        """Start and end in s from the start of a record, which began at `started_ns`; the end is inf if it is open.

        Raises ConfigError, naming `where`, if the record has no date, or the part lies before it or is empty.
        """
        if self.dated and started_ns is None:
            raise ConfigError(f"{where}: says no date; give times in seconds from its start")
        start_ns = started_ns or 0
        start = self.from_s or 0.0
        if self.from_ns is not None:
            start = (self.from_ns - start_ns) / 1e9
        stop = math.inf if self.to_s is None else self.to_s
        if self.to_ns is not None:
            stop = (self.to_ns - start_ns) / 1e9
        if self.seconds is not None:
            stop = start + self.seconds
        if stop <= 0:
            raise ConfigError(f"{where}: begins at {utc_text(start_ns)}: the part lies before it")
        if start >= stop:
            raise ConfigError(f"{where}: the part ends {stop:.6g} s after the start of the record, where it begins")
        return max(start, 0.0), stop

    def rows(self, where: object, rate_hz: float, started_ns: int | None) -> tuple[int, int | None]:
        """First row and the one after the last, None if open, of samples at k / rate_hz. Raises as `span`."""
        start, stop = self.span(where, started_ns)
        first = math.ceil(start * rate_hz - ROW_ROUNDING)
        last = None if math.isinf(stop) else math.ceil(stop * rate_hz - ROW_ROUNDING)
        if last is not None and last <= first:
            text = f"no sample lies from {start:.9g} s to {stop:.9g} s: they are {1 / rate_hz:.3g} s apart"
            raise ConfigError(f"{where}: {text}")
        return first, last

    def chosen(self, where: object, held: Sequence[str]) -> tuple[str, ...]:
        """The channels of `held` that are asked for, in the order of `held`. Raises ConfigError for an unknown one."""
        for name in self.channels:
            if name not in held:
                raise ConfigError(f'{where}: --channels: there is no channel "{name}"; it has {", ".join(held)}')
        return tuple(name for name in held if not self.channels or name in self.channels)


WHOLE_RECORD = Part()


def beyond(where: object, seconds: float) -> ConfigError:
    """Error: the part begins behind the end of the record."""
    return ConfigError(f"{where}: is {seconds:.6g} s long; there is nothing from --from on: give less")


def _time(option: str, text: str | None) -> tuple[float | None, int | None]:
    """Seconds from the start of a record, or Unix time in ns."""
    if text is None:
        return None, None
    said = text.strip()
    try:
        seconds = float(said)
    except ValueError:
        return None, _date(option, said)
    if not 0 <= seconds < LONGEST_S:
        raise ConfigError(f"{option} {text}: is no time from the start of a record; give seconds, 0 or more")
    return seconds, None


def _date(option: str, said: str) -> int:
    try:
        time = datetime.fromisoformat(said)
        whole = time.replace(microsecond=0)
        return round(whole.timestamp()) * 10**9 + time.microsecond * 1000  # without a zone: that of this computer
    except (ValueError, OverflowError, OSError) as error:
        text = "give seconds from the start of the record, or a date such as 2024-05-31T13:05:00Z"
        raise ConfigError(f'{option} "{said}" is no time; {text}') from error
