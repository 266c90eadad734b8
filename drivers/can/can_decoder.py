"""Protocol v1 on CAN: frames in, readings out. Pure: no I/O, no clock, never raises on wire data."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drivers.contract.notices import Notices
from drivers.contract.reading import Info, LinkStats, Reading
from drivers.protocol import protocol
from drivers.protocol.continuity import Continuity
from drivers.protocol.device_info import DeviceInfo, Expected
from drivers.protocol.protocol import CLASSIC_LAYOUT, FD16_LAYOUT, PROTOCOL_VERSION, SampleFrames
from drivers.protocol.stated_rate import StatedRate

from .can_frames import CanFrames
from .classic import ClassicWindow

SYNC_FRESH_NS = 500_000_000


@dataclass(frozen=True, slots=True)
class _Sync:
    index: int
    time_us: int
    epoch: int
    t_host_ns: int


class CanDecoder:
    """One device at identifiers base .. base + 6; frames of other identifiers are counted and passed over.

    unchecked : the link has no check sum (slcan): FD frames that their neighbours contradict are dropped.
    """

    def __init__(
        self, stats: LinkStats, base_id: int = protocol.BASE_ID, expected: Expected | None = None, *,
        unchecked: bool = False,
    ) -> None:  # fmt: skip
        self.stats = stats
        self.notices = Notices()
        self._base = base_id
        self._device = DeviceInfo(self.notices, expected, unchecked)
        self._axis = Continuity(stats, self.notices, self._device.starts)
        self._rate = StatedRate(self.notices, expected.rate_hz if expected else None)
        self._classic = ClassicWindow(stats, self.notices)
        self._unchecked = unchecked
        self._doubted: _Sync | None = None  # a sync frame that contradicts the last one
        self._sync: _Sync | None = None  # the last sync frame

    def cause(self, reason: str) -> None:
        """Why samples may be missing before the next frame (see Continuity)."""
        self._axis.cause(reason)
        if reason == "reconnect":
            self._classic.reset()

    def nothing(self) -> str:
        """Why no sample has come."""
        others = self.stats.other.get("other_frames", 0)
        if self._device.info is not None or not others:
            return "check the device"
        return (
            f"{others} frames came, none of a device of protocol v1 at 0x{self._base:X} to "
            f"0x{self._base + protocol.ID_INFO_PART:X}: for another maker's set link.dbc and [link.signals], else ?id="
        )

    def finish(self, t_host_ns: int) -> list[Reading]:
        """Nothing is held: the device counts its samples."""
        return list(self.notices.take())

    def wanted(self, frames: CanFrames) -> NDArray[np.bool_]:
        """(n,) frames of the device."""
        offset = frames.ids.astype(np.int64) - self._base
        return np.asarray((offset >= 0) & (offset <= protocol.ID_INFO_PART))

    def feed(self, frames: CanFrames, t_host_ns: int) -> list[Reading]:
        """Readings of these frames; t_host_ns is when the last was read."""
        out: list[Reading] = []
        if len(frames) == 0:
            return out
        offset = frames.ids.astype(np.int64) - self._base
        ours = (offset >= 0) & (offset <= protocol.ID_INFO_PART)
        others = int(len(frames) - ours.sum())
        if others:
            self.stats.count("other_frames", others)
            if others == len(frames):
                return out
        kinds = np.where(ours, offset, -1)
        cuts = np.flatnonzero(np.diff(kinds)) + 1  # runs of one identifier; nearly always one long run
        starts = [0, *cuts.tolist(), len(frames)]
        for start, stop in zip(starts[:-1], starts[1:], strict=True):
            kind = int(kinds[start])
            if kind >= 0:
                self._run(kind, frames.payload[start:stop], frames.lengths[start:stop], t_host_ns, out)
        return out + self.notices.take()

    def _run(
        self, kind: int, payload: protocol.U8Array, lengths: protocol.U8Array, t_host_ns: int, out: list[Reading]
    ) -> None:
        if self._device.mixed(t_host_ns) and kind not in (protocol.ID_INFO, protocol.ID_INFO_PART):
            self.stats.count("mixed_frames", len(payload))
            return
        if kind in protocol.SAMPLE_ID.values():
            self._samples(kind, payload, lengths, t_host_ns, out)
            return
        for row, length in zip(payload, lengths.tolist(), strict=True):
            data = row[:length].tobytes()
            if kind == protocol.ID_INFO:
                self._announce(self._device.record(data, t_host_ns), t_host_ns, out)
            elif kind == protocol.ID_INFO_PART and length >= 8:
                self._announce(self._device.part(data, t_host_ns), t_host_ns, out)
            elif kind == protocol.ID_SYNC and length >= 8:
                self._sync_classic(*protocol.unpack_sync(data), t_host_ns, out)
            elif kind == protocol.ID_SYNC_FD and length >= 12:
                index, flags, time_us = protocol.unpack_sync_fd(data)
                if self._ours(flags, t_host_ns):
                    marked = self._rate.mark(index, protocol.NO_MODULUS, time_us, t_host_ns)
                    self._use(marked, t_host_ns, out)
                    self._synchronise(_Sync(index, time_us, flags >> 4, t_host_ns))

    def _announce(self, info: Info | None, t_host_ns: int, out: list[Reading]) -> None:
        if info is not None:
            self._use((self._rate.begin(info, t_host_ns, self._device.layout is FD16_LAYOUT), []), t_host_ns, out)

    def _use(self, decided: tuple[Info | None, list[SampleFrames]], t_host_ns: int, out: list[Reading]) -> None:
        """Announce a description whose rate has been held against the frames, and place these."""
        info, held = decided
        if info is not None:
            self._device.use(info)
            self._axis.describe(info.rate_hz)
            out.append(info)
        info = info or self._device.info
        for frames in held:
            if info is not None:
                place = self._axis.feed_unchecked if self._unchecked else self._axis.feed
                timed = frames if frames.time_us is not None else self._timed(frames, info, t_host_ns)
                out.extend(place(timed, t_host_ns))

    def _ours(self, flags: int, t_host_ns: int) -> bool:
        version = (flags >> 2) & 3
        if version != PROTOCOL_VERSION:
            self._device.other_version(version, t_host_ns)
        return version == PROTOCOL_VERSION

    def _samples(
        self, kind: int, payload: protocol.U8Array, lengths: protocol.U8Array, t_host_ns: int, out: list[Reading]
    ) -> None:
        layout, info = self._device.layout, self._device.info
        if layout is None or info is None:
            return  # the record begins with the first description
        if kind != protocol.SAMPLE_ID.get(layout.name):
            self.stats.count("layout_mismatch", len(payload))
            text = f"sample frames are not of the layout that the device announced ({layout.name}): dropped"
            self.notices.add(t_host_ns, "warning", "layout_mismatch", text)
            return
        if layout is CLASSIC_LAYOUT:
            whole = lengths >= 8
            self.stats.frames += int(whole.sum())
            if not whole.all():
                self._refuse(True, payload[~whole], t_host_ns)
            self._classic.add(payload[whole])
            return
        # 0 good, 1 too short, 2 another version; both FD layouts have the flags in byte 3
        state = np.where(protocol.flags_version(payload[:, 3]) == PROTOCOL_VERSION, 0, 2)
        state[lengths < protocol.FD_LENGTH] = 1
        cuts = (np.flatnonzero(np.diff(state)) + 1).tolist()
        for start, stop in zip([0, *cuts], [*cuts, len(state)], strict=True):
            if state[start]:
                self._refuse(state[start] == 1, payload[start:stop], t_host_ns)
                continue
            self.stats.frames += stop - start
            if layout is FD16_LAYOUT:
                frames = protocol.unpack_fd16(payload[start:stop], len(info.signals))
            else:
                frames = protocol.unpack_fd24(payload[start:stop], len(info.signals))
            self._use(self._rate.admit(frames, t_host_ns), t_host_ns, out)

    def _synchronise(self, new: _Sync, modulus: int = protocol.NO_MODULUS) -> bool:
        """Take a sync frame; on a link without check sums not before another one agrees with it."""
        known = [old for old in (self._sync, self._doubted) if old is not None]
        if self._unchecked and known and not any(self._agree(old, new, modulus) for old in known):
            self._doubted = new
            return False
        self._sync, self._doubted = new, None
        return True

    def _agree(self, old: _Sync, new: _Sync, modulus: int) -> bool:
        info = self._device.info
        if info is None:
            return True
        elapsed_us = (new.time_us - old.time_us) % protocol.TIME_MODULUS_US
        counted_us = (new.index - old.index) % modulus * 1e6 / info.rate_hz
        # one oscillator drives both
        return old.epoch == new.epoch and abs(elapsed_us - counted_us) <= 50 + 1e-4 * elapsed_us

    def _refuse(self, short: bool, payload: protocol.U8Array, t_host_ns: int) -> None:
        if short:
            self.stats.crc_errors += len(payload)
            self.notices.add(t_host_ns, "warning", "short_frame", "sample frames with too few bytes: dropped")
        else:
            self.stats.count("other_version", len(payload))
            self._device.other_version(int(protocol.flags_version(payload[:1, 3])[0]), t_host_ns)
        self._axis.cause("crc" if short else "version")

    def _timed(self, frames: SampleFrames, info: Info, t_host_ns: int) -> SampleFrames:
        """The frames, with the time of the last sync frame if they carry none and it is recent."""
        if self._sync is None or t_host_ns - self._sync.t_host_ns > SYNC_FRESH_NS or len(frames) == 0:
            return frames
        index, time_us = self._sync.index, self._sync.time_us
        ahead = (frames.position - index) % frames.modulus
        if int(ahead.max()) > frames.modulus // 2:
            return frames
        stamp = (time_us + np.round(ahead * (1e6 / info.rate_hz)).astype(np.int64)) % protocol.TIME_MODULUS_US
        return replace(frames, time_us=stamp)

    def _sync_classic(self, index: int, flags: int, time_us: int, t_host_ns: int, out: list[Reading]) -> None:
        info = self._device.info
        if info is None or self._device.layout is not CLASSIC_LAYOUT or not self._ours(flags, t_host_ns):
            return
        self._use(self._rate.mark(index, protocol.SYNC_MODULUS, time_us, t_host_ns), t_host_ns, out)
        info = self._device.info or info
        if not self._synchronise(_Sync(index, time_us, flags >> 4, t_host_ns), protocol.SYNC_MODULUS):
            return  # if this sync frame is wrong, the next one closes the window
        self._axis.begin(index, flags >> 4, time_us, t_host_ns)
        frames = self._classic.sync(index, flags >> 4, time_us, info.rate_hz, len(info.signals), t_host_ns)
        if frames is not None:
            out.extend(self._axis.feed(frames, t_host_ns))
