"""Linux's SocketCAN: state of the interface, frames lost in its queue, and many frames a system call."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import select
import socket
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.contract.errors import LinkOpenError
from drivers.contract.link import LinkLost

from .can_frames import CanFrames

QUEUE_BYTES = 4 << 20  # asked for; the kernel charges near 800 bytes a frame, so its default holds about 270 frames
BATCH_FRAMES = 256  # frames a system call
_FRAME_BYTES, _SO_TIMESTAMPNS = 72, 35  # struct canfd_frame; asm-generic/socket.h
_CONTROL_DTYPE = np.dtype(
    [("length", "=u8"), ("level", "=i4"), ("type", "=i4"), ("s", "=i8"), ("ns", "=i8"), ("more", "V64")]
)
_CONTROL_BYTES = _CONTROL_DTYPE.itemsize
_IFF_UP = 1  # linux/if.h
_SO_RCVBUFFORCE, _SO_MEMINFO, _SK_MEMINFO_DROPS = 33, 55, 8  # asm-generic/socket.h, linux/sock_diag.h


def check_up(target: str, name: str) -> None:
    """Raise LinkOpenError if the interface is missing or down: binding to one that is down succeeds."""
    try:
        flags = int(Path("/sys/class/net", name, "flags").read_text(), 16)
    except (OSError, ValueError) as error:
        text = f"{target}: there is no interface {name}: plug it in, or look for it with `rotorscope ports`"
        raise LinkOpenError(text) from error
    if not flags & _IFF_UP:
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
        self.empty = True  # when it was last looked at
        self._seen = self._drops()

    def lost(self) -> int:
        """Frames thrown away since the last call."""
        before, self._seen = self._seen, self._drops()
        return (self._seen - before) % 2**32

    def _drops(self) -> int:
        try:
            info = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 64)
        except OSError:
            return 0
        values = struct.unpack(f"{len(info) // 4}I", info)
        self.empty = values[0] == 0
        return int(values[_SK_MEMINFO_DROPS]) if len(values) > _SK_MEMINFO_DROPS else 0


class _IoVec(ctypes.Structure):
    _fields_ = [("base", ctypes.c_void_p), ("length", ctypes.c_size_t)]


class _MsgHdr(ctypes.Structure):
    _fields_ = [
        ("name", ctypes.c_void_p), ("name_length", ctypes.c_uint32), ("iov", ctypes.c_void_p),
        ("iov_length", ctypes.c_size_t), ("control", ctypes.c_void_p), ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    ]  # fmt: skip


class _MMsgHdr(ctypes.Structure):
    _fields_ = [("header", _MsgHdr), ("length", ctypes.c_uint32)]


class BulkReceiver:
    """Reads a CAN_RAW socket (or any datagram socket with the same frames)."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._data = np.zeros((BATCH_FRAMES, _FRAME_BYTES), np.uint8)
        self._control = np.zeros(BATCH_FRAMES, _CONTROL_DTYPE)
        self._iov = (_IoVec * BATCH_FRAMES)()
        self._messages = (_MMsgHdr * BATCH_FRAMES)()
        for k in range(BATCH_FRAMES):
            self._iov[k].base, self._iov[k].length = self._data.ctypes.data + k * _FRAME_BYTES, _FRAME_BYTES
            header = self._messages[k].header
            header.iov, header.iov_length = ctypes.addressof(self._iov[k]), 1
            header.control = self._control.ctypes.data + k * _CONTROL_BYTES
        memory = np.frombuffer(memoryview(self._messages).cast("B"), np.uint8).reshape(
            BATCH_FRAMES, ctypes.sizeof(_MMsgHdr)
        )
        at, size = _MsgHdr.control_length.offset, ctypes.sizeof(ctypes.c_size_t)
        self._control_lengths = memory[:, at : at + size]
        self._control_room = np.frombuffer(bytes(ctypes.c_size_t(_CONTROL_BYTES)), np.uint8)
        at = _MMsgHdr.length.offset
        self._lengths = memory[:, at : at + 4].view(np.uint32)[:, 0]
        self._recvmmsg = ctypes.CDLL(None, use_errno=True).recvmmsg
        self._poll = select.poll()
        self._poll.register(sock, select.POLLIN | select.POLLERR | select.POLLHUP)

    def receive(self, timeout_s: float) -> CanFrames | None:
        """Up to BATCH frames; None after the timeout. Raises LinkLost when the interface is down or gone."""
        if not self._poll.poll(timeout_s * 1000):
            return None
        self._control_lengths[:] = self._control_room
        n = self._recvmmsg(self._sock.fileno(), self._messages, BATCH_FRAMES, socket.MSG_DONTWAIT, None)
        if n < 0:
            error = ctypes.get_errno()
            if error in (errno.EAGAIN, errno.EINTR):
                return None
            raise LinkLost(f"the interface is down or gone ({os.strerror(error)})")
        return self._frames(n)

    def _frames(self, n: int) -> CanFrames | None:
        lengths = self._lengths[:n].copy()
        if n == 0 or not lengths.all():
            raise LinkLost("the socket was closed")
        data = self._data[:n].copy()
        for k in np.flatnonzero(lengths < _FRAME_BYTES):
            data[k, lengths[k] :] = 0  # left over from a longer frame in this slot
        ids = np.ascontiguousarray(data[:, :4]).view(np.uint32)[:, 0]
        # byte 4 is the length; byte 5 has the FD flags, which the kernel may decorate (CANFD_FDF): not needed
        size = np.minimum(data[:, 4], 64).astype(np.uint8)
        whole = lengths >= 16
        return CanFrames(ids[whole], size[whole], data[whole, 8:], self._stamps(n)[whole])

    def _stamps(self, n: int) -> NDArray[np.int64]:
        """Kernel receive times (host's real-time clock), 0 where there is none."""
        control = self._control[:n]
        known = (control["level"] == socket.SOL_SOCKET) & (control["type"] == _SO_TIMESTAMPNS)
        stamps = np.where(known, control["s"] * 1_000_000_000 + control["ns"], 0)
        control["type"] = 0
        return stamps
