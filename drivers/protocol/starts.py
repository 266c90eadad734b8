"""Which starts of a device its records describe: frames of another start are not read by the old description.

The records of a device, once a second, show that it was replaced or came back with another range. The records at its
start may be lost, because the link was away.
"""

from __future__ import annotations

PATIENCE_NS = 3_000_000_000  # for the records, which come once a second


class Starts:
    """A start has a number (epoch), or 0 if the device keeps none. Times are when frames were read."""

    def __init__(self) -> None:
        self._epochs = (0, 0)  # of the description, and of the last records, which may be damaged
        self.identified = False  # the device has a serial number
        self._received = False  # a complete description has come since the last frame that was used
        self._since_ns: int | None = None  # when frames began to wait for one

    @property
    def recognised(self) -> bool:
        """Whether the device has identified itself completely since the last frame that was used."""
        return self._received and self.identified

    def described(self, epoch: int, settled: bool) -> None:
        """Records of every channel have come. settled : they are the description that is used."""
        self._epochs = (epoch if settled else self._epochs[0], epoch)
        self._received = True

    def readable(self, epoch: int, t_host_ns: int) -> bool:
        """Whether the description fits frames of this start, or no other description comes."""
        if not epoch or not all(self._epochs) or epoch in self._epochs:
            return True
        if self._waited(t_host_ns):
            self.described(epoch, True)
            return True
        return False

    def began(self, t_host_ns: int) -> bool:
        """Whether a start with the number of the last one, seen by its counters, is described."""
        return self._received or self._waited(t_host_ns)

    def taken(self) -> None:
        """Note that frames were used."""
        self._received, self._since_ns = False, None

    def _waited(self, t_host_ns: int) -> bool:
        if self._since_ns is None:
            self._since_ns = t_host_ns
        return t_host_ns - self._since_ns >= PATIENCE_NS
