"""Classic CAN samples: a 4-bit counter places a frame only modulo 16, so whole windows are placed between sync frames.

A window whose counters do not fit the sync frames on its two sides could be shifted by 16 samples somewhere. No sample
of the window can be trusted: the window is dropped, and becomes a gap of known size.
"""

from __future__ import annotations

import numpy as np

from drivers.contract.notices import Notices
from drivers.contract.reading import LinkStats
from drivers.protocol import protocol
from drivers.protocol.protocol import SYNC_MODULUS, SampleFrames

MAX_FRAMES = 1 << 16  # held without a sync frame: the device is not speaking this protocol


class ClassicWindow:
    """Sample frames since the last sync frame."""

    def __init__(self, stats: LinkStats, notices: Notices) -> None:
        self._stats = stats
        self._notices = notices
        self._payload: list[protocol.U8Array] = []
        self._held = 0
        self._start: tuple[int, int, int] | None = None  # index, epoch, time of the sync frame before the window

    def reset(self) -> None:
        """The link was lost: the window cannot be completed."""
        self._payload, self._held, self._start = [], 0, None

    def add(self, payload: protocol.U8Array) -> None:
        """(n, 64) sample payloads."""
        if self._start is None or len(payload) == 0:
            return
        self._payload.append(payload[:, :8].copy())
        self._held += len(payload)
        if self._held > MAX_FRAMES:
            self.reset()

    def sync(
        self, index: int, epoch: int, time_us: int, rate_hz: float, channels: int, t_host_ns: int
    ) -> SampleFrames | None:
        """Close the window at this sync frame and place its samples; None if no sample can be trusted."""
        start, held = self._start, self._payload
        self._payload, self._held, self._start = [], 0, (index, epoch, time_us)
        if start is None or start[1] != epoch or not held:
            return None
        counter, counts = protocol.unpack_classic(np.concatenate(held), channels)
        if not len(counter):  # frames too short to hold a sample
            return None
        again = np.zeros(len(counter), np.bool_)
        again[1:] = (np.diff(counter) == 0) & (np.diff(counts, axis=0) == 0).all(axis=1)
        if again.any():
            self._stats.duplicates += int(again.sum())
            self._notices.add(t_host_ns, "warning", "duplicate", "frames came twice: dropped")
            counter, counts = counter[~again], counts[~again]
        steps = np.diff(counter, prepend=start[0] % 16) % 16
        place = np.cumsum(steps)
        window = (index - start[0]) % SYNC_MODULUS
        behind = (index - 1 - int(counter[-1])) % 16
        # a counter that stands still: stuck, or 16 frames lost
        if (steps[1:] == 0).any() or window - 1 - int(place[-1]) != behind:
            self._notices.add(t_host_ns, "warning", "window_dropped",
                              f"{len(counts)} samples between two sync frames have no index: dropped")  # fmt: skip
            self._stats.count("unplaced_samples", len(counts))
            return None
        n = len(counts)
        return SampleFrames(
            position=(start[0] + place) % SYNC_MODULUS, modulus=SYNC_MODULUS, lost=np.zeros(n, np.uint8),
            epoch=np.full(n, epoch, np.uint8),
            time_us=(start[2] + np.round(place * (1e6 / rate_hz)).astype(np.int64)) % protocol.TIME_MODULUS_US,
            time_modulus=protocol.TIME_MODULUS_US, counts=counts.reshape(n, 1, channels),
        )  # fmt: skip
