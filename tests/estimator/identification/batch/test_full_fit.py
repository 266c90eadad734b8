"""The whole model on a record: what is no law of the states is found too, whatever the rig file starts from."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, ROOT, coupled_on_a_stiff_shaft, one_bearing, record
from reference_rig import rig_model, rig_record

from daq.rig.rig import load_rig
from estimator.diagnosis.comparison.comparison import compare
from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import size, strengths, with_effect
from estimator.errors import DataError
from estimator.identification.batch import spectral as spectral
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.model.rig import EffectUse, Model, Setting
from estimator.simulation.simulator import simulate

# effect, strength, where, and how near its numbers come: standard deviations, or a part of the value for those
# whose law is not quite that of a sampled record
CASES = [
    ("line", ("bearing1.x", "bearing1.y"), ("a", "b", "frequency")),
    ("misalignment", ("bearing1.x", "bearing1.y"), ("a", "b")),
    ("local_defect", ("bearing1.x", "bearing1.y"), ("strike", "order", "width")),
    ("coloured_excitation", ("bearing1.x", "bearing1.y"), ("gain", "corner")),
    ("sensor_resonance", ("bearing1.x",), ("frequency", "quality")),
    ("sensor_noise", ("bearing1.x",), ("rms",)),
    ("pedestal", ("bearing1.x", "bearing1.y"), ("mass", "frequency", "damping")),
]


@pytest.fixture(scope="module")
def rig() -> Model:
    return one_bearing()


@pytest.mark.parametrize(
    ("name", "where", "numbers"),
    # the start of a pedestal has a test of its own
    [pytest.param(*c, id=c[0], marks=pytest.mark.slow) for c in CASES],
)
def test_an_effect_added_without_numbers_is_fitted(
    rig: Model, name: str, where: tuple[str, ...], numbers: tuple[str, ...]
) -> None:
    y = record(rig, name, 0.06)
    truth = strengths(CATALOGUE[name], size(rig, "bearing1.x", RATE), 0.06, rig, len(y) / RATE)
    added = replace(rig, effects=(*rig.effects, EffectUse(name, {place: {} for place in where})))
    fit = spectral.fit_spectral(added, y, RATE)
    for key in numbers:
        p = fit.parameters[f"{where[0]}.{name}.{key}"]
        assert p.identifiable, (key, p.reason)
        assert abs((p.value or 0.0) - truth[key]) < 4 * (p.sd or 0.0) + 1e-3 * abs(truth[key]), (key, p, truth[key])


@pytest.mark.slow
def test_what_a_colour_is_uncertain_by_its_level_is_too(rig: Model) -> None:
    """It was given as if the colour were known: errors were up to five of its standard deviations (10 places)."""
    y = record(rig, "coloured_excitation", 0.06)
    added = replace(rig, effects=(*rig.effects, EffectUse("coloured_excitation", {"bearing1.x": {}, "bearing1.y": {}})))
    fit = spectral.fit_spectral(added, y, RATE)
    known = np.sqrt(1.0 / ((rig.band[1] - rig.band[0]) * len(y) / RATE))
    for place in ("bearing1.x", "bearing1.y"):
        S, true = fit.parameters[f"{place}.S"], rig.linear[place]["S"].value or 0.0
        assert abs((S.value or 0.0) / true - 1.0) < 3.5 * (S.sd or 0.0) / true
        assert (S.sd or 0.0) / true > 1.5 * known


@pytest.mark.slow
def test_the_true_model_with_a_strong_line_is_adequate(rig: Model) -> None:
    """The laws see the whole motion: a line taken out of it first would leave 3 kNL x x_line^2 behind."""
    y = record(rig, "line", 0.06)
    added = replace(rig, effects=(*rig.effects, EffectUse("line", {"bearing1.x": {}, "bearing1.y": {}})))
    assert compare(added, y, RATE).adequate


def test_what_a_record_does_not_have_is_said(rig: Model) -> None:
    y = record(rig, "sensor_gain", 0.0)
    uses = (
        EffectUse("line", {"bearing1.x": {}}),
        EffectUse("sensor_gain", {"bearing1.x": {"error": Setting()}}),
        EffectUse("coloured_excitation", {"bearing1.y": {"corner": Setting(500.0, fixed=True)}}),
    )
    fit = spectral.fit_spectral(replace(rig, effects=(*rig.effects, *uses)), y, RATE)
    assert fit.parameters["bearing1.x.line.frequency"].reason == "not distinguishable from zero in this record"
    assert "calibrate the sensor" in fit.parameters["bearing1.x.sensor_gain.error"].reason
    assert fit.parameters["bearing1.y.coloured_excitation.gain"].value is None
    assert fit.parameters["bearing1.y.coloured_excitation.corner"].value == 500.0
    assert fit.parameters["bearing1.x.kL"].identifiable


@pytest.mark.slow
def test_forces_that_the_bearings_share_leave_nothing_once_they_are_in_the_model() -> None:
    """ln(1 - rho^2) nats a bin and pair are won; the motion of the other bearing no longer depends on the force."""
    rig = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model
    y = record(rig, "correlated_force", 0.06, seconds=8.0)
    (rho,) = strengths(CATALOGUE["correlated_force"], size(rig, "bearing1.x", RATE), 0.06, rig, 8.0).values()
    use = EffectUse("correlated_force", {"bearing1.x": {}, "bearing1.y": {}})
    before, after = compare(rig, y, RATE), compare(replace(rig, effects=(*rig.effects, use)), y, RATE)
    assert (before.adequate, after.adequate) == (False, True)
    share = (8000.0 - 150.0) / (RATE / 2) / 2  # bins to a sample
    won = -2 * share * np.log(1 - rho**2)
    assert before.heldout_nll - after.heldout_nll == pytest.approx(won, rel=0.05)
    assert abs((after.parameters["bearing1.x.correlated_force.rho"].value or 0.0) - rho) < 0.01
    S = after.parameters["bearing1.x.S"].value
    assert pytest.approx(before.parameters["bearing1.x.S"].value, rel=0.01) == S


@pytest.mark.slow
def test_a_coloured_force_and_a_pedestal_do_not_take_from_each_other(rig: Model) -> None:
    """The colour is looked for among laws that it has distorted: found once only, kL was 9 and S 17 sd off."""
    truth = rig
    for name in ("coloured_excitation", "pedestal"):
        effect = CATALOGUE[name]
        truth = with_effect(
            truth, effect, strengths(effect, size(rig, "bearing1.x", RATE), 0.06, rig, 12.0), *rig.places
        )
    y = simulate(truth, RATE, 12.0, seed=3, noise=0.02, full_scale=490.5)
    empty = tuple(replace(use, parameters={key: {} for key in use.parameters}) for use in truth.effects)
    fit = spectral.fit_spectral(replace(rig, effects=empty), y, RATE).parameters
    true = {f"{p}.{u.name}.{k}": s.value for u in truth.effects for p, own in u.parameters.items()
            for k, s in own.items()}  # fmt: skip
    true |= {f"{p}.{k}": s.value for p, own in rig.linear.items() for k, s in own.items()}
    for name, value in true.items():
        assert abs((fit[name].value or 0.0) - (value or 0.0)) < 3.5 * (fit[name].sd or 0.0), name


@pytest.mark.slow
def test_what_is_not_identifiable_is_used_and_not_shown(rig: Model) -> None:
    """A sensor's resonance above the band: many pairs of frequency and quality do; the best one whitens the force."""
    y = record(rig, "sensor_resonance", 0.02, seconds=20.0)
    added = replace(rig, effects=(*rig.effects, EffectUse("sensor_resonance", {"bearing1.x": {}, "bearing1.y": {}})))
    found = compare(added, y, RATE)
    quality = found.to_json()["parameters"]["bearing1.x.sensor_resonance.quality"]
    assert found.adequate
    assert quality["identifiable"] or quality["value"] is None
    assert not compare(rig, y, RATE).adequate


