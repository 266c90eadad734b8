"""Stamps of a clock that can be set (the kernel's are the computer's time of day), held against the steady clock."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LEAST_JUMP_NS = 50_000_000  # a smaller jump may be a frame that is read late; time services slew smaller errors
LEAST_STEP_SHARE = 0.9  # of a jump that lies between two stamps; else the earlier frames were read late

I64Array = NDArray[np.int64]


class SteadyStamps:
    """`take` counts on over a clock that was set forwards: no frame can be stamped later than it is read.

    A clock that was set back shows in the stamps themselves (TimeAxis).
    """

    def __init__(self) -> None:
        self.jumped_ns = 0  # forwards, not reported yet; the caller that reports it sets it to 0
        self._set_ns = 0  # forwards, in all
        self._most_ns: int | None = None  # by which a stamp has been ahead of the steady clock at the read
        self._last_ns = 0

    def take(self, t_ns: I64Array, t_host_ns: int) -> I64Array:
        """(n,) stamps as if the clock had not been set forwards. t_host_ns : steady clock when they were read."""
        if len(t_ns) == 0:
            return t_ns
        t_ns = t_ns - self._set_ns
        ahead_ns = int(t_ns[-1]) - t_host_ns
        if self._most_ns is None:
            self._most_ns, self._last_ns = ahead_ns, int(t_ns[0])
        steps = np.diff(t_ns, prepend=self._last_ns)
        if (steps < -LEAST_JUMP_NS).any():
            self._most_ns = ahead_ns
        jump_ns, at = ahead_ns - self._most_ns, int(np.argmax(steps))
        if jump_ns > LEAST_JUMP_NS and steps[at] > LEAST_STEP_SHARE * jump_ns:
            t_ns[at:] -= jump_ns
            self._set_ns, self.jumped_ns = self._set_ns + jump_ns, self.jumped_ns + jump_ns
        else:
            self._most_ns = max(self._most_ns, ahead_ns)
        self._last_ns = int(t_ns[-1])
        return t_ns
