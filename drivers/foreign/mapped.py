"""CAN frames of other makers' devices: a DBC file and a signal map -> samples on a time-derived index axis.

One cycle of the mapped messages is one sample. Frames a device sends together win the bus in the order of their
identifiers, so the lowest one opens a cycle. A cycle in which a signal is missing or not available is a gap.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from drivers.can.can_frames import ERROR_FLAG, REMOTE_FLAG, CanFrames
from drivers.contract.notices import Notices
from drivers.contract.reading import Block, Gap, Info, LinkStats, Reading
from drivers.protocol.device_info import Expected
from drivers.protocol.time_axis import TimeAxis

from .signal_plan import Message, compile_plan

MAX_OPEN = 4096  # frames kept of a cycle that is not complete


class MappedDecoder:
    """recorded : host time of a block is the recorded time of its last frame (a capture), not that of the read."""

    def __init__(
        self, stats: LinkStats, dbc: bytes, signals: Mapping[str, str], expected: Expected | None = None,
        rate_hz: float | None = None, recorded: bool = False,
    ) -> None:  # fmt: skip
        self.stats = stats
        self.notices = Notices()
        self._plan = compile_plan(dbc, signals)
        rate = rate_hz if rate_hz is not None else expected.rate_hz if expected else None
        self._axis = TimeAxis(rate)
        self._recorded = recorded
        self._open: CanFrames | None = None
        self._counts = np.empty((0, len(self._plan.signals)), np.int32)
        self._valid = np.empty(0, np.bool_)
        self._times = np.empty(0, np.int64)
        self._index = 0
        self._announced = False
        self._reason = "source"
        self._sources: dict[str, int] = {}
        self._seen_back = 0

    def cause(self, reason: str) -> None:
        """Why samples may be missing before the next frame."""
        if self._announced and reason in ("reconnect", "overflow"):
            self._reason = reason

    def feed(self, frames: CanFrames, t_host_ns: int, final: bool = False) -> list[Reading]:
        """Readings of these frames; `final` places what is held as well."""
        self.stats.frames += len(frames)
        counts, valid, times = self._cycles(frames, t_host_ns, final)
        self._counts = np.concatenate([self._counts, counts])
        self._valid = np.concatenate([self._valid, valid])
        self._times = np.concatenate([self._times, times])
        index = self._axis.place(times, final)
        out: list[Reading] = []
        if self._axis.rate_hz is not None and len(index):
            if not self._announced:
                self._announced = True
                out.append(Info(self._plan.signals, self._axis.rate_hz, "", self._plan.count_bits))
            self._emit(index, t_host_ns, out)
        if self._axis.stepped_back != self._seen_back:
            self._seen_back = self._axis.stepped_back
            self.notices.add(t_host_ns, "warning", "clock_set_back", "the time stamps of the frames went back")
        return out + self.notices.take()

    def _emit(self, index: NDArray[np.int64], t_host_ns: int, out: list[Reading]) -> None:
        n = len(index)
        counts, valid, times = self._counts[:n], self._valid[:n], self._times[:n]
        self._counts, self._valid, self._times = self._counts[n:], self._valid[n:], self._times[n:]
        index, counts, times = index[valid], counts[valid], times[valid]
        cuts = (np.flatnonzero(np.diff(index) != 1) + 1).tolist()
        for start, stop in zip([0, *cuts], [*cuts, len(index)], strict=True):
            if start == stop:
                continue
            if index[start] > self._index:
                missing = int(index[start]) - self._index
                out.append(Gap(self._index, missing, self._reason))
                self.stats.lost_samples += missing
            self._reason = "source"
            self._index = int(index[stop - 1]) + 1
            t_ns = int(times[stop - 1]) if self._recorded else t_host_ns
            out.append(Block(int(index[start]), np.ascontiguousarray(counts[start:stop]), t_ns))

    def _cycles(
        self, frames: CanFrames, t_host_ns: int, final: bool
    ) -> tuple[NDArray[np.int32], NDArray[np.bool_], NDArray[np.int64]]:
        """Counts (n, channels), valid (n,) and times (n,) of the complete cycles."""
        which = self._which(frames, t_host_ns)
        mine = which >= 0
        frames = frames.pick(mine)
        which = which[mine]
        if self._open is not None:
            frames = _join(self._open, frames)
            which = self._which(frames, t_host_ns)
        cycle = np.cumsum(which == 0) - 1
        keep, self._open = cycle >= 0, None
        n = int(cycle[-1]) + 1 if len(cycle) else 0
        if len(self._plan.messages) > 1 and not final and n > 0:
            n -= 1  # the last cycle is still open
            still = cycle == n
            if int(still.sum()) <= MAX_OPEN:
                self._open = frames.pick(still)
            keep &= cycle < n
        counts = np.zeros((n, len(self._plan.signals)), np.int32)
        valid = np.zeros((n, len(self._plan.signals)), np.bool_)
        for number, message in enumerate(self._plan.messages):
            rows = np.flatnonzero(keep & (which == number))
            payload, lengths = frames.payload[rows], frames.lengths[rows]
            for each, column in zip(message.fields, message.columns, strict=True):
                value, good = each.read(payload, lengths)
                counts[cycle[rows[good]], column] = value[good]
                valid[cycle[rows[good]], column] = True
        return counts, np.asarray(valid.all(axis=1)), np.asarray(frames.t_ns[keep & (which == 0)])

    def _which(self, frames: CanFrames, t_host_ns: int) -> NDArray[np.int64]:
        """(n,) number of the mapped message each frame is, -1 for none."""
        which = np.full(len(frames), -1, np.int64)
        plain = (frames.ids & np.uint32(ERROR_FLAG | REMOTE_FLAG)) == 0
        for number, message in enumerate(self._plan.messages):
            hit = plain & ((frames.ids & np.uint32(message.mask)) == message.identifier)
            if message.mask != 0xFFFF_FFFF and hit.any():
                hit &= self._one_source(message, frames, hit, t_host_ns)
            which[hit] = number
        return which

    def _one_source(
        self, message: Message, frames: CanFrames, hit: NDArray[np.bool_], t_host_ns: int
    ) -> NDArray[np.bool_]:
        """J1939: the first source address seen is the device; others with the same message are counted and told."""
        address = frames.ids & np.uint32(0xFF)
        first = self._sources.setdefault(message.name, int(address[np.flatnonzero(hit)[0]]))
        same = address == first
        others = int((hit & ~same).sum())
        if others:
            self.stats.count("other_source", others)
            text = f"{message.name} comes from several source addresses: only 0x{first:02X} is taken"
            self.notices.add(t_host_ns, "warning", "other_source", text)
        return np.asarray(same)


def _join(a: CanFrames, b: CanFrames) -> CanFrames:
    return CanFrames(
        np.concatenate([a.ids, b.ids]), np.concatenate([a.lengths, b.lengths]),
        np.concatenate([a.payload, b.payload]), np.concatenate([a.t_ns, b.t_ns]),
    )  # fmt: skip
