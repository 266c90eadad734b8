"""Findings in the first frames of a device that make its samples wrong or doubtful; a fatal one refuses a file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.can.can_frames import EXTENDED_FLAG, CanFrames
from drivers.protocol.period import Period

from .cycles import UNEQUAL_REL, Timing
from .signal_plan import Message, SignalPlan

TWIN_SHARE, ALIKE_SHARE = 0.9, 0.5  # of pairs that are alike in an echo; of neighbours that are alike in a quiet signal
TWIN_PAUSE_SHARE = 0.8  # of the distance of pairs: an echo follows sooner than the next sample
UNEVEN_SHARE, TIGHT_SHARE = 0.2, 0.1  # of a period: interleaved senders are off the middle by more, and keep to it
MOST_INTERLEAVED = 4
LISTED_IDS = 8
_PGN_MASK = 0x03FF_FF00

I64Array = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding. level, code, text : as of a Notice. fatal : samples or time base of a record would be wrong."""

    level: str
    code: str
    text: str
    fatal: bool = False


def look(
    messages: tuple[Message, ...], which: I64Array, frames: CanFrames, timing: Timing, nominal_hz: float | None
) -> list[Finding]:
    """Findings of the frames of mapped messages; which : (n,) the message of each."""
    out: list[Finding] = []
    for number, message in enumerate(messages):
        mine = which == number
        if not mine.any():
            text = f"no frame of {message.label} has come, so no sample is complete: check the signal map"
            out.append(Finding("warning", "message_missing", text))
            continue
        part = frames.pick(mine)
        period = timing.periods[number]
        found = _twice(message, part) or _interleaved(message, part.t_ns, period, nominal_hz)
        if found is not None:
            out.append(found)
    if not out and (unlike := timing.unlike()) is not None:
        out.append(_unlike(messages, timing, *unlike))
    return out


def _twice(message: Message, frames: CanFrames) -> Finding | None:
    """Finding of frames that come twice: each with its echo, or the same bus recorded twice."""
    if len(frames) < 2 * LEAST_PAIRS:
        return None
    same = (frames.payload[1:] == frames.payload[:-1]).all(axis=1)
    steps = np.diff(frames.t_ns)
    for start in (0, 1):
        pairs, between = slice(start, None, 2), slice(1 - start, None, 2)
        alike = same[pairs].mean() >= TWIN_SHARE and same[between].mean() <= ALIKE_SHARE
        if alike and np.median(steps[pairs]) <= TWIN_PAUSE_SHARE * np.median(steps[between]):
            ms = float(np.median(steps[pairs])) / 1e6
            text = (
                f"each frame of {message.label} comes twice, {ms:.3g} ms apart: the echo of frames that this host sent "
                "itself, or one bus recorded on two channels under one name: record each frame once"
            )
            return Finding("error", "frames_twice", text, fatal=True)
    return None


LEAST_PAIRS = 8


def _interleaved(message: Message, t_ns: I64Array, period: Period | None, nominal_hz: float | None) -> Finding | None:
    """Finding of several senders of one identifier: frames come unevenly at a whole multiple of the rate."""
    if period is None or nominal_hz is None:
        return None
    times = round(period.rate_hz / nominal_hz)
    if not 2 <= times <= MOST_INTERLEAVED or abs(period.rate_hz / nominal_hz / times - 1.0) > UNEQUAL_REL:
        return None
    steps = np.diff(t_ns).astype(np.float64)
    groups = [steps[k::times] for k in range(times)]
    middles = np.array([np.median(each) for each in groups])
    tight = all(np.median(np.abs(g - m)) < TIGHT_SHARE * period.ns for g, m in zip(groups, middles, strict=True))
    if not tight or np.ptp(middles) < UNEVEN_SHARE * period.ns:
        return None
    apart = " and ".join(f"{each / 1e6:.3g}" for each in sorted(set(middles.tolist())))
    text = (
        f"frames of {message.label} come {times} times as often as the rate of the rig file says, {apart} ms apart by "
        f"turns: {times} devices of one identifier, or frames and their echo: record one of them, each frame once"
    )
    return Finding("error", "interleaved", text, fatal=True)


def _unlike(messages: tuple[Message, ...], timing: Timing, fast: int, slow: int, share: float) -> Finding:
    names = [messages[k].label for k in (fast, slow)]
    rates = [1e9 / p.ns for k in (fast, slow) if (p := timing.periods[k]) is not None]
    what = f"{names[0]} comes at {rates[0]:.6g} Hz, {names[1]} at {rates[1]:.6g} Hz"
    if share > UNEQUAL_REL:
        text = f"{what}: messages of different rates make no common samples; map only messages of one rate"
        return Finding("error", "unequal_rates", text, fatal=True)
    text = f"{what}: clocks of their own, so their samples slip against each other; phases between them mean nothing"
    return Finding("error", "own_clocks", text)


def nothing_matched(plan: SignalPlan, seen: dict[int, int]) -> str:
    """Why frames gave no sample; seen : frames by identifier with flags."""
    wanted = " and ".join(message.label for message in plan.messages)
    if not seen:
        return f"it holds no frame; {wanted} is expected"
    if all(any((i & m.mask) == m.identifier for i in seen) for m in plan.messages):
        pages = " (of the mapped page of a multiplexed message)" if any(m.paged for m in plan.messages) else ""
        return f"frames of {wanted} came, but no complete sample{pages}: check the signal map, and the DBC"
    most = sorted(seen, key=lambda i: -seen[i])[:LISTED_IDS]
    listed = ", ".join(f"0x{i & 0x1FFF_FFFF:X}" for i in most) + (", ..." if len(seen) > LISTED_IDS else "")
    text = f"{sum(seen.values())} frames came, of {listed}, and none of {wanted}: check link.dbc and the signal map"
    for message in plan.messages:
        like = [i for i in seen if i & EXTENDED_FLAG and message.identifier & EXTENDED_FLAG
                and (i & _PGN_MASK) == (message.identifier & _PGN_MASK)]  # fmt: skip
        if like:
            text += (
                f"; 0x{like[0] & 0x1FFF_FFFF:X} is the same J1939 message (PGN) with another priority or source: "
                'set the attribute ProtocolType to "J1939" in the DBC'
            )
            break
        width = [i for i in seen if (i ^ message.identifier) == EXTENDED_FLAG]
        if width:
            kind = "29-bit" if width[0] & EXTENDED_FLAG else "11-bit"
            text += f"; 0x{width[0] & 0x1FFF_FFFF:X} came as a {kind} identifier: correct the DBC"
            break
    return text
