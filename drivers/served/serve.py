"""A simulated device served on a separate link, for `rotorscope simulate --serve LINK`."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol
from urllib.parse import urlsplit

import numpy as np

from drivers.can.slcan_codec import encode_line
from drivers.contract.errors import LinkError, LinkOpenError
from drivers.contract.link_config import CanConfig, SerialConfig, SlcanConfig
from drivers.links.links import parse_link
from drivers.serial import cobs
from drivers.simulated.pacing import pump
from drivers.simulated.simulated import SimulatedDevice, WireFrame

BACKLOG_BYTES = 1 << 16  # what a device can hold while the link is busy; beyond it frames are lost, and counted
MOST_READERS = 32  # of a socket at a time
SETTLE_S = 0.1  # a reader that opens a port first throws away what it finds there


def serve(
    link: str, device: SimulatedDevice, speed: float | None, stop: threading.Event,
    ready: Callable[[str], None] = lambda url: None,
) -> None:  # fmt: skip
    """Run the device on this link until it is finished or `stop` is set. Blocks.

    link : `serial:pty`, `slcan:pty` (a new pseudo-terminal), `serial:PORT`, `slcan:PORT`, `serial:socket://HOST:PORT`
    (listens there; port 0 takes a free one; every reader gets the frames from when it comes on), or
    `can:INTERFACE:CHANNEL`. ready(url) receives the name for `run --link`. speed : None for as fast as the readers
    take it; the device then waits for one. Raises LinkError.
    """
    config = parse_link(link)
    serial = isinstance(config, SerialConfig)
    if isinstance(config, SerialConfig | SlcanConfig):
        if device.config.serial != serial:
            layout = "serial16 or serial24" if serial else "fd16, fd24 or classic"
            raise LinkError(f"{link}: a device of layout {device.config.layout} cannot use it: it needs {layout}")
        end = _open_end(config)
        ready(f"{'serial' if serial else 'slcan'}:{end.address}")
        try:
            send = ToEach(end, serial, stop) if isinstance(end, TcpEnd) else ByteSender(end, serial, stop)
            pump(device, send, speed, stop)
            end.drain(stop)
        finally:
            end.close()
    elif isinstance(config, CanConfig):
        from drivers.can.can_bus import open_bus
        from drivers.links.virtual import CanSender

        if device.config.serial:
            layout = "fd16, fd24 or classic"
            raise LinkError(f"{link}: a device of layout {device.config.layout} cannot use it: it needs {layout}")
        bus = open_bus(config)
        try:
            ready(link)
            pump(device, CanSender(bus, stop), speed, stop)
        finally:
            bus.shutdown()
    else:
        raise LinkError(f"{link}: cannot be served: use serial:pty, slcan:pty, serial:socket://127.0.0.1:0 or can:")


class End(Protocol):
    """The device's end of a byte stream. `fd` : None while no reader is connected; `gone` : no reader can connect."""

    address: str
    gone: bool

    def fd(self) -> int | None: ...
    def drain(self, stop: threading.Event) -> None: ...
    def close(self) -> None: ...


def _open_end(config: SerialConfig | SlcanConfig) -> End:
    if config.port == "pty":
        return PtyEnd()
    if config.port.startswith("socket://"):
        return TcpEnd(config.target, config.port)
    return PortEnd(config.target, config.port, config.baud)


class PtyEnd:
    """A new pseudo-terminal; its path is in `address`."""

    gone = False

    def __init__(self) -> None:
        import pty
        import tty

        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self.address = os.ttyname(slave)
        os.close(slave)  # so that the master can see whether somebody has it open
        os.set_blocking(self._master, False)
        self._poll = select.poll()
        self._poll.register(self._master, select.POLLOUT)
        self._opened_s: float | None = None

    def fd(self) -> int | None:
        if any(event & select.POLLHUP for _, event in self._poll.poll(0)):
            self._opened_s = None
            return None
        if self._opened_s is None:
            self._opened_s = time.monotonic()
        return self._master if time.monotonic() - self._opened_s > SETTLE_S else None

    def drain(self, stop: threading.Event) -> None:
        """Wait until the reader has taken everything or gone."""
        import fcntl
        import termios

        while not stop.wait(0.01) and self.fd() is not None:
            waiting = fcntl.ioctl(self._master, termios.TIOCOUTQ, b"\0\0\0\0")
            if int.from_bytes(waiting, "little") == 0:
                break
        stop.wait(0.2)

    def close(self) -> None:
        os.close(self._master)


