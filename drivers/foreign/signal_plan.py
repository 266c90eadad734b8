"""Signals of a DBC file compiled into a plan that decodes many frames at once.

cantools decodes one frame at a time, which is 100 times slower. Counts are the raw integers. An unsigned signal is
re-centred (2^(bits-1) subtracted, the offset moved accordingly) so that counts always have a sign. A floating-point
signal is quantised in steps of a power of two: 2^-28 of its largest value.

Three kinds of raw values count as missing: the codes of J1939 for "not available" and "error", codes that a value table
names so, and the extreme code of a signal beyond its stated limits. Other values beyond the limits are kept.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.can.can_frames import EXTENDED_FLAG
from drivers.contract.errors import LinkError
from drivers.contract.reading import Signal

from .dbc import Database, find_signals, load_dbc, no_value_codes

FLOAT_BITS = 28  # of a count at the largest value known so far; values beyond eight times that need a larger step
J1939_VALUES_SHARE = 0xFB / 0x100  # of a J1939 parameter's codes: those from FB.. on are indicators (J1939-71)
NO_NUMBER = 1e30  # a larger float is no measurement: it is the largest float, or stands for infinity
_J1939_PGN = 0x03FF_FF00  # priority and source address do not matter
_J1939_PGN_ADDRESSED = 0x03FF_0000  # PDU1: the destination does not matter either

U8Array = NDArray[np.uint8]
U64Array = NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class Bits:
    """Where an unsigned field lies: bytes first .. first + count - 1, then a shift and a mask."""

    first: int
    count: int
    shift: int
    length: int
    _: KW_ONLY
    big_endian: bool

    @classmethod
    def of(cls, start: int, length: int, big_endian: bool) -> Bits:
        """start : as in the DBC (the least significant bit, or the most significant one if big endian)."""
        if not big_endian:
            return cls(start // 8, (start % 8 + length + 7) // 8, start % 8, length, big_endian=False)
        begin = 8 * (start // 8) + 7 - start % 8
        end = begin + length
        return cls(begin // 8, (end + 7) // 8 - begin // 8, -end % 8, length, big_endian=True)

    def read(self, payload: U8Array) -> U64Array:
        """(n, 64) payloads -> (n,) field values."""
        columns = range(self.first, self.first + self.count)
        order = columns if self.big_endian else reversed(columns)  # most significant first
        high, value = np.zeros(len(payload), np.uint64), np.zeros(len(payload), np.uint64)
        for column in order:
            high = value >> np.uint64(56)  # a field over nine bytes needs the byte that falls out
            value = (value << np.uint64(8)) | payload[:, column]
        if self.shift:
            value = value >> np.uint64(self.shift)
            if self.count == 9:
                value |= high << np.uint64(64 - self.shift)
        return value if self.length == 64 else value & np.uint64((1 << self.length) - 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """One signal of the DBC: decodes its counts and whether each count is a valid value.

    path : name of the signal, for warnings. step : size of a count of a float signal; 0 until its values are known.
    low, high : limits in the DBC, None if it states none. codes : raw values that are no value, and their names.
    first_code : first raw value that J1939 reserves as an indicator, None if the signal is not J1939.
    """

    path: str
    bits: Bits
    signed: bool
    floating: bool
    signal: Signal
    step: float
    low: float | None
    high: float | None
    codes: Mapping[int, str]
    first_code: int | None

    def read(
        self, payload: U8Array, lengths: U8Array, warnings: Counter[tuple[str, str]] | None = None
    ) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
        """(n,) counts and (n,) valid flags. warnings : receives (code, text) of the samples that are not valid."""
        raw = self.bits.read(payload)
        valid = lengths >= self.bits.first + self.bits.count
        warnings = Counter() if warnings is None else warnings
        if self.floating:
            number = self._number(raw)
            valid &= np.abs(number) < NO_NUMBER  # False for NaN, too
            counts = np.rint(np.where(valid, number, 0.0) / self.step)
            valid &= np.abs(counts) < 2.0**31
            return np.where(valid, counts, 0).astype(np.int32), valid
        if self.signed:
            shift = np.uint64(64 - self.bits.length)
            counts = ((raw << shift).view(np.int64) >> shift.astype(np.int64)).astype(np.int32)
        else:
            counts = (raw.astype(np.int64) - (1 << (self.bits.length - 1))).astype(np.int32)
        if self.first_code is not None or self.codes:
            self._leave_codes_out(raw, valid, warnings)
        if self.low is not None and self.high is not None:
            self._look_at_limits(raw, counts, valid, warnings, (self.low, self.high))
        return counts, valid

    def largest(self, payload: U8Array, lengths: U8Array) -> float:
        """The largest magnitude of a float's values."""
        number = np.abs(self._number(self.bits.read(payload)))
        number = number[(lengths >= self.bits.first + self.bits.count) & (number < NO_NUMBER)]
        return float(number.max()) if len(number) else 0.0

    def stepped(self, largest: float) -> Field:
        """This field with a step that suits values up to `largest`."""
        step = 2.0 ** (math.frexp(largest)[1] - FLOAT_BITS) if largest else 2.0**-FLOAT_BITS
        scale = self.signal.scale * step / (self.step or 1.0)
        return replace(self, step=step, signal=replace(self.signal, scale=scale))

    def _number(self, raw: U64Array) -> NDArray[np.float64]:
        kind = {16: np.float16, 32: np.float32, 64: np.float64}[self.bits.length]
        unsigned = {16: np.uint16, 32: np.uint32, 64: np.uint64}[self.bits.length]
        with np.errstate(invalid="ignore"):  # a signalling NaN
            return np.asarray(raw.astype(unsigned).view(kind).astype(np.float64))

    def _leave_codes_out(self, raw: U64Array, valid: NDArray[np.bool_], warnings: Counter[tuple[str, str]]) -> None:
        if self.first_code is not None:
            no_value = valid & (raw >= np.uint64(self.first_code))
            if no_value.any():
                text = f"codes from 0x{self.first_code:X} on, by which J1939 says not available or error: missing"
                warnings["no_value", f"{self.path}: {text}"] += int(no_value.sum())
                valid &= ~no_value
        for code, name in self.codes.items():
            no_value = valid & (raw == np.uint64(code))
            if no_value.any():
                text = f'the value table (VAL_) of the DBC calls 0x{code:X} "{name}": missing'
                warnings["no_value", f"{self.path}: {text}"] += int(no_value.sum())
                valid &= ~no_value

    def _look_at_limits(
        self, raw: U64Array, counts: NDArray[np.int32], valid: NDArray[np.bool_], warnings: Counter[tuple[str, str]],
        limits: tuple[float, float],
    ) -> None:  # fmt: skip
        low, high = limits
        value = counts * self.signal.scale + self.signal.offset
        slack = 0.5 * abs(self.signal.scale)
        outside = valid & ~((value >= low - slack) & (value <= high + slack))
        if not outside.any():
            return
        top = (1 << (self.bits.length - 1 if self.signed else self.bits.length)) - 1
        extreme = outside & np.isin(raw, np.array([top, top - 1, top + 1 if self.signed else top], np.uint64))
        said = f"the limits of the DBC, {low:g} to {high:g}"
        if extreme.any():
            text = f"{self.path}: the extreme codes of its {self.bits.length} bits lie outside {said}: missing"
            warnings["no_value", text] += int(extreme.sum())
            valid &= ~extreme
        if others := int((outside & ~extreme).sum()):
            warnings["outside_limits", f"{self.path}: values outside {said}: kept; correct the DBC"] += others


