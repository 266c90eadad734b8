"""Shapes of the inferred force's spectrum that sensors and filters make."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, coupled_on_a_stiff_shaft, one_bearing
from scipy.signal import bilinear, butter, iirpeak, lfilter

from estimator.diagnosis.comparison.survey import survey_bearing
from estimator.diagnosis.verdict.diagnose import diagnose
from estimator.diagnosis.verdict.improvement import improve
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.batch.grid_start import fit_record
from estimator.identification.residual.missing_force import survey
from estimator.identification.structure import spectral_models, spectral_shape
from estimator.likelihood.motion.prepare import prepare
from estimator.model.rig import Channel, EffectUse, Model, Setting
from estimator.results import NOT_CONCLUSIVE
from estimator.simulation.simulator import simulate


def test_a_shared_force_is_seen_in_every_part_of_the_band_and_a_wrong_structure_is_not() -> None:
    """Two equal caps without a shaft: a share of the motion of one in that of the other is a share of its force."""
    cap = {"kL": Setting(2e6), "c": Setting(60.0), "S": Setting(1e-4)}
    caps = (Channel("b1x", "bearing1", "x"), Channel("b2x", "bearing2", "x"))
    rig = Model(
        caps, band=(100.0, 2000.0), mass={"bearing1": 0.2, "bearing2": 0.2},
        linear={"bearing1.x": cap, "bearing2.x": cap},
    )  # fmt: skip
    one, two = simulate(rig, 5120.0, 6.0, seed=2, noise=0.0).T
    part = lfilter(*butter(2, (300.0, 600.0), "bandpass", fs=5120.0), one)
    lost = {}
    for name, own in (("shared", two + 0.15 * one), ("in a part", two + 0.4 * part)):
        point = fit_record(rig, prepare(rig, np.stack([one, own], axis=1), 5120.0))
        found = next(s for s in spectral_shape.find_spectral_shapes(rig, point) if s.effect == "correlated_force")
        lost[name] = sum(nats < 0.0 for nats in found.folds)
    assert lost["shared"] == 0
    assert lost["in a part"] > 1


def test_a_fall_without_a_peak_may_be_an_anti_alias_filter() -> None:
    """A filter of one channel that falls within the band is found as a resonant sensor; so much is said."""
    rig = replace(one_bearing(), effects=())
    y = simulate(rig, RATE, 6.0, seed=0, noise=0.0)
    said = {}
    filtered = np.stack([lfilter(*butter(3, 8500.0, fs=RATE), y[:, 0]), y[:, 1]], axis=1)
    for name, seen in (("whole", y), ("filtered", filtered)):
        whole = fit_all_effects(rig, seen, RATE)
        found = [s for s in spectral_shape.find_spectral_shapes(rig, whole.point) if s.effect == "sensor_resonance"]
        said[name] = [s.note for s in found]
    assert not any(said["whole"])
    assert any("anti-alias filter" in note for note in said["filtered"])


@pytest.mark.parametrize(("hz", "quality", "height"), [(2800.0, 2.0, 2.0), (1200.0, 2.0, 1.0), (2000.0, 0.5, 1.0)])
def test_a_force_with_a_peak_is_a_background_and_no_effect(hz: float, quality: float, height: float) -> None:
    rig = replace(one_bearing(), effects=())
    y = simulate(rig, RATE, 6.0, seed=0, noise=0.0)
    peaked = y[:, 0] + height * lfilter(*iirpeak(hz, quality, fs=RATE), y[:, 0])
    found = diagnose(rig, np.stack([peaked, y[:, 1]], axis=1), RATE)
    assert found.verdict == "unknown"  # six seconds beside a background do not show every effect
    assert NOT_CONCLUSIVE in [m.code for m in found.messages]
    assert any(m.code == "force_spectrum" and "bearing1.x" in m.text for m in found.messages)


@pytest.mark.slow
def test_a_colour_beside_noise_of_its_sensor_is_named_and_then_the_noise() -> None:
    """What noise of that sensor left of the spectrum was held against the colour: "unknown"."""
    rig = replace(one_bearing(), effects=())
    y = simulate(rig, RATE, 5.0, seed=0, noise=0.0)
    w = 2 * np.pi * 2500.0  # force of gain 4 beside the white one: a power of (5 + u^2) / (1 + u^2)
    coloured = lfilter(*bilinear([1.0, w * np.sqrt(5.0)], [1.0, w], RATE), y[:, 0])
    y = np.stack([coloured, y[:, 1]], axis=1)
    y += y.std(axis=0) * np.array([0.05, 0.001]) * np.random.default_rng(2).standard_normal(y.shape)
    improved = improve(rig, y, RATE)
    found = improved.diagnoses[0]
    assert found.verdict == "coloured_excitation"
    assert any(note.code == "sensor_noise_too" for note in found.ranking[0].notes)
    assert improved.rungs[-1].effects == ("coloured_excitation", "sensor_noise")


@pytest.mark.slow  # ten seconds: the stiff shaft beside the case of one cap above
def test_a_force_with_a_peak_on_a_stiff_shaft_is_unknown_and_no_law() -> None:
    """A pedestal whose bearing has a negative damping explained most of it; whitened as white it passed for what
    follows the other cap. Filtered is the motion by one force alone, as the rotor is linear."""
    rig = replace(coupled_on_a_stiff_shaft(), effects=())
    alone = {p: own if p == "bearing1.x" else own | {"S": Setting(1e-14)} for p, own in rig.linear.items()}
    one = simulate(replace(rig, linear=alone), RATE, 12.0, seed=1, noise=0.0)
    y = simulate(rig, RATE, 12.0, seed=0, noise=0.0) + 1.7 * lfilter(*iirpeak(2400.0, 2.0, fs=RATE), one, axis=0)
    found = diagnose(replace(rig, linear={}), y, RATE)
    assert found.verdict == "unknown"
    assert any(m.code == "force_spectrum" and "bearing1.x" in m.text for m in found.messages)


@pytest.mark.slow
def test_a_law_that_bends_the_spectrum_goes_before_a_background() -> None:
    """A rotor that whirls has a peak in the force that a model without what drives it infers. Weighed by that spectrum
    the law gained a third of the nats; at both bearings of the paper's rig it was 6 % off, 20 standard deviations."""
    rig = one_bearing()
    k = 6.0e5  # N/m; c times the resonance is 4.2e5, and the cubic holds what grows
    truth = replace(
        rig,
        effects=(
            *rig.effects,
            EffectUse("cross_coupling", {"bearing1": {"k": Setting(k)}}),
        ),
    )
    whole = fit_all_effects(rig, y := simulate(truth, RATE, 5.0, seed=3, noise=0.0), RATE)
    entries = survey_bearing(whole.model, whole.point, y)[0].ranking.entries
    assert entries[0].effect == "cross_coupling"


