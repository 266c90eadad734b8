"""Beside a measured force: a pedestal or a faulty sensor bends the path from force to motion; a periodic force that is
not in the channel stands in what it leaves. Checked on records made in the frequency domain, not by our simulator."""

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
from estimator.identification.search import search
from estimator.identification.structure import transfer_bias, transfer_faults
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.fitting.transfer_function import (
    fit_linear_path,
    linear_tangent,
    path_spectra_of,
    residual_power,
)
from estimator.likelihood.motion.prepare import prepare
from estimator.model.rig import EffectUse, Model

Array = NDArray[np.float64]
Sensor = Callable[[Array], Array]
PLACE = "bearing1.x"


def heard(name: str, *p: float) -> Sensor:
    """The catalogue's own sensor effect."""
    apply = CATALOGUE[name].apply
    assert apply is not None
    return lambda y: np.asarray(apply(y, RATE, p, np.random.default_rng(0)))


HIDDEN = {
    "pedestal": (0.4, 2000.0, 0.05),
    "sensor_gain": (0.05,),
    "sensor_skew": (0.3 / RATE,),
    "sensor_resonance": (9600.0, 10.0),
}


def made(name: str, seed: int = 3) -> Array:
    p = HIDDEN[name]
    return record(seed=seed, pedestal=p) if name == "pedestal" else record(seed=seed, sensor=heard(name, *p))  # type: ignore[arg-type]


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


def test_stiffness_and_damping_by_the_path_alone() -> None:
    """From a point 0.2 % off in both: the truth within its standard deviations, and noise is all that is left."""
    y = record(seed=5, noise=(0.1, 0.003))
    point = fit_model(prepare(RIG, y, RATE), [])
    w, part = 2 * np.pi * point.data.f_hz, 0.002
    bent = point.A - part * (KL / w**2 + 1j * C / w)[:, None, None]
    off = replace(point, force=point.force + part * (KL * point.data.x + C * point.data.v), A=bent)
    r = path_spectra_of(off, 0)
    peak, _ = fit_linear_path(off, 0, r)
    sd = np.sqrt(np.diag(peak.covariance))
    k, c = point.kL[0] + part * KL + peak.u[2], point.c[0] + part * C + peak.u[3]
    assert abs(k - KL) < 3 * sd[2]
    assert abs(c - C) < 3 * sd[3]
    assert sd[2] < 2e-5 * KL
    for u, rms, spread in zip(peak.u, (0.003, 0.1), sd, strict=False):
        assert abs(u - np.log(rms**2 / (RATE / 2))) < 3 * spread < 0.2
    assert np.array_equal(residual_power(r, r.A), r.rr)
    assert np.array_equal(linear_tangent(r, np.zeros(2)), r.A)


@pytest.mark.parametrize("seed", range(4))
def test_a_complete_model_has_no_suspect(seed: int) -> None:
    noise = [(0.02, 1e-3), (0.3, 1e-3), (0.02, 0.03), (2.0, 0.1)][seed]
    y = record(seed=seed, noise=noise)
    assert search(RIG, fit_all_effects(RIG, y, RATE).point, y) == []


