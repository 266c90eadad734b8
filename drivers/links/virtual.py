"""virtual: a simulated device and the real CAN driver on one in-process python-can bus."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Sequence
from typing import Any

from drivers.can.can_bus import BusSource, open_bus
from drivers.can.can_frames import CanFrames
from drivers.contract.link import Event
from drivers.contract.link_config import CanConfig
from drivers.simulated.pacing import pump
from drivers.simulated.simulated import SimulatedDevice, WireFrame

QUEUE_FRAMES = 4096  # of the receiver; python-can's virtual bus blocks or refuses the sender when it is full
_numbers = itertools.count()


class VirtualSource:
    """Starts the device when opened. The device pauses while the link is closed; it does not start again."""

    def __init__(self, device: SimulatedDevice, speed: float | None = 1.0) -> None:
        self.exhausted = False
        self._device = device
        self._speed = speed
        channel = f"rotorscope-{next(_numbers)}"
        config = CanConfig("virtual", channel, options={"rx_queue_size": QUEUE_FRAMES})
        self._sender = CanConfig("virtual", channel, options={"rx_queue_size": 1})
        self._bus = BusSource(config)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._failure: Exception | None = None

    def open(self) -> None:
        self._bus.open()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(self._stop,), name="simulated-device", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._bus.close()

    def events(self) -> list[Event]:
        events = self._bus.events()
        if self._failure is not None:
            text = f"the simulated device failed: {type(self._failure).__name__}: {self._failure}"
            events.append(Event("error", "simulation_failed", text))
            self._failure = None
        return events

    def receive(self, timeout_s: float) -> CanFrames | None:
        ended = self._thread is None or not self._thread.is_alive()
        frames = self._bus.receive(0.0 if ended else timeout_s)
        self.exhausted = ended and frames is None
        return frames

    def _run(self, stop: threading.Event) -> None:
        bus = open_bus(self._sender)
        try:
            pump(self._device, CanSender(bus, stop), self._speed, stop)
        except Exception as error:  # noqa: BLE001 - reported by events() in the reading thread
            self._failure = error
        finally:
            bus.shutdown()


class CanSender:
    """Sends a device's frames on a python-can bus; damaged frames never arrive, as with a real controller."""

    def __init__(self, bus: Any, stop: threading.Event) -> None:
        import can

        self._message, self._refused = can.Message, can.CanOperationError
        self._bus = bus
        self._stop = stop

    def __call__(self, frames: Sequence[WireFrame], patient: bool) -> int:
        lost = 0
        for frame in frames:
            if frame.damaged == "flip":
                continue
            data = frame.data[:-1] if frame.damaged == "short" else frame.data
            fd = len(data) > 8
            message = self._message(
                arbitration_id=frame.identifier, data=data, is_extended_id=False, is_fd=fd, bitrate_switch=fd
            )
            while not self._stop.is_set():
                try:
                    self._bus.send(message, timeout=0.05 if patient else 0.0)
                    break
                except self._refused:
                    if not patient:
                        lost += 1
                        break
        return lost
