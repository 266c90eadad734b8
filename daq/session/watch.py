"""What an operator is told of beside the readings: time, rate and samples that are not as they should be."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from daq.base.contract.clock import MAX_CRYSTAL_ERROR_REL, Clock, DeviceClock
from daq.base.contract.sink import ClockState
from drivers.contract import Gap, Notice, Reading

EVERY_NS = 10_000_000_000  # what goes on and on is told this often
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
    """Of one session. say : level, code, text. Called from the core loop only."""

    def __init__(self, clock: Clock, say: Callable[[str, str, str], None]) -> None:
        self._clock = clock
        self._say = say
        now = clock.now_ns()
        self._seen_ns: int | None = None
        self._wall_ns = 0  # Unix time minus host time as the log began
        self._overflowed = 0  # samples, as last told
        self._overflow_ns = self._lost_ns = now - EVERY_NS
        self._lost: dict[str, int] = {}  # samples by reason, untold
        self._rate_told = False
        self._unlike_rig, self._heard_rate = "", False  # of the rig file's rate: not said yet; the link has said it

    def begin(self) -> None:
        """The log begins."""
        self._seen_ns = self._clock.now_ns()
        self._wall_ns = self._clock.wall_offset_ns()

    def standstill(self) -> None:
        """The core loop comes by ten times a second."""
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
        """At once, then every ten seconds while it goes on."""
        now = self._clock.now_ns()
        if self._lost and (final or now - self._lost_ns >= EVERY_NS):
            text = ", ".join(f"{count} {WORD_OF_REASON[reason]} ({reason})" for reason, count in self._lost.items())
            self._say("warning", "samples_lost", f"samples lost: {text}; rotorscope info says where in the log")
            self._lost, self._lost_ns = {}, now

    def wall_clock(self) -> None:
        """The log's times go by the steady clock and its offset at the start; what is set later leaves them alone."""
        if self._seen_ns is None:  # a session that ends before its log began
            return
        moved = self._clock.wall_offset_ns() - self._wall_ns
        if abs(moved) > WALL_STEP_NS:
            self._wall_ns += moved
            text = f"this computer's clock moved by {moved / 1e9:+.3f} s (set, or asleep); times in the log do not jump"
            self._say("warning", "wall_clock_set", text)

    def heard(self, notice: Notice) -> None:
        """Of a link that has not said yet what its device is."""
        self._heard_rate = self._heard_rate or notice.code == RATE_UNTRUE

    def introduced(self, rate_hz: float, expected_hz: float | None) -> None:
        """A description of the device; expected_hz : of the rig file."""
        if expected_hz is not None and abs(rate_hz / expected_hz - 1.0) > SAME_RATE_REL:
            text = f"the device sends {rate_hz:g} Hz, the rig file says {expected_hz:g} Hz: {rate_hz:g} Hz is used"
            self._unlike_rig = f"{text}; set acquisition.rate_hz = {rate_hz:g}"

    def rate_of_rig(self, readings: Sequence[Reading]) -> None:
        """That the rate is not that of the rig file, unless the link says it with the description of the device."""
        text, heard, self._unlike_rig, self._heard_rate = self._unlike_rig, self._heard_rate, "", False
        if text and not heard and not any(isinstance(r, Notice) and r.code == RATE_UNTRUE for r in readings):
            self._say("warning", RATE_UNTRUE, text)

    def rate(self, device: DeviceClock, state: ClockState | None) -> None:
        """Once in a session: what the device counts as a second is none. state : what is stated of its clock now."""
        if self._rate_told or (state is not None and abs(state.drift_ppm) < 1e6 * MAX_CRYSTAL_ERROR_REL):
            return
        true_hz = device.true_rate_hz()
        if true_hz is not None:
            self._rate_told = True
            text = f"samples come at {true_hz:.6g} Hz by this computer's clock, not at {device.rate_hz:g} Hz"
            more = "frequencies are wrong by as much, stiffness by twice that; correct the rate in device or rig file"
            self._say("warning", RATE_UNTRUE, f"{text}: {more}")

    def overflow(self, dropped: int, final: bool) -> None:
        """At once, then every ten seconds while it goes on: the gaps themselves come when the core loop gets there."""
        new, now = dropped - self._overflowed, self._clock.now_ns()
        if new and (final or now - self._overflow_ns >= EVERY_NS):
            self._overflowed, self._overflow_ns = dropped, now
            text = f"samples come faster than this computer processes them: the oldest {new} in the queue are dropped"
            self._say("error", "overflow", f"{text}; stop other programs, or lower the rate")
