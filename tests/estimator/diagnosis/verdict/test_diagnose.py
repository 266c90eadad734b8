"""The outer shape of a diagnosis: every record is answered, and one verdict follows from the layers."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import jsonschema
import numpy as np
import pytest
from hidden_effects import schema

from estimator import Channel, DataError, EffectUse, Model, Setting, compare, diagnose, fit, improve, simulate
from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.verdict.bearing import BearingJudgement
from estimator.diagnosis.verdict.clipped import with_clipped_channels
from estimator.diagnosis.verdict.diagnose import Diagnosis, verdict_of_layers
from estimator.identification.judgeable import Layers
from estimator.identification.machine import (
    RATE_CONTRADICTED,
    RATE_UNCONFIRMED,
    SPEED_CONTRADICTED,
    MachineSurvey,
    ShaftSpeed,
    StrikeTrain,
    Tone,
)
from estimator.identification.record import ChannelSummary, RecordSurvey, survey_record
from estimator.identification.structure import StructureSurvey
from estimator.model import BearingGeometry
from estimator.results import NOT_CONCLUSIVE, NOT_JUDGED, Message, Parameter

RATE_HZ = 5120.0
ONE_CAP_RIG = Model(
    (Channel("b1x", "bearing1", "x"), Channel("b1y", "bearing1", "y")),
    band=(100.0, 2000.0),
    mass={"bearing1": 0.2},
    speed_rpm=1800.0,
    bearing=BearingGeometry(9, 7.94e-3, 39.04e-3),
)


def bad_records() -> Iterator[Any]:
    """Records that carry no judgement of the bearings, and a word of the reason."""
    n = round(4 * RATE_HZ)
    noise = np.random.default_rng(0).standard_normal((n, 2))
    gaps = np.where(((np.arange(n) // 256) % 2 == 1)[:, None], np.nan, noise)
    t = np.arange(n)[:, None] / RATE_HZ
    tones = np.sin(2 * np.pi * 30 * t) + 0.3 * np.sin(2 * np.pi * 777 * t + [0, 1])
    yield pytest.param(tones + 0.01 * noise, "resonance", id="tones")
    yield pytest.param(noise, "resonance", id="noise")
    yield pytest.param(noise[: round(0.1 * RATE_HZ)], "resonance", id="0.1 s")
    yield pytest.param(gaps, "resonance", id="half of it gaps")
    yield pytest.param(noise * [1, 0], "resonance", id="one channel")
    yield pytest.param(np.sign(noise), "one bit", id="one bit")
    yield pytest.param(noise[:0], "no valid samples", id="empty")
    yield pytest.param(noise * np.nan, "no valid samples", id="nothing but gaps")


@pytest.mark.parametrize(("y", "reason"), list(bad_records()))
def test_a_bad_record_gets_the_true_reason_in_one_line_and_what_can_be_answered(y: np.ndarray, reason: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = diagnose(ONE_CAP_RIG, y, RATE_HZ)
        for command in (fit, compare, improve):
            with pytest.raises(DataError) as caught:
                command(ONE_CAP_RIG, y, RATE_HZ)
            assert str(caught.value) == found.bearing.reason
    assert not found.bearing.judged
    assert reason in found.bearing.reason
    assert "\n" not in found.bearing.reason
    assert found.verdict == "unknown"
    assert found.messages[0].code == NOT_JUDGED
    assert set(found.record.channels) == {"b1x", "b1y"}
    jsonschema.validate(found.to_json(), schema("diagnose"))


def strikes(name: Any = "BPFO", order: float = 3.585, p_value: float = 1e-30) -> StrikeTrain:
    return StrikeTrain(
        name=name, order=order, frequency_hz=order * 30, slip_percent=None, channel="b1y", band_hz=(500.0, 2000.0),
        p_value=p_value, severity=1.0, harmonics=5,
    )  # fmt: skip


def tone(order: float, mm_s: float, kind: Any = "order") -> Tone:
    """A tone by its velocity, mm/s rms."""
    hz = 30.0 * order
    amplitude = {"b1x": 1e-3 * mm_s * np.sqrt(2) * 2 * np.pi * hz}
    return Tone(kind=kind, order=order, frequency_hz=hz, amplitude=amplitude, unit="m/s^2", p_value=1e-20)


def entry(effect: str, percent: float = 30.0) -> Entry:
    return Entry(
        effect=effect, at=("bearing1",), gain=1e3, heldout_gain=1e3, p_value=1e-9, before_percent=percent,
        after_percent=0.0, parameters={}, score=1e3,
    )  # fmt: skip


def judged(verdict: str) -> BearingJudgement:
    ranking = () if verdict in ("complete", "unknown") else (entry(verdict),)
    return BearingJudgement(verdict, ranking)


SPEED_OF_RECORD = ShaftSpeed(value_rpm=1800.0, sd_rpm=0.6, source="record")


def verdict(
    bearing: BearingJudgement,
    *trains: StrikeTrain,
    tones: tuple[Tone, ...] = (),
    model: Model = ONE_CAP_RIG,
    rms: float = 100.0,
    remarks: tuple[Message, ...] = (),
    speed: ShaftSpeed | None = SPEED_OF_RECORD,
) -> Diagnosis:
    levels = {c.name: ChannelSummary(rms=rms, velocity_rms_mm_s=10.0) for c in model.channels}
    machine = MachineSurvey(speed=speed, tones=tones, strikes=trains, messages=remarks)
    layers = Layers(record=RecordSurvey(channels=levels), machine=machine, structure=StructureSurvey(band=model.band))
    return verdict_of_layers(model, layers, bearing, RATE_HZ)


NOT = BearingJudgement.not_judged("no resonance")


@pytest.mark.parametrize("bearing", ["complete", "unknown", "line", "cubic", "sensor_resonance"])
def test_strikes_at_a_kinematic_order_are_a_local_defect_whatever_law_the_impacts_look_like(bearing: str) -> None:
    found = verdict(judged(bearing), strikes())
    assert found.verdict == found.ranking[0].effect == "local_defect"
    order = found.ranking[0].parameters["bearing1.y.local_defect.order"]
    assert order.value == 3.585
    assert order.sd == pytest.approx(3.585 * 0.6 / 1800)


def test_a_law_that_turns_with_the_shaft_stands_beside_strikes_that_are_less_certain() -> None:
    """A ball pass modulates the envelope at its own order; clear strikes look like a ball pass."""
    assert verdict(judged("ball_pass"), strikes(p_value=1e-6)).verdict == "ball_pass"
    assert verdict(judged("ball_pass"), strikes(p_value=1e-30)).verdict == "local_defect"
    third = replace(entry("ball_pass"), parameters={"bearing1.y.ball_pass.order": Parameter(3 * 3.585, 0.01, "1")})
    found = verdict(BearingJudgement("ball_pass", (third,)), strikes(p_value=1e-6))
    assert found.verdict == "local_defect", "a harmonic of the strikes"


@pytest.mark.parametrize(("order", "reported"), [(3.60, 3.60), (7.17, 3.585)])
def test_the_order_of_a_defect_is_that_of_the_strikes(order: float, reported: float) -> None:
    """A force at every second harmonic has twice the order."""
    advice = Message("found_where", f"impacts at {order} x shaft speed")
    parameters = {"bearing1.y.local_defect.order": Parameter(order, 0.01, "1")}
    own = replace(entry("local_defect"), parameters=parameters, notes=(advice,))
    found = verdict(BearingJudgement("local_defect", (own,), messages=own.notes), strikes(order=3.585))
    assert found.verdict == found.ranking[0].effect == "local_defect"
    assert found.ranking[0].parameters["bearing1.y.local_defect.order"].value == reported
    assert (advice in found.messages) is (reported == order)
    assert sum(e.effect == "local_defect" for e in found.ranking) == 1


def test_a_law_of_the_users_own_stands_beside_strikes_and_tones_as_one_of_the_catalogue_does() -> None:
    defect = tuple(tone(order, 10.0 / order, "other") for order in (3.56, 7.12))
    for law in ("cubic", "users_own_law"):
        assert verdict(judged(law), strikes()).verdict == "local_defect"
        assert verdict(judged(law), tones=defect, rms=3.0).verdict == law
        assert verdict(judged(law), tones=(tone(1.0, 8.0), tone(2.0, 1.0))).verdict == law
        assert verdict(judged(law), tones=(tone(1.0, 8.0, "other"),), speed=None).verdict == law


def test_strikes_without_significance_name_or_news_are_no_verdict() -> None:
    assert verdict(judged("complete"), strikes(p_value=0.01)).verdict == "complete"
    assert verdict(judged("complete"), strikes("other", 2.7)).verdict == "complete", "no order of the known bearing"
    assert verdict(NOT, strikes("other", 2.7), model=replace(ONE_CAP_RIG, bearing=None)).verdict == "local_defect"
    there = replace(ONE_CAP_RIG, effects=(EffectUse("local_defect", {"bearing1": {}}),))
    assert verdict(judged("complete"), strikes(), model=there).verdict == "complete"
    passes = replace(ONE_CAP_RIG, effects=(EffectUse("ball_pass", {"bearing1.x": {}}),))
    assert verdict(judged("complete"), strikes(), model=passes).verdict == "complete", "it modulates at BPFO itself"


@pytest.mark.parametrize(
    ("orders", "expected"),
    [
        ((3.56, 7.12), "local_defect"),  # BPFO with a slip of 0.7 %, and its double
        ((5.43, 16.29), "local_defect"),  # BPFI
        ((3.56,), "complete"),  # one tone may be of anything
        ((3.56, 7.3), "complete"),
        ((3.3, 6.6), "complete"),  # no order of the bearing
        ((3.56, 7.12, 4.1, 4.2, 4.4, 5.1, 5.7, 8.3), "complete"),  # of many tones two are at such orders by chance
    ],
)
def test_two_tones_at_multiples_of_a_ball_pass_are_a_local_defect(orders: tuple[float, ...], expected: str) -> None:
    tones = tuple(tone(order, 10.0 / order, "other") for order in orders)
    found = verdict(judged("complete"), tones=tones, rms=3.0)
    assert found.verdict == expected
    if expected == "local_defect":
        assert found.ranking[0].parameters["bearing1.x.local_defect.order"].value == pytest.approx(orders[0])
        assert found.messages[0].code == "tones_at_bearing_order"
        assert verdict(judged("cubic"), tones=tones, rms=3.0).verdict == "cubic", "tones make no law"
        assert verdict(judged("complete"), tones=tones, rms=30.0).verdict == "complete", "a small part of the channel"
        passes = replace(ONE_CAP_RIG, effects=(EffectUse("ball_pass", {"bearing1.x": {}}),))
        assert verdict(judged("complete"), tones=tones, rms=3.0, model=passes).verdict == "complete"


def test_impacts_at_a_whole_multiple_of_the_shaft_are_no_defect_and_say_so() -> None:
    found = verdict(NOT, strikes("other", 2.998), model=replace(ONE_CAP_RIG, bearing=None))
    assert found.verdict == "unknown"
    assert any("3 times per turn" in message.text for message in found.messages)


@pytest.mark.parametrize(
    ("tones", "expected"),
    [
        ((tone(1.0, 8.0), tone(2.0, 1.0)), "imbalance"),
        ((tone(1.0, 4.0), tone(2.0, 7.0)), "misalignment"),
        ((tone(1.0, 1.2),), "unknown"),  # every shaft has some
        ((tone(1.0, 5.0),), "unknown"),  # a part of 10 mm/s
    ],
)
def test_harmonics_of_the_shaft_are_a_fault_where_they_are_large_and_dominate(
    tones: tuple[Tone, ...], expected: str
) -> None:
    assert verdict(NOT, tones=tones).verdict == expected


def test_harmonics_of_the_shaft_are_named_at_every_bearing_where_they_are_too_large() -> None:
    """The larger vibration does not show which bearing the cause is at."""
    both = replace(ONE_CAP_RIG, channels=(Channel("b1x", "bearing1", "x"), Channel("b2x", "bearing2", "x")))
    large = tone(1.0, 5.0)
    for factor, at in ((2.0, ("bearing2", "bearing1")), (0.5, ("bearing1",))):
        shown = replace(large, amplitude=large.amplitude | {"b2x": factor * large.amplitude["b1x"]})
        found = verdict(NOT, tones=(shown, tone(2.0, 6.0)), model=both)
        assert found.ranking[0].at == at


@pytest.mark.parametrize(
    ("bearing", "expected"),
    [
        ("complete", "unknown"),
        ("sensor_noise", "unknown"),
        ("unknown", "unknown"),
        ("cubic", "cubic"),
        ("line", "line"),
    ],
)
def test_a_severe_tone_without_a_speed_is_said_and_nothing_is_complete_beside_it(bearing: str, expected: str) -> None:
    for mm_s, severe in ((8.0, True), (2.0, False)):
        found = verdict(judged(bearing), tones=(tone(1.0, mm_s, "other"),), speed=None)
        assert found.verdict == (expected if severe else bearing)
        assert ("severe_tone" in [m.code for m in found.messages]) is severe
    assert "severe_tone" not in [m.code for m in verdict(judged(bearing), tones=(tone(2.5, 8.0, "other"),)).messages]


def test_a_line_that_holds_much_of_a_channel_is_named_only_where_no_model_explains_the_record() -> None:
    hum = tone(3.34, 1.0, "mains")
    assert verdict(NOT, tones=(hum,), rms=1.0).verdict == "line"
    assert verdict(NOT, tones=(hum,), rms=10.0).verdict == "unknown"
    unnamed = replace(strikes("other", 3.585), order=None)
    assert verdict(NOT, unnamed, tones=(hum,), rms=1.0, speed=None).verdict == "unknown", "a line of the impacts"
    assert verdict(judged("complete"), tones=(hum,), rms=1.0).verdict == "complete"


def test_no_share_is_over_100_percent_and_no_more_than_ten_notes_are_said() -> None:
    many = tuple(Message("found_where", f"{k} Hz") for k in range(150))
    bearing = BearingJudgement("line", (entry("line", 6610.0),), messages=many)
    found = verdict(bearing)
    assert found.ranking[0].before_percent == 100.0
    assert len(found.messages) <= 10
    beside_a_tone = verdict(bearing, tones=(tone(1.0, 8.0, "other"),), speed=None)
    assert len(beside_a_tone.messages) <= 10
    assert beside_a_tone.messages[0].code == "severe_tone"


SPEED_FOUND_RPM, RATE_FOUND_HZ = {"rig.speed_rpm": 1800.0}, {"rate_hz": RATE_HZ * 1750.0 / 1800.0}


@pytest.mark.parametrize(
    ("codes", "values"),
    [
        ((SPEED_CONTRADICTED,), SPEED_FOUND_RPM),
        ((RATE_CONTRADICTED,), SPEED_FOUND_RPM | RATE_FOUND_HZ),
        ((SPEED_CONTRADICTED, RATE_UNCONFIRMED), SPEED_FOUND_RPM | RATE_FOUND_HZ),  # the record does not tell which
    ],
)
def test_a_speed_or_rate_that_the_record_contradicts_is_named_before_a_law_or_a_spectral_shape(
    codes: tuple[str, ...], values: dict[str, float]
) -> None:
    rig, remarks = replace(ONE_CAP_RIG, speed_rpm=1750.0), tuple(Message(code, f"check {code}") for code in codes)
    found = verdict(judged("complete"), model=rig, remarks=remarks)
    assert found.verdict == found.ranking[0].effect == "rig_file"
    assert {key: p.value for key, p in found.ranking[0].parameters.items()} == pytest.approx(values)
    for name in ("cubic", "users_own_law", "pedestal", "unknown"):
        assert verdict(judged(name), model=rig, remarks=remarks).verdict == "rig_file"
    assert verdict(judged("complete"), model=rig).verdict == "complete"


def test_complete_is_not_said_where_an_effect_of_three_per_cent_could_hide() -> None:
    """A short record of a well damped cap shows nothing, and would not show an effect of 4 % of the bearing force."""
    cap = {"bearing1.x": {"kL": Setting(1e7), "c": Setting(283.0), "S": Setting(1e-4)}}
    rig = Model((Channel("b1x", "bearing1", "x"),), band=(150.0, 8000.0), mass={"bearing1": 0.2}, linear=cap)
    y = simulate(rig, rate_hz=25600.0, seconds=0.7, seed=1)
    compared, found = compare(rig, y, 25600.0), diagnose(rig, y, 25600.0)
    assert compared.missing[0] == 0.0 < 3.0 < compared.missing[2]
    assert not compared.adequate
    assert found.verdict == "unknown"
    for messages in (compared.messages, found.messages):
        assert NOT_CONCLUSIVE in [message.code for message in messages]


@pytest.mark.parametrize(("bearing", "expected"), [("line", "sensor_clipping"), ("cubic", "cubic")])
def test_a_clipped_channel_goes_before_a_line_and_after_a_law(bearing: str, expected: str) -> None:
    y = np.clip(np.random.default_rng(1).standard_normal((4096, 2)), [-1.5, -9.0], [1.5, 9.0])
    record = survey_record(ONE_CAP_RIG, y, RATE_HZ)
    found = with_clipped_channels(judged(bearing), ONE_CAP_RIG, y, record)
    assert found.verdict == expected
    assert {e.effect for e in found.ranking} == {"sensor_clipping", bearing}