def test_the_force_inferred_by_a_wrong_stiffness_beside_caps_that_answer() -> None:
    """Against the whole of the rotor's matrices: one place has another stiffness than is thought, all are coupled."""
    rng = np.random.default_rng(1)
    f, P, i = 40, 4, 2
    thought = 4.0 * np.eye(P) + rng.normal(size=(f, P, P)) + 1j * rng.normal(size=(f, P, P))
    delta, S = rng.normal(size=f) + 1j * rng.normal(size=f), rng.uniform(1.0, 2.0, P)
    true = thought.copy()
    true[:, i, i] += delta
    inferred = thought @ np.linalg.inv(true)
    A, others = spectral_models.with_others_answering(thought, S, i)
    one = np.ones(f)
    c = spectral_models.SpectralCells(
        power=one,
        n=one,
        w=one,
        A=A,
        force_shape=one,
        noise_gain=0.0 * one,
        others=others,
    )
    found = c.spectrum(np.array([np.log(S[i]), 0.0, 0.0, 0.0]), A + delta)
    np.testing.assert_allclose(found, np.abs(inferred[:, i]) ** 2 @ S, rtol=1e-9)


def test_noise_of_the_sensors_comes_through_a_stiff_shaft_too() -> None:
    """Noise of 2 % of the motion, a complete model: seen as if each cap had its own noise alone, the spectra were 46 to
    55 standard deviations of their deviance off."""
    rig = replace(coupled_on_a_stiff_shaft(), effects=())
    point = fit_record(rig, prepare(rig, simulate(rig, RATE, 6.0, seed=4, noise=0.3), RATE))
    for i in range(4):
        c = spectral_models.cells_of(point, i)
        df = c.n.size - 4
        assert abs(-2 * spectral_models.fit_base_model(point, i, c)[0] - df) < 4.0 * np.sqrt(2 * df)


