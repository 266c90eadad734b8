"""The rate that a device states, held against its own clock and the rig file before its samples are used.

A wrong rate would make every frequency wrong, or the session impossible. The first frames after a description wait
until their counters and clock show their rate.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field, replace

import numpy as np

from drivers.contract.notices import Notices
from drivers.contract.reading import Info

from .period import round_rate
from .protocol import TIME_MODULUS_US, SampleFrames

STATED_REL = 0.02  # a stated rate is used if the frames agree with it to within this
LEAST_STEPS = 2  # from frame to frame
MOST_GAP = 64  # frames between two whose distance counts
MOST_HELD, MOST_HELD_NS = 4096, 500_000_000  # frames; and so long
POSSIBLE_HZ = (1e-2, 1e6)  # of a device that counts samples here


@dataclass(slots=True)
class StatedRate:
    """`begin` with a new description; `admit` gives its frames, and with the first of them what to announce."""

    notices: Notices
    rig_hz: float | None
    info: Info | None = None  # that waits
    _held: list[SampleFrames] = field(default_factory=list)
    _: KW_ONLY
    _marks: list[tuple[int, int]] = field(default_factory=list)
    _start_ns: int = 0
    _modulus: int = 1

    def begin(self, info: Info, t_host_ns: int, timed: bool) -> Info | None:
        """The new description if it can be used at once, else None.

        timed : its frames carry times; else a description waits for sync frames only if it is doubtful.
        """
        known = self.rig_hz is not None and abs(info.rate_hz / self.rig_hz - 1.0) <= STATED_REL
        if not timed and _possible(info.rate_hz) and (known or self.rig_hz is None):
            self.info, self._held = None, []
            return info
        self.info, self._held, self._marks, self._start_ns = info, [], [], t_host_ns
        return None

    def admit(self, frames: SampleFrames, t_host_ns: int) -> tuple[Info | None, list[SampleFrames]]:
        """The description to announce, if it is decided now, and the frames that may be used."""
        if self.info is None:
            return None, [frames]
        self._held.append(frames)
        measured_hz = self._marked_hz() or _measured_hz(self._held)
        waited = t_host_ns - self._start_ns > MOST_HELD_NS or sum(map(len, self._held)) >= MOST_HELD
        return (None, []) if measured_hz is None and not waited else self._end(measured_hz, t_host_ns)

    def mark(self, index: int, modulus: int, time_us: int, t_host_ns: int) -> tuple[Info | None, list[SampleFrames]]:
        """A sync frame: the sample index, modulo `modulus`, at a time of the device. As `admit`."""
        if self.info is None:
            return None, []
        self._marks = [*self._marks[-1:], (index, time_us)]
        self._modulus = modulus
        measured_hz = self._marked_hz()
        return (None, []) if measured_hz is None else self._end(measured_hz, t_host_ns)

    def _marked_hz(self) -> float | None:
        if len(self._marks) < 2:
            return None
        (first, begin_us), (last, end_us) = self._marks
        passed_us = (end_us - begin_us) % TIME_MODULUS_US
        steps = (last - first) % self._modulus
        return steps * 1e6 / passed_us if steps > 0 and 0 < passed_us < TIME_MODULUS_US // 2 else None

    def _end(self, measured_hz: float | None, t_host_ns: int) -> tuple[Info | None, list[SampleFrames]]:
        info, held = self.info, self._held
        self.info, self._held = None, []
        return None if info is None else self._decided(info, measured_hz, t_host_ns), held

    def _decided(self, info: Info, measured_hz: float | None, t_host_ns: int) -> Info:
        possible = _possible(info.rate_hz)
        if measured_hz is None:
            if possible or self.rig_hz is None:
                return info
            used_hz, why = self.rig_hz, "which cannot be"
        elif possible and abs(info.rate_hz / measured_hz - 1.0) <= STATED_REL:
            return info
        else:
            used_hz, why = round_rate(measured_hz, 1e-3), f"its samples come at {measured_hz:.6g} Hz by its clock"
            if self.rig_hz is not None and abs(self.rig_hz / measured_hz - 1.0) <= STATED_REL:
                used_hz = self.rig_hz
        text = f"the device says a rate of {info.rate_hz:g} Hz, {why}: {used_hz:g} Hz is used; correct the device"
        self.notices.add(t_host_ns, "error", "stated_rate", text)
        return replace(info, rate_hz=used_hz)


def _possible(rate_hz: float) -> bool:
    return POSSIBLE_HZ[0] <= rate_hz <= POSSIBLE_HZ[1]


def _measured_hz(parts: list[SampleFrames]) -> float | None:
    """Sampling rate by the device's clock; None for too few frames, or without times."""
    if any(part.time_us is None for part in parts):
        return None
    modulus, time_modulus = parts[-1].modulus, parts[-1].time_modulus
    rows = parts[-1].counts.shape[1]
    position = np.concatenate([part.position for part in parts])
    time_us = np.concatenate([part.time_us for part in parts if part.time_us is not None])
    steps, passed_us = np.diff(position) % modulus, np.diff(time_us) % time_modulus
    good = (steps > 0) & (steps <= MOST_GAP * rows) & (passed_us > 0) & (passed_us < time_modulus // 2)
    if good.sum() < LEAST_STEPS:
        return None
    return float(np.median(steps[good] * 1e6 / passed_us[good]))
