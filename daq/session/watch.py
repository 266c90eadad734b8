"""Warnings besides the readings: faults of time and rate, and lost samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from daq.base.contract.clock import MAX_CRYSTAL_ERROR_REL, Clock, DeviceClock
from daq.base.contract.sink import ClockState
from drivers.contract import Gap, Notice, Reading

EVERY_NS = 10_000_000_000  # interval of the warnings about a fault that lasts
WALL_STEP_NS = 500_000_000
STILL_NS = 5_000_000_000
SAME_RATE_REL = 1e-3  # between the rate of a device and that of the rig file
RATE_UNTRUE = "rate_untrue"  # code: the rate is not that of the rig file, or not that of the device
WORD_OF_REASON = {  # reasons of gaps that no driver has a notice for
    "sequence": "on the way",
    "device_lost": "by the device itself",
    "source": "that the device did not send, or not at the rate of the rig file",
}


class Watch:
    """Watches one session. say : receives level, code, text. Called from the core loop only."""

    def __init__(self, clock: Clock, say: Callable[[str, str, str], None]) -> None:
        self._clock = clock
        self._say = say
        now = clock.now_ns()
        self._seen_ns: int | None = None
        self._wall_ns = 0  # Unix time minus host time as the log began
        self._overflowed = 0  # samples, as last reported
        self._overflow_ns = self._lost_ns = now - EVERY_NS
        self._lost: dict[str, int] = {}  # samples by reason, not reported yet
        self._rate_reported = False
        self._unlike_rig, self._link_warned = (
            "",
            False,
        )  # warning about the rate that waits; whether the link has given it

    def begin(self) -> None:
        """Take the clock's offset at the start of the log."""
        self._seen_ns = self._clock.now_ns()
        self._wall_ns = self._clock.wall_offset_ns()

    def standstill(self) -> None:
        """Report a pause of the core loop, which calls this ten times a second."""
        now = self._clock.now_ns()
        if self._seen_ns is None:
            return
        still_ns, self._seen_ns = now - self._seen_ns, now
        if still_ns > STILL_NS:
            text = f"this program did not run for {still_ns / 1e9:.1f} s (it was stopped, or the computer was busy)"
            self._say("warning", "stood_still", f"{text}: samples that the link could not keep so long are lost")

    def lost(self, gap: Gap) -> None:
        if gap.reason in WORD_OF_REASON:
            self._lost[gap.reason] = self._lost.get(gap.reason, 0) + gap.count

    def losses(self, final: bool) -> None:
        """Report lost samples at once, then every ten seconds while the loss goes on."""
        now = self._clock.now_ns()
        if self._lost and (final or now - self._lost_ns >= EVERY_NS):
            text = ", ".join(f"{count} {WORD_OF_REASON[reason]} ({reason})" for reason, count in self._lost.items())
            self._say("warning", "samples_lost", f"samples lost: {text}; rotorscope info says where in the log")
            self._lost, self._lost_ns = {}, now

    def wall_clock(self) -> None:
        """Report a step of this computer's clock. The times of the log do not follow it: they use the steady clock."""
        if self._seen_ns is None:  # a session that ends before its log began
            return
        moved = self._clock.wall_offset_ns() - self._wall_ns
        if abs(moved) > WALL_STEP_NS:
            self._wall_ns += moved
            text = f"this computer's clock moved by {moved / 1e9:+.3f} s (set, or asleep); times in the log do not jump"
            self._say("warning", "wall_clock_set", text)

    def warned(self, notice: Notice) -> None:
        """Take a notice of a link whose device has not described itself yet."""
        self._link_warned = self._link_warned or notice.code == RATE_UNTRUE

    def introduced(self, rate_hz: float, expected_hz: float | None) -> None:
        """Compare the rate of a description with the rig file. expected_hz : of the rig file; None if it gives none."""
        if expected_hz is not None and abs(rate_hz / expected_hz - 1.0) > SAME_RATE_REL:
            text = f"the device sends {rate_hz:g} Hz, the rig file says {expected_hz:g} Hz: {rate_hz:g} Hz is used"
            self._unlike_rig = f"{text}; set acquisition.rate_hz = {rate_hz:g}"

    def rate_of_rig(self, readings: Sequence[Reading]) -> None:
        """Report a rate that differs from the rig file, unless the link reports it with the device's description."""
        text, warned, self._unlike_rig, self._link_warned = self._unlike_rig, self._link_warned, "", False
        if text and not warned and not any(isinstance(r, Notice) and r.code == RATE_UNTRUE for r in readings):
            self._say("warning", RATE_UNTRUE, text)

    def rate(self, device: DeviceClock, state: ClockState | None) -> None:
        """Report once that the device's second is wrong. state : the present statement of its clock."""
        if self._rate_reported or (state is not None and abs(state.drift_ppm) < 1e6 * MAX_CRYSTAL_ERROR_REL):
            return
        true_hz = device.true_rate_hz()
        if true_hz is not None:
            self._rate_reported = True
            text = f"samples come at {true_hz:.6g} Hz by this computer's clock, not at {device.rate_hz:g} Hz"
            more = "frequencies are wrong by as much, stiffness by twice that; correct the rate in device or rig file"
            self._say("warning", RATE_UNTRUE, f"{text}: {more}")

    def overflow(self, dropped: int, final: bool) -> None:
        """Report dropped readings at once, then every ten seconds while this goes on; their gaps come later."""
        new, now = dropped - self._overflowed, self._clock.now_ns()
        if new and (final or now - self._overflow_ns >= EVERY_NS):
            self._overflowed, self._overflow_ns = dropped, now
            text = f"samples come faster than this computer processes them: the oldest {new} in the queue are dropped"
            self._say("error", "overflow", f"{text}; stop other programs, or lower the rate")
