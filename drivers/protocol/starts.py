"""Which starts of a device its records describe: frames of another start are not read by the old description.

A device that was replaced, or came back with another range, says so in its records, once a second. Those at its start
may go unheard: the link was away, or lost them.
"""

from __future__ import annotations

PATIENCE_NS = 3_000_000_000  # for the records, which come once a second


class Starts:
    """A start has a number (epoch), or 0 if the device keeps none. Times are when frames were read."""

    def __init__(self) -> None:
        self._epochs = (0, 0)  # of the description, and of the last records, which may be damaged
        self.identified = False  # the device has a serial number
        self._heard = False  # a whole description since the last frame that was taken
        self._since_ns: int | None = None  # when frames began to wait for one

    @property
    def recognised(self) -> bool:
        """The device has said which one it is, in whole, since the last frame that was taken."""
        return self._heard and self.identified

    def described(self, epoch: int, settled: bool) -> None:
        """Records of every channel have come. settled : they are the description that is used."""
        self._epochs = (epoch if settled else self._epochs[0], epoch)
        self._heard = True

    def readable(self, epoch: int, t_host_ns: int) -> bool:
        """Frames of this start can be read by the description; or no other comes."""
        if not epoch or not all(self._epochs) or epoch in self._epochs:
            return True
        if self._waited(t_host_ns):
            self.described(epoch, True)
            return True
        return False

    def began(self, t_host_ns: int) -> bool:
        """The counters say that a start was made which has the number of the last; is it described?"""
        return self._heard or self._waited(t_host_ns)

    def taken(self) -> None:
        """Frames were read."""
        self._heard, self._since_ns = False, None

    def _waited(self, t_host_ns: int) -> bool:
        if self._since_ns is None:
            self._since_ns = t_host_ns
        return t_host_ns - self._since_ns >= PATIENCE_NS