@pytest.mark.slow
def test_modes_of_all_caps_beside_a_stiff_shaft_are_found_together() -> None:
    """Without what the other caps answer one of them was found, with numbers that led its fit astray."""
    rig = replace(coupled_on_a_stiff_shaft(), effects=())
    own = {
        p: {"mass": Setting(0.6), "frequency": Setting(hz), "damping": Setting(0.095)}
        for p, hz in zip(rig.places, (1300.0, 1200.0, 1100.0, 1240.0), strict=True)
    }
    y = simulate(replace(rig, effects=(EffectUse("pedestal", own),)), RATE, 20.0, seed=4, noise=0.0)
    whole = fit_all_effects(replace(rig, linear={}), y, RATE)
    assert whole.model.background is not None
    for place, settings in own.items():
        (mode,) = whole.model.background.at[place].modes
        assert mode.frequency_hz == pytest.approx(settings["frequency"].value, rel=0.005)
        kL = whole.parameters[f"{place}.kL"]
        assert kL.value == pytest.approx(rig.linear[place]["kL"].value, abs=4 * kL.sd)
    ladder = improve(replace(rig, linear={}), y, RATE)
    assert ladder.rungs[-1].effects == ()
    assert ladder.last.verdict == "complete"


@pytest.mark.slow
def test_a_pedestal_is_found_where_it_does_not_stand_out_by_itself() -> None:
    """The pedestal of the other direction is plain. This one gains many nats, but is lost in the many cells."""
    rig = one_bearing()
    f0 = np.sqrt(1e7 / 0.2) / (2 * np.pi)
    own = {
        p: {"mass": Setting(0.4), "frequency": Setting(factor * f0), "damping": Setting(0.05)}
        for p, factor in (("bearing1.x", 1.7), ("bearing1.y", 2.6))
    }
    y = simulate(replace(rig, effects=(*rig.effects, EffectUse("pedestal", own))), RATE, 8.0, seed=2, noise=0.02)
    found = {s.at[0]: s for s in spectral_shape.find_spectral_shapes(rig, fit_all_effects(rig, y, RATE).point)}
    assert {s.effect for s in found.values()} == {"pedestal"}
    assert set(found) == {"bearing1.x", "bearing1.y"}
    frequency = found["bearing1.y"].settings["bearing1.y"]["frequency"]
    assert frequency.value == pytest.approx(2.6 * f0, rel=0.03)


def test_one_noisy_sensor_beside_a_stiff_shaft_is_found() -> None:
    """Its noise comes into the force at the other cap too, and was spread over both sensors."""
    rig = coupled_on_a_stiff_shaft()
    noise = EffectUse("sensor_noise", {"bearing1.x": {"rms": Setting(0.4)}})
    y = simulate(replace(rig, effects=(*rig.effects, noise)), RATE, 8.0, seed=7, noise=0.02, full_scale=490.5)
    whole = fit_all_effects(rig, y, RATE)
    (one,) = [s for s in spectral_shape.find_spectral_shapes(whole.model, whole.point) if s.p_value < 1e-3]
    assert (one.effect, one.at) == ("sensor_noise", ("bearing1.x",))
    rms = one.settings["bearing1.x"]["rms"]
    assert rms.value == pytest.approx(0.4, rel=0.05)


