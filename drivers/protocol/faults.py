"""Faults of a simulated device, on schedule or at random."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FAULT_KINDS = (
    "drop",         # frames lost on the way
    "duplicate",    # frames sent twice
    "reorder",      # a frame comes after its successor
    "flip",         # a bit flipped on the way: the check sum finds it
    "short",        # a byte missing on the way
    "device_lost",  # the device has no room and says so
    "stuck",        # the counter stands still, samples go on
    "silent",       # nothing is sent, sampling goes on
    "restart",      # the device starts again; count = frames it is away
    "version",      # frames of another protocol version
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of kind `kind` in `count` frames from frame number `at` on (frames of samples since the first start)."""

    kind: str
    at: int
    count: int = 1

    def __post_init__(self) -> None:
        if self.kind not in FAULT_KINDS:
            raise ValueError(f"no fault {self.kind!r}; there are {', '.join(FAULT_KINDS)}")
        if self.at < 0 or self.count < 1:
            raise ValueError(f"fault {self.kind}: at >= 0 and count >= 1, got {self.at} and {self.count}")


def active(faults: tuple[Fault, ...], kind: str, first: int, n: int) -> NDArray[np.bool_]:
    """(n,) which of the frames first .. first + n - 1 a scheduled fault of this kind hits."""
    mask = np.zeros(n, np.bool_)
    for fault in faults:
        if fault.kind == kind:
            mask[max(0, fault.at - first) : max(0, fault.at + fault.count - first)] = True
    return mask
