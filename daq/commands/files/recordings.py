"""Exports for viewers: every sample in SI as MCAP for Foxglove and PlotJuggler, and as a Rerun recording."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from google.protobuf import descriptor_pb2
from mcap.writer import CompressionType, Writer

from daq.base.console.extras import required

if TYPE_CHECKING:
    from .exporters import Table

Field = descriptor_pb2.FieldDescriptorProto
SAMPLE_MESSAGE = "rotorscope.Sample"  # of one channel: its value
SAMPLE_FIELD_TAG = 0x09  # field 1, eight bytes
CHUNK_BYTES = 1 << 20
PIECE_ROWS = 1 << 16
WINDOW_S = 10.0  # that a viewer shows at first, at most


def write_mcap(table: Table, path: Path) -> None:
    """A topic for each channel, a message for each sample: its value in the unit of the topic's metadata."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start("", library="rotorscope")
        schema = writer.register_schema(SAMPLE_MESSAGE, "protobuf", _sample_schema())
        ids = [
            writer.register_channel(f"/{name}", "protobuf", schema, {"unit": unit})
            for name, unit in zip(table.names, table.units, strict=True)
        ]
        about = {"rate_hz": repr(table.rate_hz), "started": table.started}
        about |= {f"unit of {name}": unit for name, unit in zip(table.names, table.units, strict=True)}
        writer.add_metadata("record", about)
        pack = struct.Struct("<Bd").pack
        for first, times in _times_ns(table):
            rows = table.values[first : first + len(times)].tolist()
            for t, row in zip(times, rows, strict=True):
                for number, value in zip(ids, row, strict=True):
                    if value == value:  # of a gap there is no message
                        writer.add_message(number, t, pack(SAMPLE_FIELD_TAG, value), t)
        writer.finish()


def write_rrd(table: Table, path: Path) -> None:
    """A scalar for each channel and sample on the time line "time", and a panel for each channel."""
    rr = required("rerun", "", ".rrd")
    rrb = required("rerun.blueprint", "", ".rrd")
    recording = rr.RecordingStream("rotorscope_export")
    recording.save(str(path))
    names = [f"{name} [{unit}]" for name, unit in zip(table.names, table.units, strict=True)]
    for entity, name in zip(_entities(table, rr), names, strict=True):
        recording.log(entity, rr.SeriesLines(names=[name]), static=True)
    for first, times in _times_ns(table):
        rows = table.values[first : first + len(times)]
        stamps = np.array(times, np.int64)
        for k, entity in enumerate(_entities(table, rr)):
            there = np.isfinite(rows[:, k])
            if table.started_ns is None:
                index = rr.TimeColumn("time", duration=stamps[there].astype("timedelta64[ns]"))
            else:
                index = rr.TimeColumn("time", timestamp=stamps[there].astype("datetime64[ns]"))
            recording.send_columns(entity, indexes=[index], columns=rr.Scalars.columns(scalars=rows[there, k]))
    views = [rrb.TimeSeriesView(origin=e, name=n) for e, n in zip(_entities(table, rr), names, strict=True)]
    panel = rrb.TimePanel(timeline="time", state="collapsed")
    recording.send_blueprint(rrb.Blueprint(rrb.Vertical(*views), panel, collapse_panels=True))
    recording.flush(timeout_sec=60)
    recording.disconnect()


def _entities(table: Table, rr: object) -> list[str]:
    escape = rr.escape_entity_path_part  # type: ignore[attr-defined]
    return [str(escape(name)) for name in table.names]


def _times_ns(table: Table) -> Iterator[tuple[int, list[int]]]:
    """First row and times of its rows, piece by piece: Unix time in ns, from 0 where the date is not known."""
    begin, period_ns = table.started_ns or 0, 1e9 / table.rate_hz
    for first in range(0, len(table.values), PIECE_ROWS):
        rows = np.arange(first, min(first + PIECE_ROWS, len(table.values)))
        yield first, (begin + np.rint(rows * period_ns).astype(np.int64)).tolist()


def _sample_schema() -> bytes:
    """The FileDescriptorSet of a message with one number, `value`."""
    package, _, title = SAMPLE_MESSAGE.rpartition(".")
    out = descriptor_pb2.FileDescriptorSet()
    file = out.file.add(name="sample.proto", package=package, syntax="proto3")
    message = file.message_type.add(name=title)
    message.field.add(name="value", number=1, label=Field.LABEL_OPTIONAL, type=Field.TYPE_DOUBLE)
    return out.SerializeToString()
