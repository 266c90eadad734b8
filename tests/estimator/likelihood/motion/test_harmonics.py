"""Periodic forces of a model: their series, and their numbers from what is left of the force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, SECONDS, one_bearing, record
from numpy.typing import NDArray

from estimator.diagnosis.hypotheses import ranking
from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import size, strengths
from estimator.identification.batch.disturbance_numbers import with_found_effects
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.residual import lines
from estimator.identification.residual.harmonic_fit import RECORD_PIECES, fit_found_harmonics, refine_harmonics
from estimator.identification.residual.missing_force import survey
from estimator.identification.search import search
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.harmonics import known_lines, periodic_effects, periodic_series
from estimator.likelihood.motion.motion_record import MotionRecord
from estimator.likelihood.motion.prepare import prepare
from estimator.likelihood.path.working_point import WorkingPoint
from estimator.model.rig import EffectUse, Model, Setting
from estimator.simulation.simulator import simulate

LINE = {"a": 0.12, "b": -0.05, "frequency": 791.37}
DEFECT = {"strike": 1.5, "order": 2.1, "angle": 0.7, "width": 0.05}


def with_use(model: Model, name: str, values: dict[str, float], place: str = "bearing1.x") -> Model:
    use = EffectUse(name, {place: {k: Setting(v) for k, v in values.items()}})
    return replace(model, effects=(*model.effects, use))


@pytest.fixture(scope="module")
def rig() -> Model:
    return one_bearing()


@pytest.fixture(scope="module")
def data(rig: Model) -> MotionRecord:
    return prepare(rig, simulate(rig, RATE, 6.0, seed=5, noise=0.02, full_scale=490.5), RATE)


@pytest.fixture(scope="module")
def point(data: MotionRecord) -> WorkingPoint:
    """A rotor that is known to the last digit."""
    point = fit_model(data, [])
    return replace(point, fit=replace(point.fit, covariance=0.0 * point.fit.covariance), S=np.array([9e-5, 9e-5]))


def series_of(model: Model, data: MotionRecord) -> NDArray[np.float64]:
    out = periodic_series(model, data.places, data.t, data.phase, data.rate_hz)
    assert out is not None
    return out


def test_a_line_is_what_its_law_says(rig: Model, data: MotionRecord) -> None:
    turn = 2 * np.pi * LINE["frequency"] * data.t
    F = series_of(with_use(rig, "line", LINE), data)
    np.testing.assert_allclose(F[0], LINE["a"] * np.cos(turn) + LINE["b"] * np.sin(turn), atol=1e-4)
    assert not F[1].any()


def test_a_train_of_strikes_has_the_harmonics_of_its_fourier_series(rig: Model) -> None:
    """2 / (2 pi) strike width / (1 + i k width) exp(-i k angle), where exp(-2 pi / width) is nothing."""
    (one,) = periodic_effects(with_use(rig, "local_defect", DEFECT))
    k = np.arange(1, 101)
    width = DEFECT["width"]
    exact = DEFECT["strike"] * width / np.pi / (1 + 1j * k * width) * np.exp(-1j * k * DEFECT["angle"])
    np.testing.assert_allclose(one.harmonics(rig, "bearing1.x", 100), exact, rtol=0.03)


@pytest.mark.parametrize(("name", "values"), [("line", LINE), ("local_defect", DEFECT), ("misalignment", {"a": 1.0})])
def test_the_lines_of_an_effect_are_known_before_its_strength(rig: Model, name: str, values: dict[str, float]) -> None:
    angle = {k: v for k, v in values.items() if k in ("frequency", "order")}
    first = {"line": LINE["frequency"], "local_defect": 2.1 * 35.0, "misalignment": 70.0}[name]
    assert known_lines(with_use(rig, name, angle))[0] == pytest.approx(first)
    assert known_lines(rig) == []


def test_a_line_of_unknown_frequency_is_not_known(rig: Model) -> None:
    assert known_lines(with_use(rig, "line", {"a": 0.1})) == []


def test_what_lies_outside_of_the_band_adds_nothing(rig: Model, data: MotionRecord) -> None:
    slow = with_use(rig, "misalignment", {"a": 1.0, "b": 1.0})  # 70 Hz
    assert periodic_series(slow, data.places, data.t, data.phase, data.rate_hz) is None
    quick = replace(slow, speed_rpm=30000.0)  # 1000 Hz
    assert np.isclose(
        np.abs(series_of(quick, replace(data, phase=2 * np.pi * 500.0 * data.t))[0]).max(), 2**0.5, rtol=0.01
    )


@pytest.mark.parametrize(("name", "values", "off"), [
    ("line", LINE, {"a": 0.02, "b": 0.01, "frequency": 0.005}),
    ("misalignment", {"a": 0.1, "b": -0.2}, {"a": 0.1, "b": 0.1}),
    ("local_defect", DEFECT, {"strike": -0.2, "order": 2e-5, "angle": 0.01, "width": 0.005}),
])  # fmt: skip
def test_wrong_numbers_are_found_from_what_they_leave(
    rig: Model, point: WorkingPoint, name: str, values: dict[str, float], off: dict[str, float]
) -> None:
    """White noise and the difference of two forces: after some steps the truth lies within its intervals."""
    rig = replace(rig, speed_rpm=6000.0) if name == "misalignment" else rig
    speed = 2 * np.pi * (rig.speed_rpm or 0.0) / 60
    data = replace(point.data, speed=speed, phase=speed * point.data.t)
    truth = with_use(rig, name, values)
    noise = white(data, point.S)
    model = with_use(rig, name, {k: v + off[k] for k, v in values.items()})
    for _ in range(4):
        force = noise + series_of(truth, data) - series_of(model, data)
        model, found = refine_harmonics(model, replace(point, data=data), force)
    for key, value in values.items():
        p = found[f"bearing1.x.{name}.{key}"]
        assert p.identifiable
        assert abs((p.value or 0.0) - value) < 4 * (p.sd or 0.0), key
    if name == "misalignment":  # of a line whose frequency is known: sd^2 = S / T
        assert found[f"bearing1.x.{name}.a"].sd == pytest.approx(sd_of_amplitude(point), rel=2 / RECORD_PIECES)


def white(data: MotionRecord, S: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.random.default_rng(1).normal(size=data.x.shape) * np.sqrt(S[:, None] * RATE / 2)


def sd_of_amplitude(point: WorkingPoint) -> float:
    return float((point.S[0] / (point.data.t.size / RATE)) ** 0.5)


def test_a_phase_at_the_start_of_the_record_is_half_as_well_known_as_an_amplitude(
    rig: Model, point: WorkingPoint
) -> None:
    """With an unknown frequency the Cramer-Rao bound of a phase at one end is four times that in the middle."""
    model = with_use(rig, "line", {"a": 0.13, "b": 0.0, "frequency": 791.37})
    _, found = refine_harmonics(model, point, white(point.data, point.S))
    a, b = (found[f"bearing1.x.line.{k}"].sd for k in "ab")
    assert a == pytest.approx(sd_of_amplitude(point), rel=2 / RECORD_PIECES)
    assert b == pytest.approx(2 * sd_of_amplitude(point), rel=2 / RECORD_PIECES)


def test_a_line_in_the_noise_of_a_sensor_is_as_uncertain_as_that_makes_it(rig: Model, point: WorkingPoint) -> None:
    model = with_use(rig, "line", LINE)
    noise = replace(point.whitening.noise, weight=np.full_like(point.whitening.weight, 0.25))
    noisy = replace(point, whitening=replace(point.whitening, noise=noise))
    quiet, loud = (refine_harmonics(model, p, white(p.data, p.S))[1]["bearing1.x.line.a"].sd for p in (point, noisy))
    assert quiet is not None
    assert loud == pytest.approx(2 * quiet, rel=0.02)  # four times the power


@pytest.mark.slow
def test_a_line_about_the_resonance_does_not_move_the_rotor() -> None:
    """Its own motion says of k and c what its force is held to be: fitted one after the other, a strong one was half as
    large as it is, and kNL by a quarter off."""
    rig = one_bearing()
    resonance = float(np.sqrt((rig.linear["bearing1.x"]["kL"].value or 0.0) / (rig.cap_mass("bearing1.x") or 1.0)))
    hum = {"a": 0.16, "b": 0.16, "frequency": 1.03 * resonance / (2 * np.pi)}
    y = simulate(with_use(rig, "line", hum), RATE, 20.0, seed=7, noise=0.02, full_scale=490.5)
    model = replace(rig, effects=(*rig.effects, EffectUse("line", {"bearing1.x": {}})))
    found = fit_all_effects(model, y, RATE).parameters
    for name, value in hum.items():
        p = found[f"bearing1.x.line.{name}"]
        assert p.sd is not None
        assert abs((p.value or 0.0) - value) < 4 * p.sd, name


@pytest.mark.slow
def test_strikes_that_are_found_are_as_strong_as_they_are() -> None:
    """The mean over all periods is taken in coarse cells: by it alone a strike was a third too weak, fifty standard
    deviations."""
    rig = one_bearing()
    y = record(rig, "local_defect", 0.06)
    point = fit_all_effects(rig, y, RATE).point
    (seen,) = (s for s in lines.find_lines(rig, point, y) if s.effect == "local_defect")
    found = fit_found_harmonics(rig, point, {"local_defect": seen.settings})[0]["local_defect"]
    truth = strengths(CATALOGUE["local_defect"], size(rig, "bearing1.x", RATE), 0.06, rig, SECONDS)
    for place in rig.places:
        for name in ("strike", "order", "width"):
            p, value = found[place][name], truth[name]
            assert p.sd is not None
            assert abs((p.value or 0.0) - value) < 4 * p.sd, (place, name)


@pytest.mark.slow
def test_a_place_may_have_more_than_one_line(rig: Model) -> None:
    """A machine beside the rig has several tones: with one line a place, each took the place of the last."""
    hums = {"line": (357.0, 0.9), "line_2": (245.0, 0.5), "line_3": (861.0, 0.1)}
    truth = rig
    for name, (hz, force) in hums.items():
        truth = with_use(truth, name, {"a": force, "b": -0.3 * force, "frequency": hz})
    y = simulate(truth, RATE, 8.0, seed=5, noise=0.02, full_scale=490.5)
    whole = fit_all_effects(rig, y, RATE)
    seen = search(rig, whole.point, y)
    entry = ranking.ranked_entries(rig, whole.point, [], survey(whole.point, rig, only=()), seen)[0]
    assert [*entry.settings] == [*hums]
    added = fit_all_effects(with_found_effects(rig, entry.settings), y, RATE)
    assert search(added.model, added.point, y) == []
    for name, (hz, force) in hums.items():
        for key, value in {"a": force, "b": -0.3 * force, "frequency": hz}.items():
            p = added.parameters[f"bearing1.x.{name}.{key}"]
            assert p.sd is not None
            assert abs((p.value or 0.0) - value) < 4 * p.sd, (name, key)
    further = replace(added.model, effects=tuple(u for u in added.model.effects if u.name != "line_2"))
    left = [s for s in seen if s.region.startswith("24")]
    again = ranking.ranked_entries(further, whole.point, [], survey(whole.point, rig, only=()), left)[0]
    assert [*again.settings] == ["line_2"]


@pytest.mark.slow
def test_a_line_without_a_frequency_is_as_many_as_there_are(rig: Model) -> None:
    """`add line` cannot know how many there are; one that the file gives a frequency stays one."""
    truth = with_use(rig, "line", {"a": 0.6, "b": 0.1, "frequency": 350.0})
    truth = with_use(truth, "line_2", {"a": -0.2, "b": 0.3, "frequency": 850.0})
    y = simulate(truth, RATE, 6.0, seed=5, noise=0.02, full_scale=490.5)
    whole = fit_all_effects(with_use(rig, "line", {}), y, RATE)
    assert [use.name for use in whole.model.effects] == ["cubic", "line", "line_2"]
    assert [m.code for m in whole.messages] == ["several_lines"]
    for use in truth.effects[1:]:
        for key, setting in use.parameters["bearing1.x"].items():
            p = whole.parameters[f"bearing1.x.{use.name}.{key}"]
            assert p.sd is not None
            assert abs((p.value or 0.0) - (setting.value or 0.0)) < 4 * p.sd, (use.name, key)
    one = fit_all_effects(with_use(rig, "line", {"frequency": 850.0}), y, RATE)
    assert [use.name for use in one.model.effects] == ["cubic", "line"]
    assert one.parameters["bearing1.x.line.frequency"].value == pytest.approx(850.0, abs=0.01)


@pytest.mark.slow
def test_what_a_law_makes_of_lines_is_no_force(rig: Model) -> None:
    """Beside a cubic three tones make sums and differences in the motion, which passed for a line and for strikes."""
    truth = rig
    for k, hz in enumerate((300.0, 450.0, 1050.0, 1500.0)):
        truth = with_use(truth, "line" if k == 0 else f"line_{k + 1}", {"a": 0.6, "b": 0.3, "frequency": hz})
    y = simulate(truth, RATE, 8.0, seed=3, noise=0.02, full_scale=490.5)
    whole = fit_all_effects(with_use(rig, "line", {}), y, RATE)
    assert [use.name for use in whole.model.effects] == ["cubic", "line", "line_2", "line_3", "line_4"]
    assert search(whole.model, whole.point, y) == []


def test_what_is_fixed_stays(rig: Model, point: WorkingPoint) -> None:
    use = EffectUse("line", {"bearing1.x": {k: Setting(v, fixed=k == "frequency") for k, v in LINE.items()}})
    model, found = refine_harmonics(replace(rig, effects=(use,)), point, np.ones_like(point.force))
    assert model.effects[0].parameters["bearing1.x"]["frequency"].value == LINE["frequency"]
    assert found["bearing1.x.line.frequency"].sd == 0.0
    given = EffectUse("line", {"bearing1.x": {k: Setting(v, fixed=True) for k, v in LINE.items()}})
    assert not refine_harmonics(replace(rig, effects=(given,)), point, np.ones_like(point.force))[1]
