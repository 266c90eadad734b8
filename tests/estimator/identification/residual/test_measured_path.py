"""Beside a measured force: a faulty sensor biases the path from force to motion; a periodic force that is not in the
channel stands in what it leaves. Checked on records made in the frequency domain, not by our simulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from exact_path import KL, MASS, RATE, RIG, C, S, record
from numpy.typing import NDArray

from estimator.diagnosis.comparison.heldout import heldout_rmse
from estimator.diagnosis.verdict.diagnose import diagnose
from estimator.diagnosis.verdict.improvement import improve
from estimator.effects import CATALOGUE
from estimator.identification.batch import spectral as spectral
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.residual import measured_path
from estimator.identification.search import search
from estimator.model.rig import EffectUse, Model

Array = NDArray[np.float64]
Sensor = Callable[[Array], Array]
PLACE = "bearing1.x"


def sensor_with(name: str, *p: float) -> Sensor:
    """The catalogue's own sensor effect."""
    apply = CATALOGUE[name].apply
    assert apply is not None
    return lambda y: np.asarray(apply(y, RATE, p, np.random.default_rng(0)))


HIDDEN = {
    "sensor_gain": (0.05,),
    "sensor_skew": (0.3 / RATE,),
}


def made(name: str, seed: int = 3) -> Array:
    return record(seed=seed, sensor=sensor_with(name, *HIDDEN[name]))


def given(name: str) -> Model:
    """The rig with an effect of unknown numbers."""
    return replace(RIG, effects=(EffectUse(name, {PLACE: {}}),))


@pytest.mark.parametrize("name", HIDDEN)
def test_what_bends_the_path_is_found_first_and_its_numbers_are_right(name: str) -> None:
    y = made(name)
    first = search(RIG, fit_all_effects(RIG, y, RATE).point, y)[0]
    assert (first.effect, first.at) == (name, (PLACE,))
    assert first.p_value < 1e-6
    for p, true in zip(first.settings[PLACE].values(), HIDDEN[name], strict=True):
        assert p.value == pytest.approx(true, rel=5e-3)


def all_slow_but(quick: str) -> list[object]:
    return [pytest.param(n, marks=[pytest.mark.slow] if n != quick else []) for n in HIDDEN]


@pytest.mark.slow
@pytest.mark.parametrize("name", all_slow_but("sensor_skew"))
def test_added_without_numbers_it_is_fitted_and_the_free_run_error_is_the_noise(name: str) -> None:
    y = made(name)
    noise = heldout_rmse(RIG, record(seed=3), RATE)["a"]
    before, after = heldout_rmse(RIG, y, RATE)["a"], heldout_rmse(given(name), y, RATE)["a"]
    assert before > 5 * noise
    assert after - noise < 0.05 * (before - noise)
    fit = spectral.fit_spectral(given(name), y, RATE).parameters
    for (key, p), true in zip(
        ((k, fit[f"{PLACE}.{name}.{k.name}"]) for k in CATALOGUE[name].parameters), HIDDEN[name], strict=True
    ):
        assert abs((p.value or 0.0) - true) < 4 * (p.sd or 0.0) + 5e-4 * abs(true), key.name
    assert fit[f"{PLACE}.kL"].value == pytest.approx(KL, rel=5e-4)
    assert fit[f"{PLACE}.c"].value == pytest.approx(C, rel=5e-3)


@pytest.mark.parametrize("seed", range(4))
def test_a_complete_model_has_no_suspect(seed: int) -> None:
    noise = [(0.02, 1e-3), (0.3, 1e-3), (0.02, 0.03), (2.0, 0.1)][seed]
    y = record(seed=seed, noise=noise)
    assert search(RIG, fit_all_effects(RIG, y, RATE).point, y) == []


def test_a_gain_that_no_calibration_would_show_is_not_claimed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The steps of a simulation make one of 0.04 %, which beside much damping is a force large enough for a name."""
    monkeypatch.setattr(measured_path, "LIMITS", replace(measured_path.LIMITS, negligible_force_share=1e-4))
    for error, claimed in ((1.5e-3, False), (3e-3, True)):
        y = record(seed=3, sensor=sensor_with("sensor_gain", error))
        found = search(RIG, fit_all_effects(RIG, y, RATE).point, y)
        assert [s.effect for s in found][:1] == ["sensor_gain"] * claimed


def unseen(t: Array) -> Array:
    """An eighth of the power of the measured force."""
    return np.random.default_rng(17).normal(size=t.size) * np.sqrt(S / 8 * RATE / 2)


def test_a_force_beside_the_measured_one_is_no_fault_of_a_sensor() -> None:
    """A machine runs beside the shaker. Read as noise of the force sensor it would look like a gain of 12 %."""
    y = record(seed=3, unseen=unseen)
    whole = fit_all_effects(RIG, y, RATE)
    assert search(RIG, whole.point, y) == []
    assert measured_path.force_noise_ratio(RIG, whole.point) == {}
    found = spectral.fit_spectral(RIG, y, RATE).parameters
    for name, true in (("kL", KL), ("c", C)):
        p = found[f"{PLACE}.{name}"]
        assert abs((p.value or 0.0) - true) < 3 * (p.sd or 0.0)


def test_as_much_noise_of_the_force_sensor_is_said_with_what_it_does_to_the_damping() -> None:
    y = record(seed=3, noise=(0.02, float(np.sqrt(S / 8 * RATE / 2))))
    point = fit_all_effects(RIG, y, RATE).point
    assert search(RIG, point, y) == []
    found = spectral.fit_spectral(RIG, y, RATE)
    assert "force_noise" in [m.code for m in found.messages]
    c = found.parameters[f"{PLACE}.c"]
    assert c.value is not None
    assert c.sd is not None
    assert c.value / C - 1 == pytest.approx(1 / 8, abs=0.02)
    assert c.sd / c.value == pytest.approx(1 / 8, abs=0.02)


def test_a_gain_beside_a_force_that_is_not_measured() -> None:
    y = record(seed=3, unseen=unseen, sensor=sensor_with("sensor_gain", 0.05))
    first = search(RIG, fit_all_effects(RIG, y, RATE).point, y)[0]
    assert first.effect == "sensor_gain"
    error = first.settings[PLACE]["error"]
    assert abs((error.value or 0.0) - 0.05) < 4 * (error.sd or 0.0)


def test_what_a_cap_mass_hides_is_not_claimed() -> None:
    """Without a known mass the force gives the scale, and a sensor's gain is within it."""
    y = made("sensor_gain")
    free = replace(RIG, mass={})
    point = fit_all_effects(free, y, RATE).point
    assert point.data.mass[0] == pytest.approx(MASS / 1.05, rel=1e-3)
    assert search(free, point, y) == []


