"""Effects that tones and strike trains show by themselves, without a model of the bearings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.thresholds import THRESHOLDS
from estimator.effects import LINE_NAMES, NAMED
from estimator.effects.excitation.line import LINE
from estimator.effects.places import places
from estimator.effects.rotating.ball_pass import BALL_PASS
from estimator.effects.rotating.imbalance import IMBALANCE
from estimator.effects.rotating.local_defect import LOCAL_DEFECT
from estimator.effects.rotating.misalignment import MISALIGNMENT
from estimator.identification.machine import (
    RATE_CONTRADICTED,
    RATE_UNCONFIRMED,
    RECORD_SOURCE,
    SPEED_CONTRADICTED,
    MachineSurvey,
    StrikeTrain,
    Tone,
)
from estimator.identification.machine.thresholds import LIMITS as STRIKE_LIMITS
from estimator.identification.record import RecordSurvey
from estimator.likelihood.motion.harmonics import PERIODIC_EFFECTS
from estimator.model.bearing_theory import kinematics
from estimator.model.rig import MOTION_UNITS, EffectUse, Model, Setting
from estimator.results import RIG_FILE, Message, Parameter

from .mistake import mistake_entry

RING_TONES_CODE = "tones_at_bearing_order"  # of a message: tones alone show a defect of a ring
NO_KINEMATIC_NAME = "other"  # of a strike train at no kinematic order of the bearing
INTEGRATIONS_TO_VELOCITY = {  # by unit
    MOTION_UNITS[kind]: count for kind, count in (("acceleration", 1), ("velocity", 0), ("displacement", -1))
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Thresholds:
    """Limits that a tone or a strike train has to pass before it names an effect.

    Parameters
    ----------
    max_p_value : float
        Of a strike train, after counting all orders, bands and channels.
    min_velocity_m_s : float
        Velocity rms of the shaft's harmonics. 4.5 mm/s is the boundary of zones B and C of ISO 20816-3 for group 1 on
        rigid and group 2 on flexible supports, and of zones C and D for group 2 on rigid ones: every shaft has some 1X.
    min_dominance : float
        Share of the velocity power from 10 to 1000 Hz that the shaft's harmonics hold. Half: 3 dB.
    min_second_harmonic_ratio : float
        Velocity of 2X over that of 1X from which a misaligned coupling is likelier than imbalance (ISO 13373-3:
        2X comparable with 1X; three quarters in common charts).
    min_line_power_share : float
        Share of the power of a channel that one line holds. A tenth: a line 10 dB below the level adds 0.5 dB to it.
    whole_order_tolerance : float
        Distance of a strike order from a whole number, in shaft orders.
    tone_pair_chance : float
        That of two tones, anywhere in five nepers of frequency, one is within the slip of one of two orders (0.08 / 5)
        and the other at two or three times that (0.008 / 5).
    """

    max_p_value: float = 1e-3
    min_velocity_m_s: float = 4.5e-3
    min_dominance: float = 0.5
    min_second_harmonic_ratio: float = 0.75
    min_line_power_share: float = 0.1
    whole_order_tolerance: float = 0.02
    tone_pair_chance: float = 2.6e-5


MACHINE_THRESHOLDS = Thresholds()


def signal_entries(model: Model, record: RecordSurvey, machine: MachineSurvey) -> list[Entry]:
    """Candidates that the signal shows and the model does not have: strikes, then imbalance or misalignment."""
    there = {use.name for use in model.effects}
    strikes = strike_entries(model, machine) or ring_tone_entries(model, record, machine)
    found = [*strikes, *shaft_entries(model, record, machine)]
    return [entry for entry in found if entry.effect not in there]


def signal_use(model: Model, entry: Entry) -> EffectUse:
    """The effect of a candidate of the signal as a model holds it: with an order that is known, without strengths."""
    name, node = entry.effect, entry.at[0]
    can = places(NAMED[name], model)
    at = [place for place in can if place.split(".")[0] == node] or can
    known = {key.rsplit(".", 1)[1]: Setting(p.value) for key, p in entry.parameters.items()}
    return EffectUse(name, {place: dict(known) for place in at})


def strike_entries(model: Model, machine: MachineSurvey) -> list[Entry]:
    """Candidates for a defect of the bearing, clearest first: significant strike trains at a kinematic order.

    Where the geometry of the bearing is unknown, every order counts that is no whole multiple of the shaft; where the
    speed is unknown, none. A model with the varying compliance of the ball passes modulates the vibration at BPFO
    itself.
    """
    known = {"BPFO"} if any(use.name == BALL_PASS.name for use in model.effects) else set()
    out = []
    for train in machine.strikes:
        kinematic = train.name != NO_KINEMATIC_NAME or (model.bearing is None and train.order is not None)
        named = kinematic and train.name not in known and not is_whole_order(train)
        if train.p_value <= MACHINE_THRESHOLDS.max_p_value and named:
            out.append(_strike_entry(model, machine, train))
    return out


def ring_tone_entries(model: Model, record: RecordSurvey, machine: MachineSurvey) -> list[Entry]:
    """The candidate for a defect of a ring that two tones show: a large one at its order, another at a multiple of it.

    Where the band holds one or two harmonics of equal impacts these are tones, and no envelope is modulated. A model
    with the varying compliance of the ball passes has such tones itself.
    """
    speed, bearing = machine.speed, model.bearing
    if speed is None or bearing is None or any(use.name == BALL_PASS.name for use in model.effects):
        return []
    tones = [tone for tone in machine.tones if tone.kind == "other"]
    p_value = MACHINE_THRESHOLDS.tone_pair_chance * len(tones) * (len(tones) - 1)
    if p_value > MACHINE_THRESHOLDS.max_p_value:
        return []
    kinematic = kinematics(bearing)
    orders = {ring: kinematic[ring] for ring in ("BPFO", "BPFI")}
    for share, tone, channel in sorted(_power_shares(record, tones), key=lambda s: -s[0]):
        order = tone.frequency_hz / speed.hz
        ring = next((ring for ring, at in orders.items() if abs(order / at - 1.0) <= STRIKE_LIMITS.max_slip_rel), None)
        multiple = next((k for k in (2, 3) for other in tones if _is_multiple(other, tone, k)), None)
        if ring is None or multiple is None or share < MACHINE_THRESHOLDS.min_line_power_share:
            continue
        place = _place(model, channel)
        known = Parameter(order, order * speed.sd_rpm / speed.value_rpm, "1")
        text = (
            f"tones at {order:.3f} x shaft speed ({ring}), {share:.0%} of the power of {channel}, and at {multiple} "
            "times that: a defect of a ring, of which the band holds few harmonics; another source at this order does "
            "the same"
        )
        entry = _entry(LOCAL_DEFECT.name, place, p_value, {f"{place}.{LOCAL_DEFECT.name}.order": known})
        return [replace(entry, notes=(Message(RING_TONES_CODE, text),))]
    return []


def _is_multiple(other: Tone, tone: Tone, k: int) -> bool:
    """Whether a tone is at k times the frequency of another."""
    return abs(other.frequency_hz / (k * tone.frequency_hz) - 1.0) <= STRIKE_LIMITS.strike_tolerance_rel


def is_whole_order(train: StrikeTrain) -> bool:
    """Whether impacts repeat a whole number of times per turn."""
    if train.order is None or train.name != NO_KINEMATIC_NAME:
        return False
    return abs(train.order - round(train.order)) <= MACHINE_THRESHOLDS.whole_order_tolerance and round(train.order) > 0


def _strike_entry(model: Model, machine: MachineSurvey, train: StrikeTrain) -> Entry:
    """The entry of a strike train; its order where the speed is known."""
    place = _place(model, train.channel)
    parameters = {}
    if train.order is not None:
        speed = machine.speed
        sd = None if speed is None else train.order * speed.sd_rpm / speed.value_rpm
        parameters[f"{place}.{LOCAL_DEFECT.name}.order"] = Parameter(train.order, sd, "1")
    return _entry(LOCAL_DEFECT.name, place, train.p_value, parameters)


def have_one_order(one: Entry, other: Entry) -> bool:
    """Whether the orders of two candidates, where they have one, differ by no more than the slip of a bearing."""
    orders = [p.value for e in (one, other) for key, p in e.parameters.items() if key.endswith(".order") and p.value]
    return max(orders, default=1.0) <= (1.0 + STRIKE_LIMITS.max_slip_rel) * min(orders, default=1.0)


def shaft_entries(model: Model, record: RecordSurvey, machine: MachineSurvey) -> list[Entry]:
    """Imbalance or misalignment, where the first two harmonics of the shaft dominate a vibration that is too large.

    The bearings are those where it is too large, the largest vibration first: it does not show where the cause is.
    """
    first, second = (_harmonic(machine, k) for k in (1, 2))
    found: list[tuple[float, float, str]] = []
    for channel in model.channels:
        v1, v2 = (0.0 if tone is None else velocity_rms(tone, channel.name) for tone in (first, second))
        v = float(np.hypot(v1, v2))
        if _is_severe(v, record, channel.name):
            found.append((v, v2 / v1 if v1 else np.inf, _place(model, channel.name)))
    if not found:
        return []
    found.sort(key=lambda one: -one[0])
    _, ratio, place = found[0]
    name = MISALIGNMENT.name if ratio >= MACHINE_THRESHOLDS.min_second_harmonic_ratio else IMBALANCE.name
    p = min(tone.p_value for tone in (first, second) if tone is not None)
    nodes = dict.fromkeys(place.split(".")[0] for _, _, place in found)
    return [replace(_entry(name, place, p, {}), at=tuple(nodes))]


def severe_tone_message(model: Model, record: RecordSurvey, machine: MachineSurvey) -> Message | None:
    """The remark on a tone that dominates a vibration that is too large, where no speed shows whether it is the shaft.

    None where the speed is known, or no such tone is there.
    """
    if machine.speed is not None:
        return None
    for tone in machine.tones:
        for channel in model.channels:
            v = velocity_rms(tone, channel.name)
            if tone.kind == "other" and _is_severe(v, record, channel.name):
                text = (
                    f"a tone at {tone.frequency_hz:.2f} Hz holds most of {channel.name} ({1e3 * v:.1f} mm/s rms): give "
                    "speed_rpm to tell whether it is 1 x shaft (imbalance), 2 x shaft (misalignment) or another source"
                )
                return Message("severe_tone", text)
    return None


def _is_severe(velocity_m_s: float, record: RecordSurvey, channel: str) -> bool:
    """Whether the velocity of some tones is too large and most of that of a channel."""
    summary = record.channels.get(channel)
    whole = None if summary is None else summary.velocity_rms_mm_s
    dominant = whole is None or velocity_m_s**2 >= MACHINE_THRESHOLDS.min_dominance * (1e-3 * whole) ** 2
    return velocity_m_s >= MACHINE_THRESHOLDS.min_velocity_m_s and dominant


def line_entries(model: Model, record: RecordSurvey, machine: MachineSurvey) -> list[Entry]:
    """The line that holds the largest share of the power of a channel, if it is large. 1X and 2X are of every shaft."""
    own = [tone for tone in machine.tones if tone.order not in (1.0, 2.0) or tone.kind != "order"]
    share, tone, name = max(_power_shares(record, own), key=lambda s: s[0], default=(0.0, None, ""))
    if tone is None or share < MACHINE_THRESHOLDS.min_line_power_share:
        return []
    place = _place(model, name)
    parameters = {f"{place}.{LINE.name}.frequency": Parameter(tone.frequency_hz, None, "Hz")}
    return [_entry(LINE.name, place, tone.p_value, parameters)]


def _power_shares(record: RecordSurvey, tones: Iterable[Tone]) -> Iterator[tuple[float, Tone, str]]:
    """Share of the power of a channel that a tone holds, the tone, and the name of the channel."""
    for tone in tones:
        for name, amplitude in tone.amplitude.items():
            if name in record.channels and (rms := record.channels[name].rms):
                yield amplitude**2 / 2.0 / rms**2, tone, name


def tones_of_surroundings(machine: MachineSurvey) -> frozenset[str]:
    """Periodic forces that are not named beside an adequate model, as tones of the surroundings are in the record.

    Lines of the mains show that a record holds tones of its surroundings. A weak 1X or 2X is one of them: imbalance and
    misalignment are named by their severity alone.
    """
    if all(tone.kind != "mains" for tone in machine.tones):
        return frozenset()
    return frozenset(PERIODIC_EFFECTS) - {LOCAL_DEFECT.name, *LINE_NAMES}


def rig_file_entry(model: Model, machine: MachineSurvey, rate_hz: float) -> tuple[Entry, Message] | None:
    """A wrong speed or a wrong rate in the rig file, and what to check; None where the record contradicts neither.

    A comb of harmonics far from the given speed is a remark alone: it may be of another machine.
    """
    speed = machine.speed
    if speed is None or speed.source != RECORD_SOURCE or not model.speed_rpm:
        return None
    said = [m for m in machine.messages if m.code in (SPEED_CONTRADICTED, RATE_CONTRADICTED)]
    if not said:
        return None
    named = {"rig.speed_rpm": Parameter.from_estimate(speed.value_rpm, speed.sd_rpm, "rpm")}
    if {m.code for m in machine.messages} & {RATE_CONTRADICTED, RATE_UNCONFIRMED}:
        hz = rate_hz * model.speed_rpm / speed.value_rpm
        named["rate_hz"] = Parameter.from_estimate(hz, hz * speed.sd_rpm / speed.value_rpm, "Hz")
    nats = 0.5 * ((speed.value_rpm - model.speed_rpm) / speed.sd_rpm) ** 2
    return mistake_entry(nats, named), Message(RIG_FILE, said[0].text)


def whole_order_messages(machine: MachineSurvey) -> Iterator[Message]:
    """Remarks on impacts that repeat with the shaft: no defect of a bearing does."""
    for train in machine.strikes:
        if is_whole_order(train) and train.order is not None:
            k = round(train.order)
            text = (
                f"impacts in {train.channel} repeat {k} times per turn: a whole multiple of the shaft is no defect of "
                "a bearing; look for looseness, a rub, the coupling or a gear"
            )
            yield Message("strikes_at_shaft_order", text)


def velocity_rms(tone: Tone, channel: str) -> float:
    """Velocity rms of a tone in a channel, m/s; 0 where the channel measures no motion or does not show it."""
    if tone.unit not in INTEGRATIONS_TO_VELOCITY:
        return 0.0
    omega = 2.0 * np.pi * tone.frequency_hz
    return float(tone.amplitude.get(channel, 0.0) / omega ** INTEGRATIONS_TO_VELOCITY[tone.unit] / np.sqrt(2.0))


def _harmonic(machine: MachineSurvey, order: int) -> Tone | None:
    return next((t for t in machine.tones if t.kind == "order" and t.order == order), None)


def _place(model: Model, channel: str) -> str:
    return next(c.place for c in model.channels if c.name == channel)


def _entry(effect: str, place: str, p_value: float, parameters: dict[str, Parameter]) -> Entry:
    """An entry of the ranking. Its force is unknown without a model of the bearing: no share of it is given."""
    nats = -float(np.log(max(p_value, THRESHOLDS.min_p_value)))
    return Entry(
        effect=effect, at=(place.split(".")[0],), gain=nats, heldout_gain=nats, p_value=p_value,
        parameters=parameters, score=nats,
    )  # fmt: skip
