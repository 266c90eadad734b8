"""Encodes values of the service as messages of the log, and decodes them bit for bit (log_schema.proto)."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.sink import ClockState, Status
from drivers.contract import Block, Gap, Info, LinkStats, Notice, Signal
from estimator.results import Estimate, Parameter

from .schema import message

NUMBER_OF_LEVEL = {"info": 2, "warning": 3, "error": 4}
LEVEL_NAMES = {number: name for name, number in NUMBER_OF_LEVEL.items()}
LINK_COUNTERS = tuple(f.name for f in fields(LinkStats) if f.name != "other")


@dataclass(frozen=True, slots=True)
class Topic:
    """One MCAP channel. Its id is its place in LOG_TOPICS, from 1: readable also if the first chunk is damaged."""

    name: str
    schema: str
    encoding: str = "protobuf"


# ids of the MCAP channels, the places in LOG_TOPICS
SESSION_CHANNEL, INFO_CHANNEL, RAW_CHANNEL, GAP_CHANNEL = 1, 2, 3, 4
NOTICE_CHANNEL, ESTIMATE_CHANNEL, STATUS_CHANNEL, PREVIEW_CHANNEL = 5, 6, 7, 8
LOG_TOPICS = (
    Topic("/session", "rotorscope.Session"),
    Topic("/info", "rotorscope.Info"),
    Topic("/raw", "rotorscope.Block"),
    Topic("/gap", "rotorscope.Gap"),
    Topic("/log", "foxglove.Log"),
    Topic("/estimate", "rotorscope.Estimate"),
    Topic("/status", "rotorscope.Status"),
    Topic("/preview", "std_msgs/msg/Float64MultiArray", "cdr"),  # of logs before there was a topic for each channel
)
# Topics for viewers: their ids follow, in the order in which they come. A number of each channel; a map of parameters
PREVIEW_TOPIC, ESTIMATES_TOPIC = "/preview/", "/estimates"
ESTIMATES_SCHEMA = "rotorscope.Estimates"


def text(said: str) -> str:
    """The text as a log can hold it: names of files may hold bytes that are no text."""
    return said.encode(errors="backslashreplace").decode()


def encode_session(device: str, wall_offset_ns: int, metadata: Mapping[str, str]) -> bytes:
    pairs = [{"key": text(k), "value": text(v)} for k, v in metadata.items()]
    return _bytes("Session", device=text(device), wall_offset_ns=wall_offset_ns, metadata=pairs)


def decode_session(data: bytes) -> tuple[str, int, dict[str, str]]:
    m = message("rotorscope.Session").FromString(data)
    return m.device, m.wall_offset_ns, {pair.key: pair.value for pair in m.metadata}


def encode_info(info: Info) -> bytes:
    signals = [{"name": s.name, "unit": s.unit, "scale": s.scale, "offset": s.offset} for s in info.signals]
    return _bytes(
        "Info", signals=signals, rate_hz=info.rate_hz, serial_number=info.serial_number, count_bits=info.count_bits
    )


def decode_info(data: bytes) -> Info:
    m = message("rotorscope.Info").FromString(data)
    signals = tuple(Signal(s.name, s.unit, s.scale, s.offset) for s in m.signals)
    return Info(signals, m.rate_hz, m.serial_number, m.count_bits)


def encode_blocks(blocks: Sequence[Block]) -> bytes:
    """One message of consecutive blocks; all with a device time, or all without."""
    counts = blocks[0].counts if len(blocks) == 1 else np.concatenate([b.counts for b in blocks])
    narrow = counts.astype("<i2")
    fits = bool(np.array_equal(narrow, counts))
    device = [b.t_device_ns for b in blocks if b.t_device_ns is not None]
    return _bytes(
        "Block", index=blocks[0].index, rows=counts.shape[0], channels=counts.shape[1], width=2 if fits else 4,
        counts=(narrow if fits else counts.astype("<i4")).tobytes(),
        part_rows=[len(b.counts) for b in blocks], part_host_ns=[b.t_host_ns for b in blocks], part_device_ns=device,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class RawBlock:
    """A decoded Block message: `counts` (rows, channels) int16 or int32, read-only, and the parts' times."""

    index: int
    counts: NDArray[np.int16] | NDArray[np.int32]
    part_rows: Sequence[int]
    part_host_ns: Sequence[int]
    part_device_ns: Sequence[int]

    @property
    def stop(self) -> int:
        return self.index + len(self.counts)

    def parts(self) -> list[Block]:
        """The blocks as the link delivered them."""
        counts = self.counts.astype(np.int32)
        device: Sequence[int | None] = self.part_device_ns or [None] * len(self.part_rows)
        out, at = [], 0
        for rows, host_ns, device_ns in zip(self.part_rows, self.part_host_ns, device, strict=True):
            out.append(Block(self.index + at, counts[at : at + rows], host_ns, device_ns))
            at += rows
        return out

    def joined(self) -> Block:
        """The blocks joined to one; its host time is that of the last part."""
        device = self.part_device_ns[0] if len(self.part_device_ns) else None
        return Block(self.index, self.counts.astype(np.int32), self.part_host_ns[-1], device)