def test_of_a_long_record_six_stretches_are_judged_and_it_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = one_bearing()
    y = simulate(rig, RATE, 16.0, seed=5, noise=0.02, full_scale=490.5)
    whole = fit_all_effects(rig, y, RATE)
    monkeypatch.setattr("estimator.likelihood.motion.prepare.MAX_SAMPLES", 4.0 * RATE * len(rig.places))
    part = fit_all_effects(rig, y, RATE)
    assert whole.messages == ()
    assert [m.code for m in part.messages] == ["record_long"]
    assert part.point.data.t[-1] > 13.0
    for name, p in whole.parameters.items():
        less = part.parameters[name]
        assert p.sd is not None
        assert less.sd is not None
        assert less.sd == pytest.approx(2.0 * p.sd, rel=0.3)
        assert abs((less.value or 0.0) - (p.value or 0.0)) < 4 * less.sd


@pytest.mark.parametrize("what", ["noise", "band"])
def test_without_a_resonance_in_the_band_nothing_is_said(what: str) -> None:
    """Of white noise diagnose said "sensor_noise", of a band above the resonance "unknown"; fit has refused both."""
    y = np.random.default_rng(0).normal(size=(int(3 * RATE), 4)) if what == "noise" else rig_record(3.0, seed=1)
    model = rig_model() if what == "noise" else rig_model("cubic", band=(3000.0, 8000.0))
    with pytest.raises(DataError, match="no resonance of bearing1.x inside the band"):
        fit_all_effects(model, y, RATE)


