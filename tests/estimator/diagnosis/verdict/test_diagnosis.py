"""Hidden effects: the data come from the simulator, the diagnosis sees samples and a rig without the effect."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest
from hidden_effects import RATE, ROOT, SECONDS, one_bearing, record, schema

from daq.rig.rig import load_rig
from estimator.diagnosis.hypotheses.screen import amplitude_checked, promising_trials, rank_on_part
from estimator.diagnosis.verdict.bearing import BearingJudgement, quiet, verdict_of_laws, verdict_of_ranking
from estimator.diagnosis.verdict.diagnose import diagnose
from estimator.diagnosis.verdict.gate_second_law import another_explains
from estimator.diagnosis.verdict.improvement import improve
from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import size, strengths
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.model.rig import EffectUse, Model
from estimator.simulation.simulator import simulate

UNTOLD = ("bow", "crack")  # on a soft shaft: docs/diagnosis.md, what one record cannot tell


@pytest.fixture(scope="module")
def rig() -> Model:
    return one_bearing()


def test_a_complete_model_is_called_complete_and_stays_as_it_is(rig: Model) -> None:
    y = simulate(rig, RATE, SECONDS, seed=5, noise=0.02, full_scale=490.5)
    ladder = improve(rig, y, RATE)
    assert ladder.last.verdict == "complete"
    assert len(ladder.rungs) == 1
    value, low, _ = ladder.rungs[0].missing
    assert low == 0.0
    assert value < 0.3
    jsonschema.validate(ladder.to_json(), schema("improve"))
    jsonschema.validate(ladder.last.to_json(), schema("diagnose"))


@pytest.mark.slow
def test_a_hidden_quadratic_stiffness_is_named_added_and_nothing_is_left(rig: Model) -> None:
    """Samples that were lost are left out."""
    y = record(rig, "quadratic", 0.06)
    y[60000:60500] = np.nan
    ladder = improve(rig, y, RATE)
    assert ladder.diagnoses[0].verdict == "quadratic"
    assert [r.effects for r in ladder.rungs] == [("cubic",), ("cubic", "quadratic")]
    assert ladder.rungs[1].heldout_nll < ladder.rungs[0].heldout_nll
    assert ladder.rungs[1].missing[0] < 0.2 * ladder.rungs[0].missing[0]
    truth = strengths(CATALOGUE["quadratic"], size(rig, "bearing1.x", RATE), 0.06, rig, SECONDS)["kq"]
    for direction in "xy":
        found = ladder.parameters[f"bearing1.{direction}.quadratic.kq"]
        assert found.value == pytest.approx(truth, rel=0.1)
        assert found.sd is not None
        assert abs(found.value - truth) < 4 * found.sd


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["coulomb", "line"])
def test_named_first(rig: Model, effect: str) -> None:
    found = diagnose(rig, record(rig, effect, 0.06), RATE)
    assert found.verdict == effect
    assert found.ranking[0].at == ("bearing1",)
    assert found.ranking[0].p_value < 1e-3
    jsonschema.validate(found.to_json(), schema("diagnose"))


@pytest.mark.slow
def test_a_clipped_sensor_is_named_and_its_place_is_not_judged(rig: Model) -> None:
    y = record(rig, "sensor_clipping", 0.06)
    found = diagnose(rig, y, RATE)
    assert (found.verdict, found.ranking[0].at) == ("sensor_clipping", ("bearing1",))
    assert any(m.code == "clipped" and "use a sensor range of at least" in m.text for m in found.messages)
    known = replace(rig, effects=(*rig.effects, EffectUse("sensor_clipping", {"bearing1": {}})))
    assert diagnose(known, y, RATE).verdict != "sensor_clipping"


@pytest.mark.parametrize(("samples", "live", "reason"), [(4000, 2, "needed for band.low"), (60000, 0, "b1x is zero")])
def test_a_record_that_does_not_carry_the_bearings_is_answered_with_the_reason(
    rig: Model, samples: int, live: int, reason: str
) -> None:
    y = np.random.default_rng(0).standard_normal((samples, 2))
    y[:, live:] = 0.0
    found = diagnose(rig, y, RATE)
    assert not found.bearing.judged
    assert reason in found.bearing.reason
    assert found.verdict == "unknown"
    assert not found.ranking
    jsonschema.validate(found.to_json(), schema("diagnose"))


@pytest.mark.slow
@pytest.mark.parametrize("strength", [0.02, 0.06])
@pytest.mark.parametrize("effect", [e for e in CATALOGUE if e not in ("cubic", "sensor_gain", "sensor_skew")])
def test_catalogue(effect: str, strength: float) -> None:
    model = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model
    found = diagnose(model, record(model, effect, strength, seconds=60.0), RATE).verdict
    assert found == ("complete" if effect in UNTOLD else effect)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("right", "wrong", "if_far"), [("quadratic", "stop", "quadratic"), ("clearance", "quintic", "unknown")]
)
def test_a_law_just_behind_that_leaves_nothing_beats_one_that_leaves_much(
    rig: Model, monkeypatch: pytest.MonkeyPatch, right: str, wrong: str, if_far: str
) -> None:
    """As Bouc-Wen is at times some nats ahead of a drag that is there; and it is no second law of a pair. A stop is odd
    and even, and may pass the even law that is there by any number of nats."""
    monkeypatch.setattr(
        "estimator.likelihood.motion.located_law.CATALOGUE", {name: CATALOGUE[name] for name in (right, wrong)}
    )
    y = record(rig, right, 0.06)
    fitted = fit_all_effects(rig, y, RATE)
    found = rank_on_part(fitted.model, fitted.point, y, quiet)
    before, entries = found.before, amplitude_checked(found)
    there, ahead = (next(e for e in entries if e.effect == name) for name in (right, wrong))

    def verdict(nats: float, force: float = 1.0) -> BearingJudgement:
        order = [replace(ahead, score=there.score + nats), there]
        return verdict_of_laws(
            fitted.model, fitted.point, replace(before, bearing_force_N=force * before.bearing_force_N), order, quiet
        )

    near, far = verdict(5.0), verdict(50.0)
    assert near.verdict == near.ranking[0].effect == right
    assert near.messages[0].text.startswith(f"{wrong} was ahead")
    assert far.verdict == if_far
    if if_far == "unknown":
        assert far.ranking[0].effect == wrong
        assert verdict(50.0, force=1e3).verdict == "complete", "of so little nothing is claimed"


def test_a_law_that_is_nothing_once_it_is_fitted_with_the_model_is_not_named(
    rig: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside noise as strong as the motion trials won up to 38 nats by a law that the fit then takes away (Bouc-Wen,
    behind filters that fold, another simulator)."""
    monkeypatch.setattr(
        "estimator.likelihood.motion.located_law.CATALOGUE",
        {name: CATALOGUE[name] for name in ("quadratic", "coulomb")},
    )
    y = simulate(rig, RATE, 3.0, seed=6, noise=0.02)
    fitted = fit_all_effects(rig, y, RATE)
    found = rank_on_part(fitted.model, fitted.point, y, quiet)
    before, entries = found.before, amplitude_checked(found)
    assert not before.places_found()
    seeming = next(replace(e, p_value=1e-8, explained_percent=0.5) for e in entries if e.effect == "quadratic")
    others = [e for e in entries if e.effect != "quadratic"]
    found = verdict_of_ranking(fitted.model, fitted.point, before, [seeming, *others], quiet)
    assert found.verdict == "complete"
    assert [e.effect for e in found.ranking][-1] == "quadratic"
    assert found.ranking[-1].notes[-1].code == "refused_idle"


