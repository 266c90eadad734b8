"""A serial device whose cable can be pulled and plugged in again."""

from __future__ import annotations

import contextlib
import os
import pty
import threading
import time
import tty
from pathlib import Path

from ramp_device import ramp_device

from drivers.serial import cobs

DEVICE_BYTES = 1 << 16  # what a device holds while nobody reads: 0.3 s


class Cable:
    """A pty behind a name that stays; a thread sends the device's frames at their pace while it is plugged in.

    holds_bytes : what the device holds while nobody reads; more where a busy host must not cost samples.
    """

    def __init__(self, name: Path) -> None:
        self.name = name
        self.holds_bytes = DEVICE_BYTES
        self._device = ramp_device("serial16", seconds=None)
        self._lock = threading.Lock()
        self._ends: tuple[int, int] | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._send)
        self.plug()
        self._thread.start()

    def plug(self) -> None:
        master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        with self._lock:
            self._ends = master, slave
        self.name.symlink_to(os.ttyname(slave))

    def pull(self) -> None:
        self.name.unlink()
        with self._lock:
            assert self._ends is not None
            for fd in self._ends:
                os.close(fd)
            self._ends = None

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        if self._ends is not None:
            self.pull()

    def _send(self) -> None:
        begin, held = time.monotonic(), b""
        while not self._stop.wait(0.02):
            n = (round((time.monotonic() - begin) * 25_600) - self._device.samples_made) // 64
            frames = self._device.next(n) if n > 0 else []
            with self._lock:
                if self._ends is None:
                    held = b""  # nothing there to send it to
                    continue
                held += b"".join(cobs.encode(frame.data) for frame in frames)
                if len(held) > self.holds_bytes:  # a busy host, and a device that holds no more
                    held = held[held.index(0, len(held) - self.holds_bytes) + 1 :]
                with contextlib.suppress(BlockingIOError):
                    held = held[os.write(self._ends[0], held) :]
