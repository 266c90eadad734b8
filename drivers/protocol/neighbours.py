"""Whether the head of a frame (counter, clock, number of the start) continues that of the frame before."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .protocol import SampleFrames


def follows(f: SampleFrames, rate_hz: float, steps: int = 1, slack_us: float = 0.0) -> NDArray[np.bool_]:
    """(n - steps,) whether frame k + steps lies that many frames behind frame k, within half a frame of time."""
    ahead = steps * f.counts.shape[1]
    good = (f.position[steps:] - f.position[:-steps]) % f.modulus == ahead
    good &= f.epoch[steps:] == f.epoch[:-steps]
    if f.time_us is not None:
        step_us = ahead * 1e6 / rate_hz
        late = np.abs((f.time_us[steps:] - f.time_us[:-steps]) % f.time_modulus - step_us)
        good &= late <= 0.5 * step_us / steps + slack_us
    return np.asarray(good)


class Neighbours:
    """Finds damaged frames without check sums: they fit neither neighbour, while the neighbours fit each other.

    A frame that does not continue the last one waits for the next frame, which shows whether frame or stream is wrong.
    """

    def __init__(self) -> None:
        self._last: SampleFrames | None = None  # what was handed on, one frame
        self._held: SampleFrames | None = None  # one frame

    def plausible(self, frames: SampleFrames, rate_hz: float) -> list[SampleFrames]:
        """The frames that can be judged; between two pieces one was dropped."""
        known, held = self._last, self._held
        before = [part for part in (known, held) if part is not None and _alike(part, frames)]
        first = 1 if known is not None and before and before[0] is known else 0
        f = _joined([*before, frames])
        n = len(f)
        if n <= first:
            return [frames]
        next_one = follows(f, rate_hz)
        wrong = np.zeros(n, bool)
        if n > 2:
            wrong[1:-1] = ~next_one[:-1] & ~next_one[1:] & follows(f, rate_hz, 2)
        wrong[:first] = False
        stop = n
        if n > 1 and n - 1 >= first and not next_one[-1] and not wrong[n - 2]:
            stop = n - 1  # no neighbour behind it yet
        self._held = _pick(f, n - 1, n) if stop < n else None
        cuts = np.flatnonzero(wrong[:stop]).tolist()
        pieces = [_pick(f, a, b) for a, b in zip([first, *(c + 1 for c in cuts)], [*cuts, stop], strict=True)]
        good = [k for k in range(stop - 1, -1, -1) if not wrong[k]][:1]
        self._last = _pick(f, good[0], good[0] + 1) if good else None
        return pieces


def _alike(a: SampleFrames, b: SampleFrames) -> bool:
    same = (a.modulus, a.time_modulus, a.counts.shape[1:]) == (b.modulus, b.time_modulus, b.counts.shape[1:])
    return same and (a.time_us is None) == (b.time_us is None)


def _joined(parts: list[SampleFrames]) -> SampleFrames:
    if len(parts) == 1:
        return parts[0]
    arrays: dict[str, Any] = {}
    for field in fields(SampleFrames):
        values = [getattr(part, field.name) for part in parts]
        if isinstance(values[0], np.ndarray):
            arrays[field.name] = np.concatenate(values)
    return replace(parts[-1], **arrays)


def _pick(f: SampleFrames, start: int, stop: int) -> SampleFrames:
    values: dict[str, Any] = {field.name: getattr(f, field.name) for field in fields(f)}
    cut: dict[str, Any] = {
        name: value[start:stop] if isinstance(value, np.ndarray) else value for name, value in values.items()
    }
    return SampleFrames(**cut)