def decode_block(data: bytes) -> RawBlock:
    """The block of a message. Raises ValueError if the message contradicts itself."""
    m = message("rotorscope.Block").FromString(data)
    size = m.rows * m.channels * m.width
    parts, devices = len(m.part_rows), len(m.part_device_ns)
    consistent = m.width in (2, 4) and m.index >= 0 and m.rows > 0 and m.channels >= 0 and size == len(m.counts)
    if not consistent or sum(m.part_rows) != m.rows or len(m.part_host_ns) != parts or devices not in (0, parts):
        raise ValueError(f"block at {m.index} says {m.rows} x {m.channels} x {m.width} bytes, holds {len(m.counts)}")
    kind: Any = "<i2" if m.width == 2 else "<i4"
    counts = np.frombuffer(m.counts, kind).reshape(m.rows, m.channels)
    return RawBlock(
        index=m.index,
        counts=counts,
        part_rows=m.part_rows,
        part_host_ns=m.part_host_ns,
        part_device_ns=m.part_device_ns,
    )


def encode_gap(gap: Gap) -> bytes:
    return _bytes("Gap", index=gap.index, count=gap.count, reason=gap.reason)


def decode_gap(data: bytes) -> Gap:
    m = message("rotorscope.Gap").FromString(data)
    return Gap(m.index, m.count, m.reason)


def encode_notice(notice: Notice, wall_ns: int) -> bytes:
    seconds, nanos = divmod(wall_ns, 10**9)
    out: bytes = message("foxglove.Log")(
        timestamp={"seconds": seconds, "nanos": nanos},
        level=NUMBER_OF_LEVEL.get(notice.level, 3),
        message=text(notice.text),
        name=notice.code,
    ).SerializeToString()
    return out


def decode_notice(data: bytes, t_host_ns: int) -> Notice:
    m = message("foxglove.Log").FromString(data)
    return Notice(t_host_ns, LEVEL_NAMES.get(m.level, "warning"), m.name, m.message)


def encode_estimate(estimate: Estimate) -> bytes:
    """Equal estimates give equal bytes, NaN included: `replay --check` compares these."""
    parameters = [
        {"name": name, "value": p.value, "sd": p.sd, "unit": p.unit, "identifiable": p.identifiable, "reason": p.reason}
        for name, p in estimate.parameters.items()
    ]
    extra = estimate.extra
    return _bytes(
        "Estimate", index=estimate.index, parameters=parameters, samples=estimate.samples,
        log_likelihood=estimate.log_likelihood, status=estimate.status, has_extra=extra is not None,
        extra=_numbers(extra or {}),
    )  # fmt: skip


def decode_estimate(data: bytes) -> Estimate:
    m = message("rotorscope.Estimate").FromString(data)
    parameters = {
        p.name: Parameter(
            value=_optional(p, "value"),
            sd=_optional(p, "sd"),
            unit=p.unit,
            identifiable=p.identifiable,
            reason=p.reason,
        )
        for p in m.parameters
    }
    extra = {n.name: n.value for n in m.extra} if m.has_extra else None
    return Estimate(
        index=m.index,
        parameters=parameters,
        samples=m.samples,
        log_likelihood=_optional(m, "log_likelihood"),
        status=m.status,
        extra=extra,
    )