def test_a_resonance_is_undone_in_what_the_other_cap_answers() -> None:
    """Two caps on a chain half as stiff as their bearings, bin by bin; left in, its phase made c 12 % wrong."""
    rng = np.random.default_rng(2)
    n, m, disc, k, c, ks, S = round(8.0 * RATE), 0.25, 0.5, 2.5e7, 100.0, 1.2e7, 1e-4
    f = np.fft.rfftfreq(n, 1 / RATE)[1:]
    w2, iw = (2 * np.pi * f) ** 2, 2j * np.pi * f
    bearing, shaft = k + iw * c, ks + iw * 2.0
    D = np.zeros((f.size, 3, 3), complex)
    D[:, [0, 1], [0, 1]] = (bearing + shaft - m * w2)[:, None]
    D[:, 2, 2] = 2 * shaft - disc * w2
    for i in range(2):
        D[:, i, 2] = D[:, 2, i] = -shaft
    F = np.fft.rfft(rng.normal(size=(2, n)) * np.sqrt(S * RATE / 2))[:, 1:]
    a = -w2 * np.linalg.solve(D, np.stack([*F, 0 * f], axis=1)[:, :, None])[:, :2, 0].T
    a[0] /= 1 - (f / 5600.0) ** 2 + 0.2j * f / 5600.0
    y = np.fft.irfft(np.pad(a, ((0, 0), (1, 0))), n).T
    y += 1e-3 * y.std(axis=0) * rng.normal(size=y.shape)
    rig = Model(
        (Channel("b1", "bearing1", "x"), Channel("b2", "bearing2", "x")), (100.0, 8000.0), "chain",
        {"bearing1": m, "bearing2": m, "disc": disc}, shaft_stiffness=ks, shaft_damping=2.0,
        effects=(EffectUse("sensor_resonance", {"bearing1.x": {}}),),
    )  # fmt: skip
    whole = fit_all_effects(rig, y, RATE)
    for name, true in (("kL", k), ("c", c)):
        for place in rig.places:
            p = whole.parameters[f"{place}.{name}"]
            assert p.value == pytest.approx(true, abs=3.5 * (p.sd or 0.0)), (place, name)
    assert not survey(whole.point, whole.model).any_found()


def test_noise_that_only_the_cause_shows_is_found_beside_it() -> None:
    """Without the resonance no noise was seen, and from none the search did not leave: the quality was 8 standard
    deviations low."""
    place, true = "bearing1.x", {"frequency": 5600.0, "quality": 5.0}
    known = {"kL": Setting(5.3e7), "c": Setting(126.0), "S": Setting(4.4e-3)}
    rig = one_bearing()
    rig = replace(
        rig, channels=rig.channels[:1], band=(220.0, 8000.0), mass={"bearing1": 0.45}, linear={place: known}, effects=()
    )
    y = simulate(rig, RATE, 8.0, seed=3, noise=0.0)
    r = np.fft.rfftfreq(len(y), 1 / RATE) / true["frequency"]
    y[:, 0] = np.fft.irfft(np.fft.rfft(y[:, 0]) / (1.0 - r**2 + 1j * r / true["quality"]), len(y))
    y += 0.5 * np.random.default_rng(1).normal(size=y.shape)
    found = spectral_shape.find_spectral_shapes(rig, fit_record(rig, prepare(rig, y, RATE)))
    (own,) = (s for s in found if s.effect == "sensor_resonance")
    for name, value in true.items():
        p = own.settings[place][name]
        assert p.value == pytest.approx(value, abs=4 * (p.sd or 0.0)), name