def test_a_second_effect_is_to_explain_all_that_smooth_terms_do(rig: Model) -> None:
    """The odd half of a one-sided stop takes a part of what an odd law of the wrong shape leaves (|x|^1.5, another
    simulator): that made a cubic and a stop of one law that is neither."""
    bare = replace(rig, effects=())
    point = fit_all_effects(bare, record(rig, "cubic", 0.0), RATE).point  # the cubic of the rig is what is left
    left = SimpleNamespace(residuals=[SimpleNamespace(place=0, found=[SimpleNamespace(gain_nats=16.0)])])
    best = SimpleNamespace(law=CATALOGUE["quintic"], places={0, 1})

    def explained(gain: float) -> bool:
        stop = CATALOGUE["stop"]
        stops = [SimpleNamespace(effect=stop, gain=gain, df=2, placed=SimpleNamespace(at=(i,))) for i in (0, 1)]
        return another_explains(point, {"stop": stops}, left, best)  # type: ignore[arg-type]

    assert not explained(8.0)
    assert explained(1000.0)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_false_alarms_are_rare() -> None:
    from daq.commands.study.confusion import run
    from daq.commands.study.hidden import NO_HIDDEN_EFFECT, Case

    model = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model
    verdicts = [run(model, Case(NO_HIDDEN_EFFECT, "-", "-", seed), 20.0)["verdict"] for seed in range(40)]
    assert sum(v != NO_HIDDEN_EFFECT for v in verdicts) <= 2, verdicts


def test_an_effect_near_the_front_at_one_bearing_is_refined_at_the_other() -> None:
    """A gap between two nodes of the grid loses half of its nats at one bearing and not at the other."""

    def trial(effect: str, location: str, gain: float) -> SimpleNamespace:
        return SimpleNamespace(effect=SimpleNamespace(name=effect), location=location, gain=gain)

    trials = [
        trial("quintic", "bearing1.x", 100.0), trial("quintic", "bearing2.x", 100.0),
        trial("clearance", "bearing1.x", 20.0), trial("clearance", "bearing2.x", 60.0),
        trial("stop", "bearing1.x", 5.0), trial("stop", "bearing2.x", 1.0),
    ]  # fmt: skip
    found = {(t.effect.name, t.location) for t in promising_trials(trials)}  # type: ignore[arg-type]
    assert {e for e, _ in found} == {"quintic", "clearance"}
    assert ("clearance", "bearing1.x") in found


@pytest.mark.slow
def test_a_shaft_that_is_stiffer_than_the_rig_file_says_is_unknown_and_said() -> None:
    """No effect of the catalogue is a wrong spring: what is missing is seen against the other bearing."""
    stiff = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model
    stiff = replace(
        stiff, channels=tuple(c for c in stiff.channels if c.direction == "x"), effects=(), shaft="beam",
        linear={p: v for p, v in stiff.linear.items() if p.endswith("x")}, shaft_stiffness=1e6, band=(600.0, 8000.0),
    )  # fmt: skip
    y = simulate(replace(stiff, shaft_stiffness=1.2e6), RATE, 6.0, seed=1, noise=0.02)
    found = diagnose(stiff, y, RATE)
    assert found.verdict == "unknown"
    assert any(m.code == "caps_coupled_otherwise" for m in found.messages)
