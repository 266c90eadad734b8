"""A session as MCAP: the place of each record, and the end of each chunk (docs/log-format.md). No threads, no disk."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np
from mcap.writer import CompressionType, Writer

from daq.base.contract.dates import SINCE_2001_NS, UNKNOWN_START, Recorded, utc_text
from daq.base.contract.envelope import Envelope, Extremes
from daq.base.contract.sink import Session, Status
from drivers.contract import Block, Gap, Info, Notice, Reading
from estimator.results import Estimate

from . import codec as codec
from .index import PackedIndex
from .scan import MAX_CHUNK_BYTES
from .schema import FLOAT64_MULTI_ARRAY, descriptor_set

LOG_PROFILE = "rotorscope"  # of the MCAP header
CHUNK_BYTES = 256 * 1024
JOINED_ROWS = 4096  # blocks of a link are joined into messages of about this many rows
ENVELOPE_HZ = 50.0  # least and greatest of each window: 100 preview rows a second
CHUNK_S = 1.0  # of data in a chunk at most: the loss by one damaged byte
MEDIA_TYPES = {".toml": "application/toml", ".dbc": "text/plain"}


class Output(Protocol):
    def write(self, data: bytes, /) -> int: ...
    def tell(self) -> int: ...
    def flush(self) -> None: ...


class LogEncoder:
    """Writes MCAP to `output`. Every chunk starts with session and info again, and can be read alone."""

    def __init__(self, output: Output, recorded: Recorded | None = None) -> None:
        self._mcap = Writer(output, chunk_size=MAX_CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._mcap._Writer__chunk_indices = PackedIndex()  # the library has no option for it
        self._mcap.start(LOG_PROFILE)
        self._ids = [0, *(self._register(topic) for topic in codec.LOG_TOPICS)]
        self._viewer_ids: dict[str, int] = {}  # topic for viewers -> its number
        self._units: dict[str, str] = {}
        self._recorded = recorded
        self._early: list[Gap | Info | Notice | Status | Estimate] = []  # of a recording, until its date is known
        self._about: Session | None = None  # of a recording, until then
        self._wall_offset_ns = 0
        self._session = b""
        self._info: Info | None = None
        self._waiting: list[Block] = []
        self._waiting_rows = 0
        self._envelope: Envelope | None = None
        self._axis_ns = 0  # Unix time of sample 0 on the device's nominal time axis
        self._last_ns = 0
        self._chunk_bytes = 0
        self._chunk_index: int | None = None  # of the first sample in the chunk under way
        self.fresh = True  # nothing since the last flush

    def start(self, session: Session, wall_offset_ns: int, now_ns: int = 0) -> None:
        """wall_offset_ns : Unix time = host monotonic time + this. now_ns : host monotonic time."""
        self._wall_offset_ns, self._last_ns = wall_offset_ns, wall_offset_ns + now_ns
        if self._recorded is not None:
            self._about = session
            return
        self._begin(session)

    def _begin(self, session: Session) -> None:
        wall_offset_ns = self._wall_offset_ns
        self._session = codec.encode_session(session.device, wall_offset_ns, session.metadata)
        self.metadata("session", dict(session.metadata) | {"device": session.device})
        for name, data in session.attachments.items():
            media_type = MEDIA_TYPES.get(name[name.rfind(".") :], "application/octet-stream")
            self.attachment(name, media_type, data)
        self.reading(session.info)

    def _date(self, block: Block | None) -> None:
        """Take the date of a recording from its first samples, or that it has none."""
        about, self._about, early, self._early = self._about, None, self._early, []
        info = next((e for e in early if isinstance(e, Info)), about.info if about else None)
        first_ns = 0
        if block is not None:
            first_ns = block.t_host_ns - (round(1e9 * (len(block.counts) - 1) / info.rate_hz) if info else 0)
        offset_ns = self._recorded.wall_offset_ns if self._recorded else None
        known = offset_ns is not None or first_ns >= SINCE_2001_NS
        if offset_ns is None:
            offset_ns = 0 if known else self._last_ns - first_ns
        imported = utc_text(self._last_ns)
        self._wall_offset_ns, self._last_ns = offset_ns, first_ns + offset_ns
        if about is not None:
            started = utc_text(self._last_ns) if known else UNKNOWN_START
            more = {"started": started, "imported": imported}
            self._begin(replace(about, metadata={**about.metadata, **more}))
        for entry in early:
            if isinstance(entry, Status):
                self.status(entry)
            elif isinstance(entry, Estimate):
                self.estimate(entry)
            else:
                self.reading(entry)

    def reading(self, reading: Reading) -> None:
        if self._about is not None:
            if not isinstance(reading, Block):
                self._early.append(reading)
                return
            self._date(reading)
        if isinstance(reading, Block):
            for piece in self._pieces(reading):
                self._block(piece)
        elif isinstance(reading, Gap):
            self._join()
            self._add(codec.GAP_CHANNEL, self._last_ns, codec.encode_gap(reading))
        elif isinstance(reading, Notice):
            wall_ns = self._last_ns if self._recorded else reading.t_host_ns + self._wall_offset_ns
            self._add(codec.NOTICE_CHANNEL, wall_ns, codec.encode_notice(reading, wall_ns))
        elif reading != self._info:
            self._join()
            self._preview(self._envelope.rest() if self._envelope else [])
            self._info = reading
            self._envelope = Envelope(max(1, round(reading.rate_hz / ENVELOPE_HZ)))
            self._axis_ns = 0
            self._introduce()

    def estimate(self, estimate: Estimate) -> None:
        if self._about is not None:
            self._early.append(estimate)
            return
        self._join()
        self._add(codec.ESTIMATE_CHANNEL, self._last_ns, codec.encode_estimate(estimate))
        if estimate.parameters:
            values = codec.encode_estimates(estimate.parameters)
            topic = self._estimates_id(lambda: codec.estimates_schema(estimate.parameters))
            self._add(topic, self._last_ns, values)

    def status(self, status: Status) -> None:
        if self._about is not None:
            self._early.append(status)
            return
        wall_ns = self._last_ns if self._recorded else status.t_host_ns + self._wall_offset_ns
        self._add(codec.STATUS_CHANNEL, wall_ns, codec.encode_status(status))

    def raw_message(self, topic: int, log_time: int, publish_time: int, data: bytes) -> None:
        """A message as it was in another log: for `recover`."""
        self._last_ns = log_time
        if topic == codec.INFO_CHANNEL:
            self._units |= {codec.PREVIEW_TOPIC + s.name: s.unit for s in codec.decode_info(data).signals}
        self._add(topic, log_time, data, publish_time)

    def raw_viewer_message(self, name: str, log_time: int, publish_time: int, data: bytes) -> None:
        """A message of a topic for viewers as it was in another log: for `recover`."""
        if name == codec.ESTIMATES_TOPIC:
            topic = self._estimates_id(lambda: codec.estimates_schema_of(data))
        else:
            topic = self._preview_id(name, self._units.get(name, ""))
        self._add(topic, log_time, data, publish_time)

    def attachment(self, name: str, media_type: str, data: bytes) -> None:
        self._mcap.add_attachment(0, 0, codec.text(name), media_type, data)

    def metadata(self, name: str, values: dict[str, str]) -> None:
        self._mcap.add_metadata(name, {codec.text(k): codec.text(v) for k, v in values.items()})

    def flush(self) -> None:
        """End the chunk under way and hand every byte to the output."""
        if self.fresh:
            return
        self._join()
        self._end_chunk()
        self.fresh = True

    def finish(self) -> None:
        """The last chunk, index and footer; with them the log is complete."""
        if self._about is not None:
            self._date(None)
        self._join()
        if self._envelope:
            self._preview(self._envelope.rest())
        self._mcap.finish()

    def _register(self, topic: codec.Topic) -> int:
        if topic.encoding == "cdr":
            schema = self._mcap.register_schema(topic.schema, "ros2msg", FLOAT64_MULTI_ARRAY.encode())
        else:
            schema = self._mcap.register_schema(topic.schema, "protobuf", descriptor_set(topic.schema))
        return int(self._mcap.register_channel(topic.name, topic.encoding, schema))

    def _preview_id(self, name: str, unit: str) -> int:
        """Number of the topic of a preview, for `_put`; registered when it is first seen."""
        if name not in self._viewer_ids:
            known = codec.LOG_TOPICS[codec.PREVIEW_CHANNEL - 1]
            schema = self._mcap.register_schema(known.schema, "ros2msg", FLOAT64_MULTI_ARRAY.encode())
            self._register_viewer(name, "cdr", schema, {"unit": codec.text(unit)})
        return self._viewer_ids[name]

    def _estimates_id(self, schema: Callable[[], bytes]) -> int:
        """Number of the topic of the estimates, for `_put`; registered, with its JSON schema, when it is first seen."""
        name = codec.ESTIMATES_TOPIC
        if name not in self._viewer_ids:
            number = self._mcap.register_schema(codec.ESTIMATES_SCHEMA, "jsonschema", schema())
            self._register_viewer(name, "json", number, {})
        return self._viewer_ids[name]

    def _register_viewer(self, name: str, encoding: str, schema: int, about: dict[str, str]) -> None:
        self._viewer_ids[name] = len(self._ids)
        self._ids.append(self._mcap.register_channel(codec.text(name), encoding, schema, about))

    def _introduce(self) -> None:
        if self._session and self._info is not None:
            self._put(codec.SESSION_CHANNEL, self._last_ns, self._session)
            self._put(codec.INFO_CHANNEL, self._last_ns, codec.encode_info(self._info))

    def _end_chunk(self) -> None:
        self._mcap.flush()
        self._introduce()
        self._chunk_bytes, self._chunk_index = 0, None

    def _add(self, topic: int, log_time: int, data: bytes, publish_time: int | None = None) -> None:
        if self._chunk_bytes >= CHUNK_BYTES:
            self._end_chunk()
        self._chunk_bytes += len(data)
        self._put(topic, log_time, data, publish_time)

    def _put(self, topic: int, log_time: int, data: bytes, publish_time: int | None = None) -> None:
        self.fresh = False
        self._mcap.add_message(self._ids[topic], log_time, data, log_time if publish_time is None else publish_time)

    def _block(self, block: Block) -> None:
        if not len(block.counts):
            return
        if self._waiting:
            last = self._waiting[-1]
            follows = block.index == last.index + len(last.counts)
            if (
                self._waiting_rows + len(block.counts) > self._most_rows
                or not follows
                or (block.t_device_ns is None) != (last.t_device_ns is None)
            ):
                self._join()
        self._waiting.append(block)
        self._waiting_rows += len(block.counts)
        self.fresh = False
        if self._waiting_rows >= min(JOINED_ROWS, self._most_rows):
            self._join()

    @property
    def _most_rows(self) -> int:
        """Largest number of rows in a chunk."""
        return max(1, int(CHUNK_S * self._info.rate_hz)) if self._info else JOINED_ROWS

    def _pieces(self, block: Block) -> Iterator[Block]:
        """A block of a recording in pieces that fit into a chunk each; one of a link is as it came."""
        rows, most = len(block.counts), self._most_rows
        if self._recorded is None or rows <= most or self._info is None:
            yield block
            return
        for start in range(0, rows, most):
            stop, period_ns = min(start + most, rows), 1e9 / self._info.rate_hz
            host_ns = block.t_host_ns - round((rows - stop) * period_ns)
            device_ns = None if block.t_device_ns is None else block.t_device_ns + round(start * period_ns)
            yield Block(block.index + start, block.counts[start:stop], host_ns, device_ns)

    def _join(self) -> None:
        """Write the blocks that wait as one message."""
        if not self._waiting or self._info is None:
            return
        blocks, self._waiting, self._waiting_rows = self._waiting, [], 0
        last = blocks[-1]
        wall_ns = last.t_host_ns + self._wall_offset_ns
        if not self._axis_ns:
            self._axis_ns = wall_ns - round((last.index + len(last.counts) - 1) * 1e9 / self._info.rate_hz)
        self._last_ns = wall_ns
        stop = last.index + len(last.counts)
        if self._chunk_index is not None and stop - self._chunk_index > self._most_rows:
            self._end_chunk()
        self._chunk_index = blocks[0].index if self._chunk_index is None else self._chunk_index
        self._add(codec.RAW_CHANNEL, wall_ns, codec.encode_blocks(blocks), self._on_axis(blocks[0].index))
        if self._envelope:
            counts = last.counts if len(blocks) == 1 else np.concatenate([b.counts for b in blocks])
            self._preview(self._envelope.feed(blocks[0].index, counts))

    def _on_axis(self, index: int) -> int:
        rate_hz = self._info.rate_hz if self._info else 1.0
        return min(max(0, self._axis_ns + round(index * 1e9 / rate_hz)), 2**63)

    def _preview(self, windows: list[Extremes]) -> None:
        """The least value at the start of its window, the greatest at its middle: a plot shows the envelope."""
        if not windows or self._info is None or self._envelope is None:
            return
        scale = np.array([s.scale for s in self._info.signals])
        offset = np.array([s.offset for s in self._info.signals])
        half = self._envelope.rows // 2
        for index, low, high in windows:
            for at, counts in ((index, low), (index + half, high)) if half else ((index, low),):
                for signal, value in zip(self._info.signals, counts * scale + offset, strict=True):
                    topic = self._preview_id(codec.PREVIEW_TOPIC + signal.name, signal.unit)
                    self._add(topic, self._on_axis(at), codec.encode_multi_array(np.array([value])))
