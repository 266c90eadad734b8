"""A CAN bus through python-can: many frames a wake-up, error frames and a dead interface noticed."""

from __future__ import annotations

import logging
import socket
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from drivers.contract.errors import LinkOpenError, LinkUnavailable
from drivers.contract.link import Event, LinkLost
from drivers.contract.link_config import CanConfig

from .can_errors import describe_error
from .can_frames import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, CanFrames
from .socketcan import BulkReceiver, KernelQueue, check_up

MAX_BATCH = 1024
BLAME_S = 1.0  # losses of a slow host come several times in a row
SPIN_SHARE = 0.15  # of a wait for nothing spent computing: the interface spins on a dead connection


def open_bus(config: CanConfig) -> Any:
    """A python-can bus. Raises LinkUnavailable | LinkOpenError."""
    try:
        import can
    except ImportError as error:
        raise LinkUnavailable(f"{config.target}: python-can is missing ({error}): install python-can") from error
    if config.interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise LinkOpenError(f"{config.target}: python-can has no interface {config.interface!r}; it has {known}")
    if config.interface == "serial":
        text = "python-can's serial interface has no check sum, and reads wrong frames after one lost byte"
        raise LinkOpenError(f"{config.target}: {text}: use serial: with protocol v1, or slcan:")
    if config.interface == "socketcand":
        _probe(config)  # python-can tries for 10 s at full load when nobody listens
    if config.interface == "socketcan":
        check_up(config.target, config.channel)
    logging.getLogger("can").addHandler(logging.NullHandler())  # what matters of it is in the error
    arguments: dict[str, Any] = {"fd": config.fd, **config.options}
    if config.bitrate is not None:
        arguments["bitrate"] = config.bitrate
    if config.data_bitrate is not None:
        arguments["data_bitrate"] = config.data_bitrate
    try:
        return can.Bus(interface=config.interface, channel=config.channel, ignore_config=True, **arguments)
    except can.CanInterfaceNotImplementedError as error:
        raise LinkUnavailable(f"{config.target}: {_line(error)}: install what this interface needs") from error
    except NameError as error:  # python-can goes on without a library that it does not find
        text = f"the library of the manufacturer is not installed ({_line(error)})"
        raise LinkUnavailable(f"{config.target}: {text}: install what this interface needs") from error
    except Exception as error:  # interfaces raise their vendors' own errors
        raise LinkOpenError(f"{config.target}: {_line(error)}: {_advice(config)}") from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__


def _advice(config: CanConfig) -> str:
    if config.interface == "socketcan":
        name = config.channel
        return f"check `ip link show {name}` and bring it up with `ip link set {name} up type can ...`"
    return "check the channel's name, the adapter's plug and driver, and that no other program holds it"


def _probe(config: CanConfig) -> None:
    host, port = config.options.get("host"), config.options.get("port")
    if host is None or port is None:
        raise LinkOpenError(f"{config.target}: socketcand needs a server: add ?host=..&port=..")
    try:
        socket.create_connection((str(host), int(port)), timeout=2.0).close()
    except OSError as error:
        text = f"{config.target}: no server at {host}:{port} ({_line(error)}): start socketcand"
        raise LinkOpenError(text) from error


class BusSource:
    """Any python-can interface. `connect` opens the bus; a test or the virtual link may give its own."""

    def __init__(self, config: CanConfig, connect: Callable[[CanConfig], Any] = open_bus) -> None:
        self.exhausted = False
        self._config = config
        self._connect = connect
        self._bus: Any = None
        self._queue: KernelQueue | None = None
        self._bulk: BulkReceiver | None = None
        self._events: list[Event] = []
        self._spins = 0
        self._lost = 0  # frames that the kernel dropped, until the reader has passed their place
        self._blamed_until_s = 0.0

    def open(self) -> None:
        self._bus = self._connect(self._config)
        native = self._config.interface == "socketcan"
        self._queue = KernelQueue(self._bus) if native else None
        self._bulk = BulkReceiver(self._bus.socket) if native else None
        self._spins = 0

    def close(self) -> None:
        bus, self._bus, self._bulk = self._bus, None, None
        if bus is not None:
            try:
                bus.shutdown()
            except Exception as error:  # noqa: BLE001 - a vendor's library may raise anything on a dead adapter
                self._events.append(Event("info", "shutdown_failed", _line(error)))

    def events(self) -> list[Event]:
        events, self._events = self._events, []
        return events

    def receive(self, timeout_s: float) -> CanFrames | None:
        started_s, cpu_s = time.monotonic(), time.thread_time()
        frames = self._receive_all(timeout_s) if self._bulk is None else self._receive_bulk(self._bulk, timeout_s)
        if self._queue is not None:
            self._look_for_losses(self._queue, 0 if frames is None else len(frames))
        if frames is not None:
            self._spins = 0
            return frames
        self._check_spin(time.monotonic() - started_s, time.thread_time() - cpu_s)
        return None

    def _look_for_losses(self, queue: KernelQueue, received: int) -> None:
        """Count kernel losses. They lie behind the queued frames and explain gaps until a second after these."""
        now_s = time.monotonic()
        lost = queue.lost()
        self._lost += lost
        if lost or (self._lost and not queue.empty):
            self._blamed_until_s = now_s + BLAME_S
        elif now_s > self._blamed_until_s:
            self._lost = 0
        if self._lost and received:
            text = f"the kernel's queue was full: {self._lost} frames of the bus lost because this host was too slow"
            self._events.append(Event("error", "kernel_overflow", text, "overflow"))

    def _receive_all(self, timeout_s: float) -> CanFrames | None:
        """Frames of python-can's interface, one message at a time."""
        frames: list[tuple[int, bytes, int]] = []
        wait_s = timeout_s
        try:
            while len(frames) < MAX_BATCH:
                message = self._bus.recv(wait_s)
                if message is None:
                    break
                wait_s = 0
                if message.is_error_frame:
                    self._events.extend(describe_error(message.arbitration_id, bytes(message.data)))
                    continue
                # is_fd and dlc are not to be believed (socketcand): the data says how long it is
                flags = (EXTENDED_FLAG if message.is_extended_id else 0) | (
                    REMOTE_FLAG if message.is_remote_frame else 0
                )
                frames.append((message.arbitration_id | flags, bytes(message.data), int(message.timestamp * 1e9)))
        except Exception as error:  # noqa: BLE001 - python-can's interfaces raise their vendors' own errors
            raise LinkLost(_line(error)) from error
        return CanFrames.build(frames) if frames else None

    def _receive_bulk(self, bulk: BulkReceiver, timeout_s: float) -> CanFrames | None:
        """Linux: a whole batch a system call."""
        frames = bulk.receive(timeout_s)
        if frames is None:
            return None
        wrong = (frames.ids & np.uint32(ERROR_FLAG)) != 0
        for identifier, payload in zip(frames.ids[wrong].tolist(), frames.payload[wrong], strict=True):
            self._events.extend(describe_error(identifier, payload[:8].tobytes()))
        good = frames.pick(~wrong)
        return good if len(good) else None

    def _check_spin(self, waited_s: float, cpu_s: float) -> None:
        if waited_s < 0.02:
            return
        self._spins = self._spins + 1 if cpu_s > SPIN_SHARE * waited_s else 0
        if self._spins >= 3:
            raise LinkLost("the interface returns at once with nothing: its server has closed the connection")
