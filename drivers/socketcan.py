"""What Linux's SocketCAN tells only those who ask: is the interface up, and how many frames its queue threw away."""

from __future__ import annotations

import contextlib
import socket
import struct
from pathlib import Path
from typing import Any

from drivers.errors import LinkOpenError

QUEUE_BYTES = 4 << 20  # asked for; the kernel charges near 800 bytes a frame, so its default holds about 270 frames
_UP = 1
_SO_RCVBUFFORCE, _SO_MEMINFO, _DROPS = 33, 55, 8  # asm-generic/socket.h, linux/sock_diag.h


def check_up(target: str, name: str) -> None:
    """Raise LinkOpenError if the interface is missing or down: binding to one that is down succeeds."""
    try:
        flags = int(Path("/sys/class/net", name, "flags").read_text(), 16)
    except (OSError, ValueError) as error:
        text = f"{target}: there is no interface {name}: plug it in, or look for it with `rotorscope ports`"
        raise LinkOpenError(text) from error
    if not flags & _UP:
        text = f"the interface {name} is down: bring it up with `ip link set {name} up type can bitrate 1000000`"
        raise LinkOpenError(f"{target}: {text}")


class KernelQueue:
    """The receive queue of an open python-can socketcan bus: made longer, and its losses counted."""

    def __init__(self, bus: Any) -> None:
        self._socket: socket.socket = bus.socket
        for option in (_SO_RCVBUFFORCE, socket.SO_RCVBUF):  # the first needs CAP_NET_ADMIN, the second has a ceiling
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, option, QUEUE_BYTES)
                break
        self._seen = self._drops()

    def lost(self) -> int:
        """Frames thrown away since the last call."""
        before, self._seen = self._seen, self._drops()
        return (self._seen - before) % 2**32

    def _drops(self) -> int:
        try:
            told = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 64)
        except OSError:
            return 0
        values = struct.unpack(f"{len(told) // 4}I", told)
        return int(values[_DROPS]) if len(values) > _DROPS else 0
