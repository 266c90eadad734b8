"""A byte stream: a serial port, a pty, TCP, or any other pyserial URL. Block reads; an unplugged port is noticed."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
import warnings
from typing import Any
from urllib.parse import urlsplit

from drivers.contract.errors import LinkOpenError, LinkUnavailable
from drivers.contract.link import Event, LinkLost

READ_BYTES = 65_536
GATHER_S = 0.004  # for more bytes after the first: a frame at a time costs twice the processor time at 60 kS/s
CONNECT_S = 2.0


class PortSource:
    """Bytes of one port. hello, goodbye : sent after opening and before closing (slcan's commands)."""

    def __init__(self, target: str, port: str, baud: int, hello: bytes = b"", *, goodbye: bytes = b"") -> None:
        self.exhausted = False
        self._target = target
        self._name = port
        self._baud = baud
        self._hello = hello
        self._goodbye = goodbye
        self._port: Any = None
        self._fd: int | None = None
        self._poll: select.poll | None = None

    def open(self) -> None:
        self._port = _connect(self._target, self._name, self._baud)
        try:
            self._fd = self._port.fileno()
        except (AttributeError, OSError, ValueError, NotImplementedError):
            self._fd = None  # rfc2217 and the like: no descriptor to wait on
        if self._fd is not None and hasattr(select, "poll"):
            os.set_blocking(self._fd, False)
            self._poll = select.poll()
            self._poll.register(self._fd, select.POLLIN | select.POLLHUP | select.POLLERR)
        else:
            self._poll = None
        try:
            self._write(self._hello)
        except LinkLost as lost:
            self.close()
            raise LinkOpenError(f"{self._target}: {lost}: check that the adapter is connected") from lost

    def close(self) -> None:
        port, self._port, self._poll, self._fd = self._port, None, None, None
        if port is None:
            return
        # The port may be gone already, and pyserial raises several unrelated types then.
        with contextlib.suppress(Exception):
            if self._goodbye:
                _send(port, self._goodbye)
        with contextlib.suppress(Exception):
            port.close()

    def events(self) -> list[Event]:
        return []

    def receive(self, timeout_s: float) -> bytes | None:
        try:
            data = self._read_fd(timeout_s) if self._poll is not None else self._read_port(timeout_s)
        except LinkLost:
            raise
        except Exception as error:  # noqa: BLE001 - SerialException, OSError, termios.error, TypeError: by call and platform
            raise LinkLost(f"unplugged or closed ({_line(error)})") from error
        return data or None

    def _read_fd(self, timeout_s: float) -> bytes:
        """Everything that is there, in as few calls as the kernel allows."""
        if self._poll is None or self._fd is None:
            raise LinkLost("the port is closed")
        if not self._poll.poll(timeout_s * 1000):
            return b""
        time.sleep(GATHER_S)
        parts: list[bytes] = []
        size = 0
        while size < READ_BYTES:
            try:
                part = os.read(self._fd, READ_BYTES)
            except BlockingIOError:
                break
            except OSError:
                if parts:
                    break  # deliver what came before the hang-up; the next read will say so again
                raise
            if not part:
                if parts:
                    break
                raise LinkLost("the other end hung up")
            parts.append(part)
            size += len(part)
        return b"".join(parts)

    def _read_port(self, timeout_s: float) -> bytes:
        self._port.timeout = timeout_s
        first: bytes = self._port.read(1)
        if not first:
            return b""
        return first + bytes(self._port.read(min(self._port.in_waiting, READ_BYTES)))

    def _write(self, data: bytes) -> None:
        if not data:
            return
        try:
            _send(self._port, data)
        except Exception as error:  # noqa: BLE001 - as in receive
            raise LinkLost(f"cannot write ({_line(error)})") from error


def _send(port: Any, data: bytes) -> None:
    if isinstance(port, socket.socket):
        port.sendall(data)
    else:
        port.write(data)


def _line(error: Exception) -> str:
    if isinstance(error, OSError) and (error.errno or 0) > 0:  # pyserial says it twice
        return os.strerror(error.errno or 0)
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split()) or type(error).__name__


def _connect(target: str, name: str, baud: int) -> Any:
    """An open port. Raises LinkUnavailable | LinkOpenError."""
    if name.startswith("socket://"):
        return _connect_socket(target, name)
    try:
        import serial
    except ImportError as error:
        raise LinkUnavailable(f"{target}: pyserial is missing ({error}): install pyserial") from error
    try:
        if "://" in name:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # pyserial 3.5 calls Thread.setDaemon
                return serial.serial_for_url(name, baudrate=baud, timeout=0)
        return serial.Serial(name, baudrate=baud, timeout=0, write_timeout=1.0, exclusive=True)
    except Exception as error:
        text = _line(error)
        if isinstance(error, PermissionError) or "Permission denied" in text:
            text = f"{target}: no permission: add yourself to the group that owns the port (often dialout)"
            raise LinkUnavailable(text) from error
        if "exclusively lock" in str(error) or "busy" in text:
            raise LinkOpenError(f"{target}: another program holds the port: close it") from error
        if "Could not configure port" in text:  # a file, a disk, /dev/null
            raise LinkOpenError(f"{target}: is no serial port: look for it with `rotorscope ports`") from error
        if name.startswith("rfc2217:"):
            raise LinkOpenError(f"{target}: {text}: check that a server listens there") from error
        raise LinkOpenError(f"{target}: {text}: check the name with `rotorscope ports`") from error


def _connect_socket(target: str, name: str) -> socket.socket:
    """TCP without pyserial: its open() first discards what has arrived, without end if the sender is fast enough."""
    try:
        parts = urlsplit(name)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise LinkOpenError(f"{target}: {_line(error)}: write socket://HOST:PORT") from error
    if not host or not port:
        raise LinkOpenError(f"{target}: a host and a port are needed: write socket://HOST:PORT")
    try:
        connection = socket.create_connection((host, port), timeout=CONNECT_S)
    except OSError as error:
        raise LinkOpenError(f"{target}: {_line(error)}: check that the device listens there") from error
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    connection.settimeout(1.0)
    return connection
