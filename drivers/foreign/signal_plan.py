"""Signals of a DBC file compiled into a plan that decodes many frames at once.

cantools reads the file; one frame at a time it is 100 times slower than this. Counts are the raw integers. An unsigned
signal is re-centred (2^(bits-1) subtracted, the offset moved accordingly) so that counts always have a sign; a
floating-point one is cut into steps of its range / 2^30, or of 1e-6 of its unit if it states none.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.can.can_frames import EXTENDED_FLAG
from drivers.contract.errors import LinkError
from drivers.contract.reading import Signal

FLOAT_STEP = 1e-6
_J1939_PGN = 0x03FF_FF00  # priority and source address do not matter
_J1939_PGN_ADDRESSED = 0x03FF_0000  # PDU1: nor does the destination

U8Array = NDArray[np.uint8]
U64Array = NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class Bits:
    """Where an unsigned field lies: bytes first .. first + count - 1, then a shift and a mask."""

    first: int
    count: int
    shift: int
    length: int
    big_endian: bool

    @classmethod
    def of(cls, start: int, length: int, big_endian: bool) -> Bits:
        """start : as in the DBC (the least significant bit, or the most significant one if big endian)."""
        if not big_endian:
            return cls(start // 8, (start % 8 + length + 7) // 8, start % 8, length, False)
        begin = 8 * (start // 8) + 7 - start % 8
        end = begin + length
        return cls(begin // 8, (end + 7) // 8 - begin // 8, -end % 8, length, True)

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


@dataclass(frozen=True, slots=True)
class Field:
    """One signal: counts and whether they mean anything. low, high : physical range, None if the DBC states none."""

    bits: Bits
    signed: bool
    floating: bool
    signal: Signal
    step: float
    low: float | None
    high: float | None
    selector: Bits | None = None
    selected: frozenset[int] = frozenset()

    def read(self, payload: U8Array, lengths: U8Array) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
        """(n,) counts and (n,) valid. Too short, of another multiplex page, out of its range: not valid."""
        raw = self.bits.read(payload)
        valid = lengths >= self.bits.first + self.bits.count
        if self.selector is not None:
            valid &= np.isin(self.selector.read(payload), list(self.selected))
        half = 1 << (self.bits.length - 1)
        if self.floating:
            kind = {16: np.float16, 32: np.float32, 64: np.float64}[self.bits.length]
            unsigned = {16: np.uint16, 32: np.uint32, 64: np.uint64}[self.bits.length]
            with np.errstate(invalid="ignore"):  # a signalling NaN
                number = raw.astype(unsigned).view(kind).astype(np.float64)
            valid &= np.isfinite(number)
            counts = np.rint(np.where(valid, number, 0.0) / self.step)
            valid &= np.abs(counts) < 2.0**31
            counts = np.where(valid, counts, 0).astype(np.int32)
        elif self.signed:
            shift = np.uint64(64 - self.bits.length)
            counts = ((raw << shift).view(np.int64) >> shift.astype(np.int64)).astype(np.int32)
        else:
            counts = (raw.astype(np.int64) - half).astype(np.int32)
        if self.low is not None and self.high is not None:
            value = counts * self.signal.scale + self.signal.offset
            slack = 0.5 * abs(self.signal.scale)
            valid &= (value >= self.low - slack) & (value <= self.high + slack)
        return counts, valid


@dataclass(frozen=True, slots=True)
class Message:
    """The mapped signals of one message. columns : which channel each field is."""

    name: str
    identifier: int
    mask: int
    fields: tuple[Field, ...]
    columns: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """messages : in the order of their identifiers, which is the order in which a device's frames win the bus."""

    messages: tuple[Message, ...]
    signals: tuple[Signal, ...]
    count_bits: int