def test_a_law_that_the_motion_does_not_reach_is_said_and_breaks_nothing() -> None:
    """Its column is zero: the step of its stiffness was infinite, and `diagnose` ended with a LinAlgError."""
    rig = one_bearing()
    far = {"k": Setting(1e6), "gap": Setting(1e-3, fixed=True)}
    model = replace(rig, effects=(*rig.effects, EffectUse("clearance", {"bearing1.x": far})))
    y = simulate(rig, RATE, 2.0, seed=0, noise=0.02)
    found = fit_all_effects(model, y, RATE).parameters
    k = found["bearing1.x.clearance.k"]
    assert (k.value, k.identifiable) == (None, False)
    assert "too small to reach" in k.reason
    assert found["bearing1.x.cubic.kNL"].identifiable


def test_without_a_mass_nothing_is_said_in_newtons() -> None:
    """The cap was taken for 1 kg: kL was 350 % high with a standard deviation of 0.2 %."""
    rig = one_bearing()
    bare = replace(rig, mass={k: m for k, m in rig.mass.items() if not k.startswith("bearing")})
    y = simulate(rig, RATE, 4.0, seed=0, noise=0.02)
    whole = fit_all_effects(bare, y, RATE)
    for found in (whole.parameters, spectral.fit_spectral(bare, y, RATE).parameters):
        assert {"bearing1.x.kL", "bearing1.y.cubic.kNL"} <= found.keys()
        assert not any(p.identifiable for p in found.values())
    assert [(m.code, m.place) for m in whole.messages] == [("mass_unknown", p) for p in ("bearing1.x", "bearing1.y")]
    place, m = "bearing1.x", rig.mass["bearing1"]
    kL, c = ((rig.linear[place][name].value or 0.0) for name in ("kL", "c"))
    kNL = rig.effects[0].parameters[place]["kNL"].value or 0.0
    said = re.findall(r"([\d.e+]+) \+- ([\d.e+]+)", whole.messages[0].text)
    truth = np.sqrt(kL / m) / (2 * np.pi), 100 * c / (2 * np.sqrt(kL * m)), kNL / kL
    for (value, sd), true in zip(said, truth, strict=True):
        assert abs(float(value) - true) < 4 * float(sd)
        assert float(sd) < 0.2 * true


@pytest.mark.slow
def test_masses_that_are_left_out_are_as_a_stiff_shaft_has_them() -> None:
    """Caps had been taken for 1 kg: 12 % of the force was missing of a complete model, and seemed to be shared by the
    bearings."""
    rig = load_rig(ROOT / "configs/strong_shaft.toml").model
    truth = {p: {"kL": Setting(1e7), "c": Setting(57.0), "S": Setting(9e-5)} for p in rig.places}
    cubic = EffectUse("cubic", {p: {"kNL": Setting(3.5e18)} for p in rig.places})
    known = replace(rig, mass={"disc": 0.515, "bearing1": 0.2, "bearing2": 0.22}, linear=truth, effects=(cubic,))
    found = compare(rig, simulate(known, RATE, 12.0, seed=1, noise=0.02), RATE)
    assert found.adequate, [(w.channel, w.against, w.region) for w in found.where]
    assert any(m.code == "mass_by_shaft" for m in found.messages)
    for place in rig.places:
        for name, value in (("m", known.cap_mass(place)), ("kL", 1e7)):
            p = found.parameters[f"{place}.{name}"]
            assert abs((p.value or 0.0) - (value or 0.0)) < 4.0 * (p.sd or 0.0), (place, name)


@pytest.mark.slow
def test_a_complete_rotor_on_a_stiff_beam_lacks_nothing() -> None:
    """The other cap's answer through the shaft had been left out of the Jacobian of the survey: 0.5 % against it."""
    rig = load_rig(ROOT / "configs/strong_shaft.toml").model
    truth = {p: {"kL": Setting(1e7), "c": Setting(120.0), "S": Setting(9e-5)} for p in rig.places}
    mass = {"disc": 0.515, "bearing1": 0.2, "bearing2": 0.22}
    beam = replace(rig, shaft="beam", shaft_stiffness=5e6, shaft_damping=4.0, mass=mass, linear=truth, effects=())
    found = compare(beam, simulate(beam, RATE, 30.0, seed=2, noise=0.02), RATE)
    assert found.adequate, [(w.channel, w.against, w.region) for w in found.where]


@pytest.mark.slow
def test_numbers_beside_a_stiff_shaft_are_those_of_the_rotor() -> None:
    """With the determinant of every third bin k of the coupling was 4.9 and 3.6 standard deviations high, kL 4 low."""
    known = coupled_on_a_stiff_shaft()
    found = fit_all_effects(known, simulate(known, RATE, 30.0, seed=1, noise=0.02), RATE).parameters
    wanted = {f"{p}.{q}": v for p in known.places for q, v in (("kL", 1e7), ("c", 40.0))}
    for name, value in (wanted | {f"{n}.cross_coupling.k": 1e5 for n in ("bearing1", "bearing2")}).items():
        assert abs((found[name].value or 0.0) - value) < 3.0 * (found[name].sd or 0.0), name