@pytest.mark.slow
def test_a_line_of_the_measured_force_is_no_finding() -> None:
    def tone(t: Array) -> Array:
        return 3.0 * np.cos(2 * np.pi * 743.21 * t)

    for sensor in (sensor_with("sensor_gain", 0.0), sensor_with("sensor_gain", 0.05)):
        y = record(seed=1, force=tone, sensor=sensor)
        assert "line" not in [s.effect for s in search(RIG, fit_all_effects(RIG, y, RATE).point, y)]


@pytest.mark.slow
def test_a_line_beside_the_measured_force_is_found_added_and_gone() -> None:
    def tone(t: Array) -> Array:
        return 0.05 * np.cos(2 * np.pi * 743.21 * t) + 0.08 * np.sin(2 * np.pi * 743.21 * t)

    y = record(seed=2, unseen=tone)
    ladder = improve(RIG, y, RATE)
    assert [list(r.effects) for r in ladder.rungs] == [[], ["line"]]
    assert ladder.last.verdict == "complete"
    for name, true in (("a", 0.05), ("b", 0.08), ("frequency", 743.21)):
        assert ladder.parameters[f"{PLACE}.line.{name}"].value == pytest.approx(true, rel=5e-3)
    before, after = (r.simulation_rmse["a"] for r in ladder.rungs)
    noise = heldout_rmse(RIG, record(seed=2), RATE)["a"]
    assert after - noise < 0.05 * (before - noise)


@pytest.mark.slow
@pytest.mark.parametrize("name", all_slow_but("sensor_gain"))
def test_improve_ends_with_what_was_hidden(name: str) -> None:
    ladder = improve(RIG, made(name), RATE)
    assert [list(r.effects) for r in ladder.rungs] == [[], [name]]
    assert ladder.last.verdict == "complete"
    assert ladder.rungs[1].heldout_nll < ladder.rungs[0].heldout_nll
    assert ladder.rungs[1].missing[0] == 0.0


@pytest.mark.slow
def test_where_only_one_force_is_measured_the_other_place_is_judged_as_without() -> None:
    """Bearing 1 is shaken with a force cell, bearing 2 is driven by what nobody measures, and coloured."""
    one = made("sensor_skew")
    white = record(seed=9)
    f = np.fft.rfftfreq(len(white), 1 / RATE)
    colour = np.sqrt(1 + 4.0 / (1 + (f / 900.0) ** 2))
    other = np.fft.irfft(np.fft.rfft(white[:, 0]) * colour, len(white))
    channels = (*RIG.channels, replace(RIG.channels[0], name="a2", node="bearing2"))
    both = replace(RIG, channels=channels, mass={"bearing1": MASS, "bearing2": MASS})
    y = np.column_stack([one, other])
    point = fit_all_effects(both, y, RATE).point
    found = {s.at: s.effect for s in reversed(search(both, point, y))}
    assert found == {("bearing1.x",): "sensor_skew", ("bearing2.x",): "coloured_excitation"}
    said = diagnose(both, np.column_stack([record(seed=4), white[:, 0]]), RATE)
    assert said.verdict == "complete"
    assert said.messages[-1].code == "force_measured"


@pytest.mark.parametrize("made", ["pedestal", "sensor_resonance"])
def test_what_only_bends_the_path_is_unknown(made: str) -> None:
    hidden = {"pedestal": (0.4, 2000.0, 0.05)} if made == "pedestal" else {"sensor": sensor_with(made, 9600.0, 10.0)}
    y = record(seed=3, **hidden)  # type: ignore[arg-type]
    (found,) = search(RIG, fit_all_effects(RIG, y, RATE).point, y)
    assert found.effect == "unknown"
    assert "does not follow the measured force" in found.region


def rippled() -> Array:
    """An acceleration through a cable with a rippled response: nothing of the catalogue."""
    y = record(seed=3)
    f = np.fft.rfftfreq(len(y), 1 / RATE)
    y[:, 0] = np.fft.irfft(np.fft.rfft(y[:, 0]) * (1 + 0.3 * np.sin(f / 150.0)), len(y))
    return y


@pytest.mark.slow
def test_a_path_that_is_biased_by_nothing_of_the_catalogue_is_unknown() -> None:
    y = rippled()
    assert [s.effect for s in search(RIG, fit_all_effects(RIG, y, RATE).point, y)] == ["unknown"]


@pytest.mark.slow
def test_a_path_that_is_biased_by_nothing_of_the_catalogue_is_not_called_complete() -> None:
    said = diagnose(RIG, rippled(), RATE)
    assert said.verdict == "unknown"
    assert any("does not follow the measured force" in m.text for m in said.messages)
