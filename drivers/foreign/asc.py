"""Vector .asc: classic and FD frames by number or by the name of the message; times absolute or relative.

Other events (status, statistics, other buses, comments) are recognised by their first words and left out. A line that
may be a damaged frame is counted as damage. A trigger block that restarts at zero is placed by its date.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Mapping
from datetime import datetime
from pathlib import Path

from drivers.can.can_frames import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from drivers.can.slcan_codec import FD_LENGTHS
from drivers.contract.errors import LinkOpenError

from .capture_batches import LARGEST_ID, LATEST_NS, Batch, Collector
from .text_lines import bounded, open_text

SEAM_NS = 1_000_000_000  # between two trigger blocks whose distance is unknown
_STAMP_FORM = r"(-?\d+[.,]\d+)"
_CLASSIC_LINE = re.compile(_STAMP_FORM + r"\s+(\d+)\s+(\S+)\s+(Rx|Tx|TxRq)\s+([dr])\b\s*(.*)", re.ASCII | re.IGNORECASE)
_FD_LINE = re.compile(_STAMP_FORM + r"\s+CANFD\s+(\d+)\s+(Rx|Tx|TxRq)\s+(\S+)\s+(.*)", re.ASCII | re.IGNORECASE)
_ERROR_LINE = re.compile(
    _STAMP_FORM + r"\s+(?:CANFD\s+)?(\d+)\s+(?:(?:Rx|Tx)\s+)?ErrorFrame\b", re.ASCII | re.IGNORECASE
)
_OTHER_LINE = re.compile(
    r"$|//|;|date\s|base\s|(?:no\s+)?internal\s+events\s+logged|begin\s+trigger|end\s+trigger|previous\s+log|"
    + _STAMP_FORM
    + r"\s+(?:CAN\s+\d+\s+Status|\d+\s+(?:Statistic|J1939TP|OverloadFrame)|Start\s+of\s+measurement"
    r"|(?!CAN)[A-Z][A-Z0-9_]+[\s:])",
    re.ASCII | re.IGNORECASE,
)
_ANY_STAMP = re.compile(_STAMP_FORM + r"\s")
_BASE_LINE = re.compile(r"base\s+(hex|dec)(?:\s+timestamps\s+(absolute|relative))?", re.IGNORECASE)
_DATE_LINE = re.compile(r"(date|begin\s+triggerblock)\b(.*)", re.IGNORECASE)
_MONTH_OF_NAME = {
    "jan": 1, "feb": 2, "mar": 3, "mär": 3, "mrz": 3, "apr": 4, "may": 5, "mai": 5, "jun": 6, "jul": 7, "aug": 8,
    "sep": 9, "oct": 10, "okt": 10, "nov": 11, "dec": 12, "dez": 12,
}  # fmt: skip
_DATE_FORM = re.compile(
    r"([^\W\d]{3})\w*\.?\s+(\d{1,2})\s+(\d{1,2}):(\d\d):(\d\d)(?:[.,](\d{1,6}))?\s*(am|pm|vorm\.|nachm\.)?\s+(\d{4})",
    re.IGNORECASE,
)  # fmt: skip


def asc_batches(file: Path, names: Mapping[str, int] | None) -> Generator[Batch, None, None]:
    """Batches of frames of an .asc file. names : message -> identifier with flags; None without a DBC.

    Raises LinkOpenError.
    """
    with open_text(file) as handle:
        reader = _Reader(file, names)
        for line in bounded(handle):
            reader.line(line.strip())
            if reader.out.full:
                yield reader.out.take()
        yield reader.out.take()


def when(text: str) -> float | None:
    """Seconds since 1970 of a date such as "Nov 14 10:13:20.000 pm 2023", in this computer's time zone."""
    match = _DATE_FORM.search(text)
    if match is None or match[1].lower() not in _MONTH_OF_NAME:
        return None
    hour = int(match[3])
    if match[7] is not None and hour <= 12:
        hour = hour % 12 + (12 if match[7][0].lower() in "pn" else 0)
    micro = int((match[6] or "0").ljust(6, "0"))
    try:
        return datetime(
            int(match[8]), _MONTH_OF_NAME[match[1].lower()], int(match[2]), hour, int(match[4]), int(match[5]), micro
        ).timestamp()  # fmt: skip
    except (ValueError, OverflowError, OSError):
        return None


