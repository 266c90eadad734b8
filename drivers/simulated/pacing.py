"""Runs a simulated device in time: absolute deadlines, or as fast as the link takes it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

from .simulated import SimulatedDevice, WireFrame

CHUNK_S = 0.05  # made at a time
TICK_S = 0.002  # frames due within it leave together

Send = Callable[[Sequence[WireFrame], bool], int]


def pump(device: SimulatedDevice, send: Send, speed: float | None, stop: threading.Event) -> None:
    """Send a device's frames until it is finished or `stop` is set.

    speed : device seconds per second; None for as fast as possible. send(frames, patient) returns how many frames of
    samples it had no room for; patient means to wait for room instead (and to look at `stop`).
    """
    rate = device.config.rate_hz / device.config.frame_rows
    chunk = max(1, round(rate * CHUNK_S * min(1.0, speed or 1.0)))
    started_s = time.monotonic()
    waiting: list[WireFrame] = []
    while not stop.is_set():
        if not waiting:
            if device.finished:
                return
            waiting = device.next(chunk)
        if speed is None:
            send(waiting, True)
            waiting = []
            continue
        now_s = (time.monotonic() - started_s) * speed
        due = next((k for k, frame in enumerate(waiting) if frame.due_s > now_s), len(waiting))
        if due:
            device.overrun(send(waiting[:due], False))
            waiting = waiting[due:]
        if waiting:
            stop.wait(max(TICK_S, min(CHUNK_S, (waiting[0].due_s - now_s) / speed)))
