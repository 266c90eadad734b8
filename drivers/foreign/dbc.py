"""A DBC file as its makers write it: its text in any encoding, and the messages and signals that a map names.

cantools reads the file. It refuses two things that the format allows, which are removed first: a byte order mark, and
bit timing in `BS_:`.
"""

from __future__ import annotations

import codecs
import difflib
import logging
import re
from dataclasses import dataclass
from typing import Any

from drivers.contract.errors import LinkError

_BIT_TIMING = re.compile(r"^[ \t]*BS_[ \t]*:[^\r\n]*", re.MULTILINE)
_QUOTED_QUOTE = re.compile(r'\\"')
_HEX_NAME = re.compile(r"0x([0-9a-fA-F]{1,8})")
_EXTENDED_BIT = 0x8000_0000
_NAMES_SHOWN = 8  # of a DBC, where one is not there
_MIN_MEASURED_BITS = 8  # a shorter signal is a list of states, whose last code is one of them
_NO_VALUE = re.compile(
    r"sna|n/?a|nan|not? ?avail\w*|invalid\w*|not ?valid|err(or)?\w*|fault\w*|fail\w*|undef\w*|un(available|known)"
    r"|no ?(value|data|signal)|init\w*|missing|reserv\w*|(over|under) ?(flow|range)\w*|out ?of ?range"
    r"|ung(ü|ue)ltig\w*|fehler\w*|unbekannt\w*|kein ?(wert|signal)|erreur\w*|inconnue?|indisponible",
    re.IGNORECASE,
)  # fmt: skip
_NO_VALUE_IN_TEXT = re.compile(
    r"\b(sna|not|no|non|invalid\w*|error\w*|fault\w*|fail\w*|un(available|known|defined)|missing|broken|defect\w*"
    r"|nicht|kein\w*|ung(ü|ue)ltig\w*|fehler\w*|defekt\w*|erreur\w*)\b",
    re.IGNORECASE,
)


@dataclass(frozen=True, slots=True)
class Database:
    """A DBC file that was read. messages : of cantools. j1939 : the whole file describes a J1939 bus."""

    messages: tuple[Any, ...]
    j1939: bool


def dbc_text(data: bytes) -> str:
    """Text of a DBC file: UTF-8 or UTF-16 by its byte order mark, else UTF-8 if it is valid, else cp1252."""
    for mark, encoding in (
        (codecs.BOM_UTF8, "utf-8"),
        (codecs.BOM_UTF16_LE, "utf-16"),
        (codecs.BOM_UTF16_BE, "utf-16"),
    ):
        if data.startswith(mark):
            return data.decode(f"{encoding}-sig" if encoding == "utf-8" else encoding, "replace").lstrip("\ufeff")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")


def load_dbc(data: bytes) -> Database:
    """The messages of a DBC file. Raises LinkError."""
    import cantools

    log = logging.getLogger("cantools")  # it prints duplicate names, which are reported with the channel
    if not log.handlers:
        log.addHandler(logging.NullHandler())
    text = _BIT_TIMING.sub("BS_:", dbc_text(data))
    text = _QUOTED_QUOTE.sub("''", text)
    try:
        database: Any = cantools.database.load_string(text, "dbc", strict=False)
    except Exception as error:
        said = " ".join(str(error).split())
        raise LinkError(f"the DBC file cannot be read: {said}: check that it is one, and whole") from error
    attributes, defaults = (getattr(database.dbc, n, None) or {} for n in ("attributes", "attribute_definitions"))
    default = getattr(defaults.get("ProtocolType"), "default_value", "")  # BA_DEF_DEF_: of a file that does not say it
    protocol = str(getattr(attributes.get("ProtocolType"), "value", default) or "")
    return Database(tuple(database.messages), protocol.upper().startswith("J1939"))


def find_signals(database: Database, channel: str, path: str) -> tuple[Any, list[Any]]:
    """The message, and its signals of the given name: one for each page that has it. Raises LinkError."""
    where = f"signal map, {channel} = {path!r}"
    name, _, signal_name = path.partition(".")
    if not signal_name:
        raise LinkError(f"{where}: write Message.Signal")
    message = _message(database, name, signal_name, where)
    signals = [each for each in message.signals if each.name == signal_name]
    if not signals:
        names = [each.name for each in message.signals]
        raise LinkError(f"{where}: no signal {signal_name!r} in {message.name}{_near(signal_name, names)}")
    return message, signals


def _message(database: Database, name: str, signal_name: str, where: str) -> Any:
    found = [each for each in database.messages if each.name == name]
    number = _HEX_NAME.fullmatch(name)
    if number and not found:
        found = [each for each in database.messages if each.frame_id == int(number[1], 16) & ~_EXTENDED_BIT]
        if not found:
            raise LinkError(f"{where}: the DBC has no message of identifier {name}")
    if not found:
        raise LinkError(f"{where}: no message {name!r}{_near(name, [each.name for each in database.messages])}")
    if len(found) > 1:
        ids = [f'"0x{each.frame_id:X}.{signal_name}"' for each in found]
        raise LinkError(f"{where}: the DBC has {len(found)} messages of the same name {name}: write {' or '.join(ids)}")
    return found[0]


def _near(name: str, known: list[str]) -> str:
    close = difflib.get_close_matches(name, known, 1) or [k for k in known if name.lower() in k.lower()]
    more = f" and {len(known) - _NAMES_SHOWN} more" if len(known) > _NAMES_SHOWN else ""
    return f"; did you mean {close[0]!r}?" if close else f"; it has {', '.join(known[:_NAMES_SHOWN])}{more}"


def no_value_codes(signal: Any) -> dict[int, str]:
    """Raw values, as unsigned numbers, to which the value table gives a name that stands for no value.

    At the extreme codes of the bits any name but a number stands for none: what saturates there is no value either.
    """
    if signal.is_float:
        return {}
    size, half = 1 << signal.length, 1 << (signal.length - 1)
    extremes = {half - 1, half - 2, half, half + 1} if signal.is_signed else {size - 1, size - 2}
    if signal.length < _MIN_MEASURED_BITS:
        extremes = set()
    codes = {}
    for number, text in (signal.choices or {}).items():
        raw, name = int(number) % size, _words(str(text))
        in_text = raw != 0 and _NO_VALUE_IN_TEXT.search(name)  # 0 may be "no load"
        at_extreme = raw in extremes and not any(letter.isdigit() for letter in name)
        if _NO_VALUE.fullmatch(name) or in_text or at_extreme:
            codes[raw] = str(text)
    return codes


def _words(name: str) -> str:
    """ "SignalNot_available" as "Signal Not available"."""
    return re.sub(r"[\s_]+", " ", re.sub(r"(?<=[a-z])(?=[A-Z][a-z])", " ", name)).strip()