class _Reader:
    def __init__(self, file: Path, names: Mapping[str, int] | None) -> None:
        self.out = Collector()
        self._file, self._names = file, names
        self._number = 0
        self._base = 16
        self._relative = False
        self._blocks = 0
        self._date_s: float | None = None  # of the measurement
        self._block_s: float | None = None  # of a block whose first stamp is awaited
        self._block_open = False  # a block has started and its first stamp is awaited
        self._origin_ns = 0  # what a stamp counts from
        self._last_ns: int | None = None  # of the last line, with the origin
        self._left_out: set[str] = set()

    def line(self, text: str) -> None:
        self._number += 1
        if _ANY_STAMP.match(text):
            self._event(text)
        elif match := _BASE_LINE.match(text):
            self._base = 10 if match[1].lower() == "dec" else 16
            self._relative = (match[2] or "").lower() == "relative"
            if self._relative:
                self.out.warn("relative_times", "its time stamps are relative (differences): added up")
        elif match := _DATE_LINE.match(text):
            date_s = when(match[2])
            if match[1].lower() == "date":
                self._date_s = date_s
                self._origin_ns = round((date_s or 0.0) * 1e6) * 1000
            else:
                self._blocks += 1
                self._block_open, self._block_s = True, date_s
        elif not _OTHER_LINE.match(text):
            self._odd()

    def _odd(self) -> None:
        self.out.damage(f"line {self._number} is neither a frame nor an event of another kind")

    def _event(self, text: str) -> None:
        classic = _CLASSIC_LINE.match(text)
        fd = None if classic else _FD_LINE.match(text)
        match = _ERROR_LINE.match(text) or classic or fd or _OTHER_LINE.match(text)
        if match is None:
            self._odd()
            return
        t_ns = self._time(match[1])
        if abs(t_ns) > LATEST_NS:
            self.out.damage(f"line {self._number}: a frame at {match[1]} s")
        elif match.re is _ERROR_LINE:
            self.out.frame((ERROR_FLAG, b"", t_ns), str(int(match[2])), False)
        elif match is classic or match is fd:
            try:
                self._frame(match, match is classic, t_ns)
            except ValueError as error:
                self.out.damage(f"line {self._number}: {error}")

    def _time(self, stamp: str) -> int:
        whole, _, part = stamp.replace(",", ".").partition(".")
        seconds = abs(int(whole)) * 1_000_000_000 + int(part[:9].ljust(9, "0"))
        stamp_ns = -seconds if stamp.startswith("-") else seconds
        if self._block_open:
            self._begin(stamp_ns)
        begin_ns = self._last_ns if self._relative and self._last_ns is not None else self._origin_ns
        t_ns = begin_ns + stamp_ns
        self._last_ns = t_ns
        return t_ns

    def _begin(self, stamp_ns: int) -> None:
        """Set the origin by the first stamp of a block. A stamp that goes back counts from the date of its block."""
        self._block_open = False
        last_ns = self._last_ns
        if last_ns is None or not (self._relative or self._origin_ns + stamp_ns < last_ns):
            return
        block_ns = None if self._block_s is None else round(self._block_s * 1e6) * 1000
        if block_ns is not None and self._date_s is not None and block_ns + stamp_ns >= last_ns:
            self._origin_ns = block_ns
            text = (
                f"trigger block {self._blocks} begins anew: placed by its date, {(block_ns - last_ns) / 1e9:.6g} s on"
            )
        else:
            self._origin_ns = last_ns + SEAM_NS
            text = f"trigger block {self._blocks} begins anew, and its date does not say when: counted as 1 s later"
        if self._relative:
            self._last_ns = self._origin_ns
        self.out.warn("trigger_blocks", text)

    def _frame(self, match: re.Match[str], classic: bool, t_ns: int) -> None:
        """Add the frame of a line. Raises ValueError."""
        if classic:
            _, bus, token, direction, kind, rest = match.groups()
            words = rest.split()
            remote = kind.lower() == "r"
            code = int(words[0], self._base) if words and not remote else 0
            length, words = min(8, FD_LENGTHS[code] if 0 <= code < 16 else 64), words[1:]
        else:
            _, bus, direction, token, rest = match.groups()
            words = rest.split()
            if words and not words[0].isdigit():
                words = words[1:]  # the name of the message
            if len(words) < 4:
                raise ValueError("a CAN FD frame without a length")
            length, words, remote = int(words[3]), words[4:], False
            if not 0 <= length <= 64:
                raise ValueError(f"a frame of {length} bytes")
        identifier = self._identifier(token)
        if identifier is None or direction.lower() == "txrq":  # a request to send is no frame on the bus
            return
        data = b""
        if remote:
            identifier |= REMOTE_FLAG
        else:
            data = bytes(int(each, self._base) for each in words[:length])
            if len(data) < length:
                raise ValueError(f"a frame of {length} bytes has {len(data)}")
        self.out.frame((identifier, data, t_ns), str(int(bus)), direction.lower() == "tx")

    def _identifier(self, token: str) -> int | None:
        """Identifier with its flags; None for a name that is not in the DBC. Raises ValueError."""
        extended = token[-1] in "xX"
        try:
            number = int(token[:-1] if extended else token, self._base)
        except ValueError:
            number = -1
        if 0 <= number <= (LARGEST_ID if extended else 0x7FF):
            return number | EXTENDED_FLAG if extended else number
        if not re.match(r"[A-Za-z_]", token):
            raise ValueError(f"a frame of identifier {token}")
        if self._names is None:
            text = f"messages by their names ({token}, line {self._number}), which need a DBC: set link.dbc"
            raise LinkOpenError(f"capture:{self._file}: {text}, or export with numeric identifiers")
        found = self._names.get(token)
        if found is None and not self._left_out:
            self._left_out.add(token)
            text = (
                f"messages by their names, some of which the DBC does not have ({token}, line {self._number}): left out"
            )
            self.out.warn("symbolic_names", text)
        return found
