"""Many CAN frames as arrays: what every CAN link hands to its decoder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

EXTENDED_FLAG = 0x8000_0000  # set in `ids` for a 29-bit identifier, as in Linux's can_id
REMOTE_FLAG = 0x4000_0000  # a remote request, CAN_RTR_FLAG of linux/can.h
ERROR_FLAG = 0x2000_0000  # an error frame, CAN_ERR_FLAG of linux/can.h


@dataclass(frozen=True, slots=True)
class CanFrames:
    """ids : (n,) uint32 with the flags above. lengths : (n,) bytes of payload. payload : (n, 64) uint8, zero padded.

    t_ns : (n,) when each was received, by the best clock there is (hardware, kernel, or the host at the read).
    """

    ids: NDArray[np.uint32]
    lengths: NDArray[np.uint8]
    payload: NDArray[np.uint8]
    t_ns: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.ids)

    def pick(self, which: NDArray[np.bool_] | slice) -> CanFrames:
        """Some of the frames."""
        return CanFrames(self.ids[which], self.lengths[which], self.payload[which], self.t_ns[which])

    @classmethod
    def build(cls, frames: list[tuple[int, bytes, int]]) -> CanFrames:
        """From (id with flags, data, t_ns) triples."""
        n = len(frames)
        joined = b"".join(data[:64].ljust(64, b"\0") for _, data, _ in frames)
        return cls(
            np.fromiter((i for i, _, _ in frames), np.uint32, n),
            np.fromiter((min(len(data), 64) for _, data, _ in frames), np.uint8, n),
            np.frombuffer(joined, np.uint8).reshape(n, 64),
            np.fromiter((t for _, _, t in frames), np.int64, n),
        )