def test_a_gain_that_no_calibration_would_show_is_not_claimed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The steps of a simulation make one of 0.04 %, which beside much damping is a force worth a name."""
    monkeypatch.setattr(transfer_faults, "NEGLIGIBLE_FORCE_SHARE", 1e-4)
    for error, claimed in ((1.5e-3, False), (3e-3, True)):
        y = record(seed=3, sensor=heard("sensor_gain", error))
        found = search(RIG, fit_all_effects(RIG, y, RATE).point, y)
        assert [s.effect for s in found][:1] == ["sensor_gain"] * claimed


def unseen(t: Array) -> Array:
    """An eighth of the power of the measured force."""
    return np.random.default_rng(17).normal(size=t.size) * np.sqrt(S / 8 * RATE / 2)


def test_a_force_beside_the_measured_one_is_no_fault_of_a_sensor() -> None:
    """A machine runs beside the shaker. Read as noise of the force sensor it looked like a gain of 12 %, and c came out
    11 % too small by `fit`."""
    y = record(seed=3, unseen=unseen)
    whole = fit_all_effects(RIG, y, RATE)
    assert search(RIG, whole.point, y) == []
    assert transfer_faults.has_unmeasured_force(RIG, whole.point)
    found = spectral.fit_spectral(RIG, y, RATE).parameters
    for name, true in (("kL", KL), ("c", C)):
        p = found[f"{PLACE}.{name}"]
        assert abs((p.value or 0.0) - true) < 3 * (p.sd or 0.0)


def test_as_much_noise_of_the_force_sensor_is_told_from_it() -> None:
    y = record(seed=3, noise=(0.02, float(np.sqrt(S / 8 * RATE / 2))))
    point = fit_all_effects(RIG, y, RATE).point
    assert search(RIG, point, y) == []
    assert not transfer_faults.has_unmeasured_force(RIG, point)


def test_a_gain_beside_a_force_that_is_not_measured() -> None:
    y = record(seed=3, unseen=unseen, sensor=heard("sensor_gain", 0.05))
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

    for sensor in (heard("sensor_gain", 0.0), heard("sensor_gain", 0.05)):
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


def test_the_notes_say_what_else_would_look_the_same() -> None:
    assert "cap mass" in transfer_faults.EFFECT_NOTES["sensor_gain"]
    assert "force channel" in transfer_faults.EFFECT_NOTES["sensor_skew"]


@pytest.mark.slow
def test_twice_the_nats_of_an_idle_cause_are_chi_square_whatever_the_noise() -> None:
    """Of 40 complete records. Before noise of the force channel was counted, a gain won hundreds of nats in it."""
    rng = np.random.default_rng(1)
    won: dict[str, list[float]] = {}
    for seed in range(40):
        noise = (10 ** rng.uniform(-1.0, 0.3), 10 ** rng.uniform(-2.0, -0.5))
        point = fit_model(prepare(RIG, record(seed=seed, noise=noise), RATE), [])
        r = path_spectra_of(point, 0)
        base, scale = fit_linear_path(point, 0, r)
        for cause in transfer_bias.transfer_causes(point, 0, {}):
            starts = [np.array(z) for z in cause.starts]
            nats = transfer_bias.fit_cause(point, 0, r, cause, base, scale, starts).nats - base.nats
            won.setdefault(cause.effect, []).append(2 * nats)
    for name in ("sensor_gain", "sensor_skew"):
        assert 0.4 < np.mean(won[name]) < 1.8
        assert np.mean(np.array(won[name]) > 6.63) < 0.08  # 1 % expected
    for name in won:
        assert np.max(won[name]) < 25.0


@pytest.mark.slow
def test_a_heavy_pedestal_at_the_resonance_is_fitted() -> None:
    """It takes a third of the stiffness with it: from that of the rest of the model the first step went astray."""
    true = (1.0, 1006.0, 0.016)
    y = record(pedestal=true, noise=(0.3, 0.01))
    fit = spectral.fit_spectral(given("pedestal"), y, RATE).parameters
    for name, value in zip(("mass", "frequency", "damping"), true, strict=True):
        p = fit[f"{PLACE}.pedestal.{name}"]
        assert abs((p.value or 0.0) - value) < 4 * (p.sd or 0.0) + 1e-3 * value, (name, p)
    assert fit[f"{PLACE}.kL"].value == pytest.approx(KL, rel=1e-3)


def rippled() -> Array:
    """An acceleration through a cable with a rippled response: nothing of the catalogue."""
    y = record(seed=3)
    f = np.fft.rfftfreq(len(y), 1 / RATE)
    y[:, 0] = np.fft.irfft(np.fft.rfft(y[:, 0]) * (1 + 0.3 * np.sin(f / 150.0)), len(y))
    return y


@pytest.mark.slow
def test_a_path_that_is_bent_by_nothing_of_the_catalogue_is_unknown() -> None:
    y = rippled()
    assert [s.effect for s in search(RIG, fit_all_effects(RIG, y, RATE).point, y)] == ["unknown"]


@pytest.mark.slow
def test_a_path_that_is_bent_by_nothing_of_the_catalogue_is_not_called_complete() -> None:
    said = diagnose(RIG, rippled(), RATE)
    assert said.verdict == "unknown"
    assert any("does not follow the measured force" in m.text for m in said.messages)


def test_noise_of_the_force_and_a_force_beside_it_are_told_in_their_shares() -> None:
    """In power, of the measured force. With either of both alone to choose from c was 6 % high."""
    noise, beside, rms, rng = 0.05, 0.1, np.sqrt(S * RATE / 2), np.random.default_rng(5)
    y = record(4.0, 4, noise=(0.02, rms * np.sqrt(noise)),
               unseen=lambda t: rms * np.sqrt(beside) * rng.normal(size=t.size))  # fmt: skip
    point = fit_all_effects(RIG, y, RATE).point
    found = transfer_faults.likeliest_reading(RIG, point, 0, path_spectra_of(point, 0))
    assert found.response.unmeasured == pytest.approx(beside / (noise + beside), abs=0.05)
    assert point.c[0] + found.base.u[3] == pytest.approx(C, abs=4 * float(np.sqrt(found.base.covariance[3, 3])))
    assert transfer_faults.find_transfer_faults(RIG, point) == []