Conditions = tuple[tuple[Bits, frozenset[int]], ...]  # multiplexers, the outermost first, and their values


@dataclass(frozen=True, slots=True)
class Page:
    """Fields that are in a frame together. columns : channel of each field."""

    conditions: Conditions
    fields: tuple[Field, ...]
    columns: tuple[int, ...]

    def hit(self, payload: U8Array, lengths: U8Array) -> NDArray[np.bool_]:
        """(n,) whether each frame of the message has this page."""
        out = np.ones(len(payload), np.bool_)
        for selector, values in self.conditions:
            out &= np.isin(selector.read(payload), np.array(sorted(values), np.uint64))
            out &= lengths >= selector.first + selector.count
        return out


@dataclass(frozen=True, slots=True)
class Message:
    """Frames that carry the same channels: one message of the DBC, or some pages of one. pages : any of them."""

    name: str
    identifier: int
    mask: int
    pages: tuple[Page, ...]

    @property
    def label(self) -> str:
        """Name and identifier of the message, for warnings."""
        return f"{self.name} (0x{self.identifier & 0x1FFF_FFFF:X})"

    @property
    def paged(self) -> bool:
        return any(page.conditions for page in self.pages)

    def with_fields(self, fields: Mapping[int, Field]) -> Message:
        """This message with some fields replaced. fields : channel -> field."""
        pages = [replace(p, fields=tuple(fields.get(c, f) for c, f in zip(p.columns, p.fields, strict=True)))
                 for p in self.pages]  # fmt: skip
        return replace(self, pages=tuple(pages))


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """How frames are decoded. messages : in the order of their identifiers, which is their priority on the bus."""

    messages: tuple[Message, ...]
    signals: tuple[Signal, ...]
    count_bits: int
    names: Mapping[str, int]  # every message of the DBC, and its identifier with flags

    def with_messages(self, messages: tuple[Message, ...]) -> SignalPlan:
        fields = {c: f for m in messages for p in m.pages for c, f in zip(p.columns, p.fields, strict=True)}
        signals = tuple(fields[column].signal for column in range(len(self.signals)))
        return replace(self, messages=messages, signals=signals)


