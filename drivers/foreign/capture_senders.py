"""Selects the frames of one bus and one direction from a capture, so that each sample comes once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from drivers.can.can_frames import CanFrames
from drivers.contract.errors import BusError, LinkOpenError

from .capture_batches import Batch

ECHO_SHARE = 0.9  # of the sent frames that were received as well: the received frames are their echo


class Senders:
    """`survey` counts the first batches, `decide` chooses, `of_device` selects frames. bus : the requested bus."""

    def __init__(self, target: str, bus: str | None, wanted: Callable[[CanFrames], NDArray[np.bool_]]) -> None:
        self.seen = 0  # frames of the device
        self._target, self._bus, self._wanted = target, bus, wanted
        self._file = target.partition(":")[2]
        self._names: tuple[str, ...] = ()
        self._of_bus: dict[str, int] = {}  # frames of the device
        self._sent: list[NDArray[np.uint8]] = []
        self._received: list[NDArray[np.uint8]] = []
        self._drop_sent = False
        self._chosen = bus
        self._said: list[tuple[str, str, str]] = []
        self._reported_other = False

    def survey(self, batch: Batch) -> Batch:
        """Count the frames of one of the first batches; returns the frames of the requested bus."""
        self._names = batch.names
        if self._bus is not None:
            batch = batch.pick(self._on(batch, self._bus))
        mine = self._wanted(batch.frames)
        self.seen += int(mine.sum())
        for number, name in enumerate(batch.names):
            if n := int((mine & (batch.buses == number)).sum()):
                self._of_bus[name] = self._of_bus.get(name, 0) + n
        payload = batch.frames.payload
        self._sent.append(_whole(batch.frames, payload, mine & batch.sent))
        self._received.append(_whole(batch.frames, payload, mine & ~batch.sent))
        return batch

    def decide(self) -> None:
        """Choose bus and direction. Raises LinkOpenError where samples of two buses or senders would be mixed."""
        if self._bus is not None and self._bus not in self._names:
            has = ", ".join(self._names) or "no frames"
            what = f"{self._target}: there is no bus {self._bus} in it: it has {has}"
            raise BusError(what, self._file, tuple(self._of_bus) or self._names)
        if len(self._of_bus) > 1:
            counts = ", ".join(f"{n} on bus {name}" for name, n in self._of_bus.items())
            what = f"{self._target}: frames of the device are on several buses ({counts})"
            raise BusError(what, self._file, tuple(self._of_bus))
        self._chosen = self._bus or next(iter(self._of_bus), None)
        sent, received = np.concatenate(self._sent), np.concatenate(self._received)
        self._sent, self._received = [], []
        if not len(sent) or not len(received):
            return
        _, of = np.unique(np.concatenate([sent, received]), axis=0, return_inverse=True)
        of = of.ravel()
        echoes = np.isin(of[: len(sent)], of[len(sent) :]).mean()
        if echoes < ECHO_SHARE:
            text = (
                f"{len(sent)} frames of the device were sent by the recorder (T, Tx), {len(received)} received (R, Rx)"
            )
            raise LinkOpenError(f"{self._target}: {text}, and are not the same: two senders of one identifier")
        self._drop_sent = True
        text = "frames that the recorder sent itself (T, Tx) came twice, as their own echo: taken once"
        self._said.append(("warning", "own_echo", text))

    def of_device(self, batch: Batch) -> Batch:
        """The batch without frames of other buses, and without the echo."""
        if self._chosen is None or not len(batch.frames):
            return batch
        keep = self._on(batch, self._chosen)
        if not keep.all() and self._bus is None and not self._reported_other:
            mine = self._wanted(batch.frames) & ~keep
            if mine.any():
                self._reported_other = True
                other = batch.names[int(batch.buses[mine][0])]
                text = f"frames of the device come on bus {other} as well, from here on: left out, not {self._chosen}"
                self._said.append(("error", "second_bus", text))
        if self._drop_sent:
            keep &= ~(batch.sent & self._wanted(batch.frames))
        return batch if keep.all() else batch.pick(keep)

    def take_said(self) -> list[tuple[str, str, str]]:
        """Level, code and text of the notices since the last call."""
        said, self._said = self._said, []
        return said

    def _on(self, batch: Batch, bus: str) -> NDArray[np.bool_]:
        if bus not in batch.names:
            return np.zeros(len(batch.frames), np.bool_)
        return np.asarray(batch.buses == batch.names.index(bus))


def _whole(frames: CanFrames, payload: NDArray[np.uint8], which: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """(n, 68) identifier and payload of frames."""
    ids = np.ascontiguousarray(frames.ids[which]).view(np.uint8).reshape(-1, 4)
    return np.concatenate([ids, payload[which]], axis=1)