def compile_plan(dbc: bytes, signals: Mapping[str, str]) -> SignalPlan:
    """signals : channel -> "Message.Signal", in the order of the channels. Raises LinkError."""
    import cantools

    try:
        database = cantools.database.load_string(dbc.decode("utf-8", "replace"), "dbc", strict=False)
    except Exception as error:
        text = " ".join(str(error).split())
        raise LinkError(f"the DBC file cannot be read: {text}: check link.dbc") from error
    if not signals:
        raise LinkError('the signal map is empty: give channel = "Message.Signal" for each channel')
    found: dict[str, tuple[Any, list[tuple[int, Field]]]] = {}
    for column, (channel, path) in enumerate(signals.items()):
        message, signal = _look_up(database, channel, path)
        entry = found.setdefault(message.name, (message, []))
        entry[1].append((column, _field(message, signal, channel)))
    messages = [_message(message, fields) for message, fields in found.values()]
    messages.sort(key=lambda each: each.identifier)
    columns = [pair for message in messages for pair in zip(message.columns, message.fields, strict=True)]
    fields = [each for _, each in sorted(columns, key=lambda pair: pair[0])]
    bits = max(32 if each.floating else each.bits.length for each in fields)
    return SignalPlan(tuple(messages), tuple(each.signal for each in fields), bits)


def _look_up(database: Any, channel: str, path: str) -> tuple[Any, Any]:
    where = f"signal map, {channel} = {path!r}"
    name, _, signal_name = path.partition(".")
    if not signal_name:
        raise LinkError(f"{where}: write Message.Signal")
    message = next((each for each in database.messages if each.name == name), None)
    if message is None:
        raise LinkError(f"{where}: no message {name!r}{_near(name, [each.name for each in database.messages])}")
    signal = next((each for each in message.signals if each.name == signal_name), None)
    if signal is None:
        names = [each.name for each in message.signals]
        raise LinkError(f"{where}: no signal {signal_name!r} in {name}{_near(signal_name, names)}")
    return message, signal


def _near(name: str, known: list[str]) -> str:
    close = difflib.get_close_matches(name, known, 1)
    return f"; did you mean {close[0]!r}?" if close else f"; it has {', '.join(known[:8])}"


def _field(message: Any, signal: Any, channel: str) -> Field:
    big = signal.byte_order == "big_endian"
    if not signal.is_float and signal.length > 32:
        where = f"{message.name}.{signal.name}"
        raise LinkError(f"{where}: {signal.length} bits do not fit counts of 32: use another signal")
    scale, offset = float(signal.scale), float(signal.offset)
    low = None if signal.minimum is None else float(signal.minimum)
    high = None if signal.maximum is None else float(signal.maximum)
    if low is None or high is None or low >= high:
        low = high = None
    step = 1.0
    if signal.is_float:
        step = FLOAT_STEP if low is None or high is None else max(abs(low), abs(high)) / 2**30 / abs(scale)
        scale *= step
    elif not signal.is_signed:
        offset += scale * 2 ** (signal.length - 1)
    selector, selected = None, frozenset[int]()
    if signal.multiplexer_ids and signal.multiplexer_signal:
        chooser = next(each for each in message.signals if each.name == signal.multiplexer_signal)
        selector = Bits.of(chooser.start, chooser.length, chooser.byte_order == "big_endian")
        selected = frozenset(signal.multiplexer_ids)
    return Field(
        bits=Bits.of(signal.start, signal.length, big), signed=signal.is_signed, floating=signal.is_float,
        signal=Signal(channel, signal.unit or "", scale, offset), step=step, low=low, high=high, selector=selector,
        selected=selected,
    )  # fmt: skip


def _message(message: Any, fields: list[tuple[int, Field]]) -> Message:
    mask, identifier = 0xFFFF_FFFF, int(message.frame_id)
    if message.is_extended_frame:
        identifier |= EXTENDED_FLAG
    if message.protocol == "j1939":
        addressed = (identifier >> 16) & 0xFF < 240
        mask = EXTENDED_FLAG | (_J1939_PGN_ADDRESSED if addressed else _J1939_PGN)
    return Message(
        name=message.name,
        identifier=identifier & mask,
        mask=mask,
        fields=tuple(each for _, each in fields),
        columns=tuple(column for column, _ in fields),
    )