def encode_status(status: Status) -> bytes:
    link = {name: getattr(status.link, name) for name in LINK_COUNTERS}
    link |= {f"other.{name}": count for name, count in status.link.other.items()}
    c = status.clock
    clock = c and {"offset_ns": c.offset_ns, "rate_hz": c.rate_hz, "drift_ppm": c.drift_ppm, "bound_ns": c.bound_ns}
    return _bytes(
        "Status", t_host_ns=status.t_host_ns, index=status.index, rate_hz=status.rate_hz, link=_counters(link),
        clock=clock, lag_s=_numbers(status.lag_s), dropped=_counters(status.dropped),
    )  # fmt: skip


def decode_status(data: bytes) -> Status:
    m = message("rotorscope.Status").FromString(data)
    link = LinkStats()
    for counter in m.link:
        if counter.name in LINK_COUNTERS:
            setattr(link, counter.name, counter.count)
        else:
            link.other[counter.name.removeprefix("other.")] = counter.count
    c = m.clock
    clock = ClockState(c.offset_ns, c.rate_hz, c.drift_ppm, c.bound_ns) if m.HasField("clock") else None
    lag = {n.name: n.value for n in m.lag_s}
    return Status(
        t_host_ns=m.t_host_ns,
        index=m.index,
        rate_hz=m.rate_hz,
        link=link,
        clock=clock,
        lag_s=lag,
        dropped={n.name: n.count for n in m.dropped},
    )


def encode_estimates(parameters: Mapping[str, Parameter]) -> bytes:
    """The identifiable values by the parts of their names, as JSON: {"bearing1": {"x": {"kL": 1e7}}}."""
    values = {name: p.value for name, p in parameters.items() if p.value is not None and p.identifiable}
    return json.dumps(_by_parts(values)).encode()


def estimates_schema(parameters: Mapping[str, Parameter]) -> bytes:
    """JSON schema of that map, of all parameters: Foxglove takes no topic without one, and offers the names in it."""
    return json.dumps(_json_schema(_by_parts({name: p.unit for name, p in parameters.items()}))).encode()


def estimates_schema_of(message: bytes) -> bytes:
    """JSON schema of a map of estimates that was encoded before: of the names that the message has."""
    try:
        return json.dumps(_json_schema(json.loads(message))).encode()
    except (ValueError, AttributeError):  # not ours
        return json.dumps(_json_schema({})).encode()


def _by_parts(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values by the parts of their dotted names: {"bearing1.x.kL": 1e7} as {"bearing1": {"x": {"kL": 1e7}}}."""
    out: dict[str, Any] = {}
    for name, value in values.items():
        at = out
        *path, last = text(name).split(".")
        for part in path:
            at = at.setdefault(part, {})
        at[last] = value
    return out


def _json_schema(values: Mapping[str, Any]) -> dict[str, Any]:
    """JSON schema of nested numbers. values : by name, a map again, a number, or the unit of one."""
    properties: dict[str, Any] = {}
    for name, value in values.items():
        unit = {"description": value} if isinstance(value, str) else {}
        properties[name] = _json_schema(value) if isinstance(value, dict) else {"type": "number", **unit}
    return {"type": "object", "properties": properties}


def encode_multi_array(values: NDArray[np.float64]) -> bytes:
    """std_msgs/Float64MultiArray without dimensions, CDR little endian: header, dim, data_offset, length, pad, data."""
    return struct.pack("<4sIIII", b"\x00\x01\x00\x00", 0, 0, len(values), 0) + values.astype("<f8").tobytes()


def _bytes(name: str, **values: Any) -> bytes:
    out: bytes = message(f"rotorscope.{name}")(**values).SerializeToString()
    return out


def _optional(m: Any, name: str) -> float | None:
    return getattr(m, name) if m.HasField(name) else None


def _numbers(values: Mapping[str, float]) -> list[dict[str, Any]]:
    return [{"name": name, "value": value} for name, value in values.items()]


def _counters(values: Mapping[str, int]) -> list[dict[str, Any]]:
    return [{"name": name, "count": count} for name, count in values.items()]