class TcpReader:
    """The end of one reader's connection."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._connection.setblocking(False)
        self.address = ""
        self.gone = False

    def fd(self) -> int | None:
        if self.gone:
            return None
        try:
            self.gone = self._connection.recv(1, socket.MSG_PEEK) == b""
        except BlockingIOError:
            pass
        except OSError:
            self.gone = True
        return None if self.gone else self._connection.fileno()

    def drain(self, stop: threading.Event) -> None:
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        self._connection.close()


class TcpEnd:
    """Listens; `readers` are those that are connected."""

    gone = False

    def __init__(self, target: str, url: str) -> None:
        parts = urlsplit(url)
        host = parts.hostname or "127.0.0.1"
        try:
            self._listener = socket.create_server((host, parts.port or 0))
        except (OSError, ValueError) as error:
            reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else error
            raise LinkOpenError(f"{target}: cannot listen there: {reason}: choose another port, or 0") from error
        self._listener.setblocking(False)
        self.address = f"socket://{host}:{self._listener.getsockname()[1]}"
        self.readers: list[TcpReader] = []

    def fd(self) -> int | None:
        return next((fd for reader in self.readers if (fd := reader.fd()) is not None), None)

    def accept(self) -> list[TcpReader]:
        """Readers that connected since the last call; readers that left are removed."""
        for reader in [r for r in self.readers if r.gone]:
            reader.close()
            self.readers.remove(reader)
        new: list[TcpReader] = []
        with contextlib.suppress(OSError):  # nobody waits, or no more files are to be had
            while len(self.readers) + len(new) < MOST_READERS:
                new.append(TcpReader(self._listener.accept()[0]))
        self.readers += new
        return new

    def drain(self, stop: threading.Event) -> None:
        for reader in self.readers:
            reader.drain(stop)

    def close(self) -> None:
        for reader in self.readers:
            reader.close()
        self._listener.close()


class ToEach:
    """Sends frames to every reader of a socket. In real time a slow reader loses frames, and delays no other."""

    def __init__(self, end: TcpEnd, serial: bool, stop: threading.Event) -> None:
        self._end, self._serial, self._stop = end, serial, stop
        self._senders: list[tuple[TcpReader, ByteSender]] = []

    def __call__(self, frames: Sequence[WireFrame], patient: bool) -> int:
        while True:
            self._senders = [(reader, sender) for reader, sender in self._senders if not reader.gone]
            self._senders += [(r, ByteSender(r, self._serial, self._stop)) for r in self._end.accept()]
            lost = [sender(frames, patient) for _, sender in self._senders]
            there = [n for n, (reader, _) in zip(lost, self._senders, strict=True) if not reader.gone]
            if there or not patient:
                return min(there, default=0)  # a frame that one reader took is not lost
            if self._stop.wait(0.01):
                return 0


class PortEnd:
    """A serial port that exists, for example one end of a cable or of socat's pair."""

    gone = False

    def __init__(self, target: str, name: str, baud: int) -> None:
        from drivers.serial.byte_port import _connect

        self._port: Any = _connect(target, name, baud)
        self.address = name
        os.set_blocking(self._port.fileno(), False)

    def fd(self) -> int | None:
        return int(self._port.fileno())

    def drain(self, stop: threading.Event) -> None:
        stop.wait(0.2)

    def close(self) -> None:
        self._port.close()


class ByteSender:
    """Sends frames as bytes to the device's end. An slcan reader must first send O."""

    def __init__(self, end: End, serial: bool, stop: threading.Event) -> None:
        self._end = end
        self._serial = serial
        self._stop = stop
        self._backlog = bytearray()
        self._running = serial
        self._rng = np.random.default_rng(1)

    def __call__(self, frames: Sequence[WireFrame], patient: bool) -> int:
        lost = 0
        self._attend()
        for frame in frames:
            if len(self._backlog) > BACKLOG_BYTES:
                self._flush(patient)
            if len(self._backlog) > BACKLOG_BYTES or not (patient or self._running):
                lost += 1
                continue
            self._backlog += self._encode(frame)
        self._flush(patient)
        return lost

    def _encode(self, frame: WireFrame) -> bytes:
        if self._serial:
            wire = cobs.encode(frame.data)
        else:
            wire = encode_line(frame.identifier, frame.data, fd=len(frame.data) > 8)
        if frame.damaged:
            at = int(self._rng.integers(len(wire) - 1))
            damaged = bytearray(wire)
            if frame.damaged == "short":
                del damaged[at]
            else:
                damaged[at] ^= 1 << int(self._rng.integers(8))
            return bytes(damaged)
        return wire

    def _attend(self) -> int | None:
        """The descriptor to write to, or None without a reader."""
        fd = self._end.fd()
        if fd is None:
            self._running = self._serial
        elif not self._serial:
            self._commands(fd)
        return fd

    def _flush(self, patient: bool) -> None:
        """Write as much as the link takes; if patient, wait until all is written."""
        while self._backlog and not self._stop.is_set():
            fd = self._attend()
            if fd is None and (not patient or self._end.gone):
                self._backlog.clear()  # no reader: the bytes are lost, as on a cable
                return
            done = 0
            if fd is not None and self._running:
                # BlockingIOError: the link is full. Other errors: the reader left, and fd() will see it.
                with contextlib.suppress(OSError):
                    done = os.write(fd, self._backlog[:BACKLOG_BYTES])
                del self._backlog[:done]
            if done:
                continue
            if not patient:
                return
            if fd is not None and self._running:
                select.select([], [fd], [], 0.02)
            else:
                self._stop.wait(0.01)

    def _commands(self, fd: int) -> None:
        """Answer the commands of an slcan host."""
        with contextlib.suppress(OSError):
            for command in os.read(fd, 4096).split(b"\r")[:-1]:
                if command[:1] == b"C":
                    self._running = False
                elif command[:1] in (b"O", b"L"):
                    self._running = True
                os.write(fd, b"\r" if command else b"")


__all__ = ["ByteSender", "End", "PortEnd", "PtyEnd", "TcpEnd", "TcpReader", "serve"]