def compile_plan(dbc: bytes, signals: Mapping[str, str]) -> SignalPlan:
    """The plan of a DBC file. signals : channel -> "Message.Signal", in the order of the channels. Raises LinkError."""
    database = load_dbc(dbc)
    if not signals:
        raise LinkError('the signal map is empty: give channel = "Message.Signal" for each channel')
    found: dict[int, tuple[Any, list[tuple[int, list[tuple[Conditions, Field]]]]]] = {}
    for column, (channel, path) in enumerate(signals.items()):
        message, candidates = find_signals(database, channel, path)
        pages_of = [(_conditions(message, each), _field(database, message, each, channel)) for each in candidates]
        if len({(f.signal, f.bits.length, f.signed, f.floating) for _, f in pages_of}) > 1:
            text = f"{path} is on {len(pages_of)} pages of its message, with different factors"
            raise LinkError(f"signal map, {channel}: {text}: give it two names in the DBC")
        found.setdefault(id(message), (message, []))[1].append((column, pages_of))
    messages = [each for message, channels in found.values() for each in _messages(database, message, channels)]
    messages.sort(key=lambda each: each.identifier)
    fields = {c: f for m in messages for p in m.pages for c, f in zip(p.columns, p.fields, strict=True)}
    bits = max(32 if each.floating else each.bits.length for each in fields.values())
    every = {each.name: _identifier(each) for each in database.messages}
    return SignalPlan(tuple(messages), tuple(fields[c].signal for c in range(len(signals))), bits, every)


def _messages(
    database: Database, message: Any, channels: list[tuple[int, list[tuple[Conditions, Field]]]]
) -> list[Message]:
    """Messages of one DBC message: one for the channels of each set of pages; unpaged channels join the first one."""
    groups: dict[tuple[Conditions, ...], list[tuple[int, list[Field]]]] = {}
    for column, pages in channels:
        key = tuple(conditions for conditions, _ in pages)
        groups.setdefault(key, []).append((column, [field for _, field in pages]))
    common = groups.pop(((),), [])
    if common and not groups:
        groups[((),)] = []
    out = []
    for key, members in groups.items():
        made: list[Page] = []
        for k, conditions in enumerate(key):
            fields = [(column, each[k]) for column, each in members] + [(column, each[0]) for column, each in common]
            fields.sort(key=lambda pair: pair[0])
            made.append(Page(conditions, tuple(f for _, f in fields), tuple(c for c, _ in fields)))
        identifier, mask = _match(database, message)
        out.append(Message(message.name, identifier, mask, tuple(made)))
        common = []
    return out


def _conditions(message: Any, signal: Any) -> Conditions:
    """Values that the multiplexers above a signal must have, the outermost multiplexer first."""
    out: list[tuple[Bits, frozenset[int]]] = []
    while signal.multiplexer_ids and signal.multiplexer_signal and len(out) < len(message.signals):
        chooser = next(each for each in message.signals if each.name == signal.multiplexer_signal)
        out.insert(0, (_bits(chooser), frozenset(signal.multiplexer_ids)))
        signal = chooser
    return tuple(out)


def _bits(signal: Any) -> Bits:
    return Bits.of(signal.start, signal.length, signal.byte_order == "big_endian")


def _field(database: Database, message: Any, signal: Any, channel: str) -> Field:
    path = f"{message.name}.{signal.name}"
    if not signal.is_float and signal.length > 32:
        raise LinkError(f"{path}: {signal.length} bits do not fit counts of 32: use another signal")
    scale, offset = float(signal.scale), float(signal.offset)
    if scale == 0.0 or not math.isfinite(scale) or not math.isfinite(offset):
        raise LinkError(f"{path}: the DBC gives a factor of {scale:g} and an offset of {offset:g}: correct the DBC")
    low = None if signal.minimum is None else float(signal.minimum)
    high = None if signal.maximum is None else float(signal.maximum)
    if low is None or high is None or low >= high:
        low = high = None
    if not signal.is_float and not signal.is_signed:
        offset += scale * 2 ** (signal.length - 1)
    first_code = None
    if _is_j1939(database, message) and not signal.is_float and not signal.is_signed and signal.length >= 8:
        first_code = round(J1939_VALUES_SHARE * 2**signal.length)
    return Field(
        path=path, bits=_bits(signal), signed=signal.is_signed, floating=signal.is_float,
        signal=Signal(channel, signal.unit or "", scale, offset), step=0.0 if signal.is_float else 1.0,
        low=low, high=high, codes=no_value_codes(signal), first_code=first_code,
    )  # fmt: skip


def _is_j1939(database: Database, message: Any) -> bool:
    return bool(message.is_extended_frame) and (message.protocol == "j1939" or database.j1939)


def _identifier(message: Any) -> int:
    return int(message.frame_id) | (EXTENDED_FLAG if message.is_extended_frame else 0)


def _match(database: Database, message: Any) -> tuple[int, int]:
    """Identifier and mask by which frames of a DBC message are recognised."""
    mask, identifier = 0xFFFF_FFFF, _identifier(message)
    if _is_j1939(database, message):
        addressed = (identifier >> 16) & 0xFF < 240
        mask = EXTENDED_FLAG | (_J1939_PGN_ADDRESSED if addressed else _J1939_PGN)
    return identifier & mask, mask
