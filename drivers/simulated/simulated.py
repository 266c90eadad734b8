"""A simulated device: takes analogue samples, returns the frames of a real device, with faults on request."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.contract.reading import Signal
from drivers.protocol import protocol
from drivers.protocol.faults import FAULT_KINDS, Fault, active
from drivers.protocol.protocol import LAYOUT_OF_NAME, SAMPLE_ID, InfoRecord
from drivers.serial.serial_decoder import pack_info_body, pack_samples

Samples = Callable[[int], NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class DeviceConfig:
    """Settings of a simulated device.

    rate_hz : sampling rate by its own clock, Hz.
    channels, units : names and units of the channels.
    full_scale : value of the largest count, in `units`; one for all channels or one each.
    layout : name of the layout of its frames.
    count_bits : of a sample; None: those of the layout.
    rows : samples of each channel in a serial frame.
    serial_number : of the device.
    epoch : number of its first start.
    base_id : first of its CAN identifiers.
    clock_ppm : how much faster than the truth its clock runs.
    jitter_s : mean delay of its frames (exponential), s.
    burst_s : period at which an adapter hands frames on together, s; 0: each by itself.
    seconds : length of the data; None: without end.
    seed : of the random faults and delays.
    faults : scheduled faults.
    fault_rates : kind of fault -> probability per frame.
    """

    rate_hz: float
    channels: tuple[str, ...]
    units: tuple[str, ...] = ()
    full_scale: float | tuple[float, ...] = 490.5
    _: KW_ONLY
    layout: str = "fd16"
    count_bits: int | None = None
    rows: int = 64
    serial_number: int = 0x52530001
    epoch: int = 1
    base_id: int = protocol.BASE_ID
    clock_ppm: float = 0.0
    jitter_s: float = 0.0
    burst_s: float = 0.0
    seconds: float | None = None
    seed: int = 0
    faults: tuple[Fault, ...] = ()
    fault_rates: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        layout = LAYOUT_OF_NAME.get(self.layout)
        if layout is None:
            raise ValueError(f"no layout {self.layout!r}; there are {', '.join(LAYOUT_OF_NAME)}")
        if not 1 <= len(self.channels) <= layout.max_channels:
            many = len(self.channels)
            raise ValueError(f"layout {self.layout} carries 1 to {layout.max_channels} channels, not {many}")
        unknown = set(self.fault_rates) - set(FAULT_KINDS)
        if unknown:
            raise ValueError(f"no fault {', '.join(sorted(unknown))}; there are {', '.join(FAULT_KINDS)}")

    @property
    def bits(self) -> int:
        return self.count_bits or LAYOUT_OF_NAME[self.layout].bits

    @property
    def frame_rows(self) -> int:
        return self.rows if self.serial else LAYOUT_OF_NAME[self.layout].rows(len(self.channels))

    @property
    def serial(self) -> bool:
        return self.layout.startswith("serial")

    def signals(self) -> tuple[Signal, ...]:
        """The channels as the device describes them."""
        scales = np.broadcast_to(self.full_scale, len(self.channels)) / (2 ** (self.bits - 1) - 1)
        units = self.units or ("m/s^2",) * len(self.channels)
        return tuple(Signal(*each) for each in zip(self.channels, units, scales.tolist(), strict=True))


@dataclass(frozen=True, slots=True)
class WireFrame:
    """One frame leaving the device at true time `due_s`. identifier: CAN, -1 on a serial line (data = the body).

    damaged: the wire flips a bit in it ("flip") or loses a byte ("short"); "" if neither.
    """

    due_s: float
    identifier: int
    data: bytes
    damaged: str = ""


class SimulatedDevice:
    """Turns `source(n) -> (n, channels)`, in the channels' units, into frames. Not thread-safe; no global state."""

    def __init__(self, source: Samples, config: DeviceConfig) -> None:
        self.config = config
        self.frames_made = 0  # frames of samples, sent or not
        self.samples_made = 0  # since the first start, including the time it was away
        self._source = source
        self._signals = config.signals()
        self._scale = np.array([signal.scale for signal in self._signals])
        self._rng = np.random.default_rng(config.seed)
        self._index = 0  # the device's own, 0 at each start
        self._epoch = config.epoch
        self._lost = 0
        self._stuck_at: int | None = None

    @property
    def finished(self) -> bool:
        seconds = self.config.seconds
        return seconds is not None and self.samples_made >= seconds * self.config.rate_hz

    def overrun(self, frames: int) -> None:
        """Count frames for which the link had no room; later frames report them."""
        self._lost += frames

    def next(self, frames: int) -> list[WireFrame]:
        """The next `frames` frames of samples as they leave, with sync and info frames among them."""
        out: list[WireFrame] = []
        while frames > 0:
            starts = [f for f in self.config.faults if f.kind == "restart" and f.at >= self.frames_made]
            at = min((f.at for f in starts), default=self.frames_made + frames)
            n = min(frames, at - self.frames_made)
            if n > 0:
                out += self._frames(n)
                frames -= n
                continue
            self._restart(next(f.count for f in starts if f.at == at))
            frames -= 1
        return out

    def _restart(self, away: int) -> None:
        self._source(away * self.config.frame_rows)  # the machine runs on
        self.samples_made += away * self.config.frame_rows
        self.frames_made += 1
        self._index, self._lost, self._epoch = 0, 0, self._epoch % 15 + 1

    def _hit(self, kind: str, n: int) -> NDArray[np.bool_]:
        mask = active(self.config.faults, kind, self.frames_made, n)
        rate = self.config.fault_rates.get(kind, 0.0)
        return mask | (self._rng.random(n) < rate) if rate else mask

    def _counts(self, n: int) -> tuple[protocol.I32Array, NDArray[np.bool_]]:
        """(n, rows, channels) counts, and which frames have a clipped one."""
        limit = 2 ** (self.config.bits - 1) - 1
        raw = np.rint(self._source(n * self.config.frame_rows) / self._scale)
        clipped = (np.abs(raw) > limit).reshape(n, -1).any(axis=1)
        counts = np.clip(raw, -limit, limit).astype(np.int32)
        return counts.reshape(n, self.config.frame_rows, len(self._scale)), clipped

    def _frames(self, n: int) -> list[WireFrame]:
        config, rows = self.config, self.config.frame_rows
        counts, clipped = self._counts(n)
        index = self._index + rows * np.arange(n, dtype=np.int64)
        stamp = np.round(index * (1e6 / config.rate_hz)).astype(np.int64)
        away = self._hit("device_lost", n)
        lost = (self._lost + np.cumsum(away)).astype(np.int64)
        version = np.where(self._hit("version", n), protocol.PROTOCOL_VERSION + 1, protocol.PROTOCOL_VERSION)
        keep = ~(away | self._hit("drop", n) | self._hit("silent", n))
        twice, flip, short = self._hit("duplicate", n), self._hit("flip", n), self._hit("short", n)
        payloads = self._pack(self._stick(index), lost & 255, version, clipped, stamp, counts)
        identifier = -1 if config.serial else config.base_id + SAMPLE_ID[config.layout]
        due = self._due(n)
        out: list[WireFrame] = []
        for k in self._order(n):
            self._beats(int(index[k]), rows, int(stamp[k]), float(due[k]), out)
            if keep[k]:
                damaged = "flip" if flip[k] else "short" if short[k] else ""
                frame = WireFrame(float(due[k]), identifier, payloads[k], damaged)
                out.extend([frame, frame] if twice[k] else [frame])
        self._lost = int(lost[-1])
        self._index += n * rows
        self.samples_made += n * rows
        self.frames_made += n
        return out

    def _stick(self, index: protocol.I64Array) -> protocol.I64Array:
        """The index as sent: it stands still while a "stuck" fault lasts."""
        stuck = self._hit("stuck", len(index))
        if not stuck.any():
            self._stuck_at = None
            return index
        sent = index.copy()
        for k in np.flatnonzero(stuck):
            earlier = index[0] - self.config.frame_rows if self._stuck_at is None else self._stuck_at
            sent[k] = max(0, int(sent[k - 1] if k else earlier))
        self._stuck_at = int(sent[-1]) if stuck[-1] else None
        return sent

    def _order(self, n: int) -> list[int]:
        order = list(range(n))
        for k in np.flatnonzero(self._hit("reorder", n)):
            if k + 1 < n:
                order[k], order[k + 1] = order[k + 1], order[k]
        return order

    def _due(self, n: int) -> NDArray[np.float64]:
        """(n,) true times at which the frames leave: their last sample has been taken."""
        config = self.config
        last = self.samples_made + config.frame_rows * np.arange(1, n + 1)
        due = last / (config.rate_hz * (1 + 1e-6 * config.clock_ppm))
        if config.jitter_s:
            due = np.maximum.accumulate(due + self._rng.exponential(config.jitter_s, n))
        if config.burst_s:
            due = np.ceil(due / config.burst_s) * config.burst_s
        return np.asarray(due)

    def _pack(
        self, index: protocol.I64Array, lost: protocol.I64Array, version: NDArray[np.int64], clipped: NDArray[np.bool_],
        stamp: protocol.I64Array, counts: protocol.I32Array,
    ) -> list[bytes]:  # fmt: skip
        layout, n = self.config.layout, len(index)
        flags = (clipped.astype(np.int64) | (version & 3) << 2 | self._epoch << 4).astype(np.uint8)
        if self.config.serial:
            bits = LAYOUT_OF_NAME[layout].bits
            bodies = [
                pack_samples(int(index[k]), int(lost[k]), int(flags[k]), int(stamp[k]), counts[k], bits)
                for k in range(n)
            ]
            return [bytes((int(v),)) + body[1:] for v, body in zip(version, bodies, strict=True)]
        seq = index // self.config.frame_rows
        if layout == "fd16":
            packed = protocol.pack_fd16(seq, lost.astype(np.uint8), flags, stamp, counts)
        elif layout == "fd24":
            packed = protocol.pack_fd24(seq, lost.astype(np.uint8), flags, counts)
        else:
            packed = protocol.pack_classic(seq, counts[:, 0])
        joined, width = packed.tobytes(), packed.shape[1]
        return [joined[k * width : (k + 1) * width] for k in range(n)]

    def _beats(self, index: int, rows: int, stamp: int, due_s: float, out: list[WireFrame]) -> None:
        """Info frames once a second and at the start, sync frames ten times a second, before the frame of `index`."""
        rate, base, layout = self.config.rate_hz, self.config.base_id, self.config.layout
        if _crosses(index, rows, rate):
            for record in self.records():
                if self.config.serial:
                    out.append(WireFrame(due_s, -1, pack_info_body(record)))
                elif layout == "classic":
                    out += [WireFrame(due_s, base + protocol.ID_INFO_PART, p) for p in protocol.pack_info_parts(record)]
                else:
                    out.append(WireFrame(due_s, base + protocol.ID_INFO, protocol.pack_info(record)))
        if layout in ("fd24", "classic") and _crosses(index, rows, rate / protocol.SYNC_HZ):
            flags = protocol.PROTOCOL_VERSION << 2 | self._epoch << 4
            if layout == "fd24":
                out.append(WireFrame(due_s, base + protocol.ID_SYNC_FD, protocol.pack_sync_fd(index, flags, stamp)))
            else:
                out.append(WireFrame(due_s, base + protocol.ID_SYNC, protocol.pack_sync(index, flags, stamp)))

    def records(self) -> list[InfoRecord]:
        """The device's description, one record a channel."""
        config = self.config
        scale = np.broadcast_to(config.full_scale, len(config.channels)).tolist()
        return [
            InfoRecord(
                layout=LAYOUT_OF_NAME[config.layout].code, channels=len(config.channels), channel=k,
                count_bits=config.bits, serial_number=config.serial_number,
                rate_hz=config.rate_hz, signal=signal, full_scale=scale[k], epoch=self._epoch,
            )
            for k, signal in enumerate(self._signals)
        ]  # fmt: skip


def _crosses(index: int, rows: int, period: float) -> bool:
    """Whether a multiple of `period` (samples) lies in index .. index + rows - 1."""
    return int((index + rows - 1) // period) != int((index - 1) // period)
