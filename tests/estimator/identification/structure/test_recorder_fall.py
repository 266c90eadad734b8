"""What a recorder takes of every channel alike is told from a rotor's colour and from a sensor's resonance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, ROOT, coupled_on_a_stiff_shaft, one_bearing, record
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import optimize, signal

from daq.rig.rig import load_rig
from estimator.diagnosis.comparison.comparison import compare
from estimator.diagnosis.verdict.diagnose import diagnose
from estimator.diagnosis.verdict.improvement import improve
from estimator.identification.batch import spectral as spectral
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.batch.grid_start import fit_record
from estimator.identification.rolling.estimator import RollingEstimator
from estimator.identification.structure import recorder_fall
from estimator.likelihood.motion.prepare import prepare
from estimator.model import recorder as roll_off
from estimator.model.rig import EffectUse, Model, Setting
from estimator.results import Parameter
from estimator.signals.channel_response import channel_response, folded_images
from estimator.signals.filter_designs import designs
from estimator.simulation.simulator import simulate

TOP = 8000.0
OVERSAMPLED = 16 * RATE
Array = NDArray[np.float64]


def _sections(sos: Array, f_hz: Array) -> Array:
    return np.asarray(abs(signal.sosfreqz(sos, f_hz, fs=OVERSAMPLED)[1]) ** 2)


def power(recorder: str, f_hz: Array) -> Array:
    """|H|^2 by scipy of what recorders have before their samples."""
    if recorder == "mean of a sample":
        return np.sinc(f_hz / RATE) ** 2
    if recorder == "bessel":
        return _sections(signal.bessel(4, 0.45 * RATE, fs=OVERSAMPLED, output="sos", norm="mag"), f_hz)
    if recorder == "ripples":
        return _sections(signal.cheby1(5, 0.25, 0.38 * RATE, fs=OVERSAMPLED, output="sos"), f_hz)
    if recorder == "butterworth":
        return _sections(signal.butter(4, 0.4 * RATE, fs=OVERSAMPLED, output="sos"), f_hz)
    return _sections(signal.cheby2(11, 85, 0.5 * RATE, fs=OVERSAMPLED, output="sos"), f_hz)


RECORDERS = ("mean of a sample", "bessel", "butterworth", "chebyshev")


def through(y: Array, recorder: str) -> Array:
    """(n, channels) as the recorder hands them on, its phase left out."""
    f = np.fft.rfftfreq(len(y), 1 / RATE)
    return np.fft.irfft(np.fft.rfft(y, axis=0) * np.sqrt(power(recorder, f))[:, None], len(y), axis=0)


@pytest.mark.parametrize("recorder", RECORDERS)
def test_the_form_follows_the_filters_of_recorders(recorder: str) -> None:
    """Within 0.3 % of power where the band of the paper's rig lies."""
    f = np.linspace(150.0, TOP, 400)
    wanted = -np.log(power(recorder, f))
    found, _ = optimize.nnls((f[:, None] / TOP) ** roll_off.POWERS, wanted)
    assert abs(np.log(roll_off.gain(tuple(found), f, TOP)) + wanted).max() < 0.003


@given(st.lists(st.floats(0.0, 3.0), min_size=5, max_size=5))
def test_it_falls_from_one(found: list[float]) -> None:
    gain = roll_off.gain(tuple(found), np.linspace(0.0, TOP, 100), TOP)
    assert gain[0] == 1.0
    assert np.all(np.diff(gain) <= 0.0)


@pytest.mark.parametrize("kind", ["acceleration", "velocity", "displacement"])
@pytest.mark.parametrize("means", [1.0, 3.0])
def test_what_is_folded_back_is_what_decimation_folds(kind: str, means: float) -> None:
    """White acceleration, as a sensor of this kind has it, behind means over a sample of 64 samples each."""
    over, f = 64, np.linspace(0.05, 0.4, 8) * RATE
    whole, wanted = np.arange(-over // 2, over // 2), np.zeros(f.size)
    for k in whole:  # all that a sampled sinc lets through to f
        image = np.abs(f + k * RATE)
        dirichlet = np.sin(np.pi * image / RATE) / (over * np.sin(np.pi * image / RATE / over))
        wanted += np.abs(dirichlet) ** (2 * means) * (image / f) ** (2 * roll_off.POWER_OF_W[kind])
    off = roll_off.Filter(RATE, TOP, means)
    assert off.passed(f) + off.folded(f, kind) == pytest.approx(wanted, rel=0.02)


@pytest.mark.parametrize("name", designs())
def test_the_poles_are_those_of_scipy(name: str) -> None:
    design, _, order = name.replace(" filter of", "").split()
    made = signal.bessel if design == "Bessel" else signal.butter
    more = {"norm": "mag"} if design == "Bessel" else {}
    f = np.linspace(0.0, 4.0, 50)
    _, H = signal.freqs(*made(int(order), 1.0, analog=True, **more), f)
    assert roll_off.Filter(1.0, 1.0, poles=designs()[name]).passed(f) == pytest.approx(abs(H) ** 2, rel=1e-9)


def test_the_choice_of_a_filter_widens_the_psd_and_the_gain_of_a_colour() -> None:
    """S (1 + gain), the force low in the band, is what it is behind any filter."""
    found = {"b.x.S": Parameter(2.0, 0.008, "N^2/Hz"), "b.x.coloured_excitation.gain": Parameter(3.0, 0.0, "1"),
             "b.x.c": Parameter(1.0, 0.1, "N s/m"), "b.y.S": Parameter(2.0, 0.008, "N^2/Hz")}  # fmt: skip
    out = roll_off.doubted({"b.x": 0.003}, found)
    assert out["b.x.S"].sd == pytest.approx(0.01)
    assert out["b.x.coloured_excitation.gain"].sd == pytest.approx(0.012)
    assert all(out[name] == found[name] for name in ("b.x.c", "b.y.S"))
    assert roll_off.doubted({}, found) == found


def test_a_fit_behind_a_filter_has_the_force_of_the_rotor() -> None:
    """S was 5 % low, 30 standard deviations."""
    rig = replace(one_bearing(), effects=())
    y = simulate(rig, RATE, 10.0, seed=4, noise=0.02)
    fit = spectral.fit_spectral(rig, through(y, "butterworth"), RATE)
    truth = rig.linear["bearing1.x"]
    assert any("recorder's filter" in m.text for m in fit.messages)
    for name in ("kL", "c", "S"):
        p = fit.parameters[f"bearing1.x.{name}"]
        assert p.value == pytest.approx(truth[name].value, abs=4 * (p.sd or 0.0)), name
    assert not spectral.fit_spectral(rig, y, RATE).messages


def test_ripples_that_the_deviance_hardly_shows_are_the_recorders() -> None:
    """Of 0.25 dB: S was 2.6 to 3.7 % low at all places, 7 to 10 standard deviations, as no filter was looked for."""
    rig = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model
    y = through(simulate(rig, RATE, 6.0, seed=1, noise=0.02), "ripples")
    found = recorder_fall.find_roll_off(rig, fit_record(rig, prepare(rig, y, RATE)))
    assert found is not None
    f = np.linspace(150.0, TOP, 100)
    for own in found.values():
        np.testing.assert_allclose(own.passed(f), power("ripples", f), rtol=0.03)


def test_behind_one_recorder_the_places_without_a_colour_show_its_filter() -> None:
    """Of a colour of 8 and 900 Hz at bearing 1, behind a mean, 10.8 and 970 Hz were found, with another filter than at
    bearing 2 and S 26 % low."""
    rig = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model

    def coloured(gain: float, corner: float) -> Model:
        own = {p: {"gain": Setting(gain), "corner": Setting(corner)} for p in rig.places[:2]}
        return replace(rig, effects=(*rig.effects, EffectUse("coloured_excitation", own)))

    y = through(simulate(coloured(8.0, 900.0), RATE, 4.0, seed=1, noise=0.02), "butterworth")
    thought = coloured(10.8, 970.0)
    found = recorder_fall.find_roll_off(thought, fit_record(thought, prepare(thought, y, RATE)))
    assert found is not None
    assert set(found) == set(rig.places)
    f = np.linspace(150.0, TOP, 100)
    for own in found.values():
        np.testing.assert_allclose(own.passed(f), power("butterworth", f), rtol=0.03)


def test_pedestals_at_every_cap_do_not_hide_the_filter() -> None:
    """With their numbers of before it was found, it was one that takes a third of it at half the band, and folds
    nothing back. As scipy's sosfiltfilt and one sample of eight keep it."""
    rig = one_bearing()
    m, hz = rig.mass["bearing1"], 1500.0

    def on(mass: float, hz: float, damping: float) -> Model:
        own = {"mass": Setting(mass), "frequency": Setting(hz), "damping": Setting(damping)}
        return replace(rig, effects=(EffectUse("pedestal", dict.fromkeys(rig.places, own)),))

    sos = signal.bessel(3, 0.45 * RATE, fs=8 * RATE, norm="mag", output="sos")
    y = signal.sosfiltfilt(sos, simulate(on(0.5 * m, hz, 0.05), 8 * RATE, 4.0, seed=1), axis=0)[::8]
    thought = on(0.6 * m, 0.95 * hz, 0.06)
    found = recorder_fall.find_roll_off(thought, fit_record(thought, prepare(thought, y, RATE)))
    assert found is not None
    f = np.linspace(150.0, TOP, 100)
    wanted = abs(signal.sosfreqz(sos, f, fs=8 * RATE)[1]) ** 4
    for own in found.values():
        np.testing.assert_allclose(own.passed(f), wanted, rtol=0.03)


@pytest.mark.parametrize("recorder", ["", "bessel"])
def test_a_sensor_that_resonates_does_not_hide_the_filter_of_all(recorder: str) -> None:
    """Both sensors were called resonant; the other one alone, behind the filter, shows what the first has too."""
    rig = one_bearing()
    y = simulate(rig, RATE, 6.0, seed=3, noise=0.02)
    f = np.fft.rfftfreq(len(y), 1 / RATE)
    resonance = 1.0 / (1.0 - (f / 5600.0) ** 2 + 1j * f / 5600.0 / 5.0)
    y[:, 0] = np.fft.irfft(np.fft.rfft(y[:, 0]) * resonance, len(y))
    y = through(y, recorder) if recorder else y
    found = recorder_fall.find_roll_off(rig, fit_record(rig, prepare(rig, y, RATE)))
    assert (set(found) if found else set()) == (set(rig.places) if recorder else set())


def linear_behind(
    rig: Model, seconds: float, H: Array, resonance: tuple[float, float] | None = None,
    colour: tuple[float, float] = (0.0, 1.0),
) -> Array:  # fmt: skip
    """(n, channels) of a linear rig without a shaft, from the frequency domain. H : response of the recorder at the
    frequencies of `fine`; resonance : of the first sensor; colour : gain and corner of the forces."""
    rng, f = np.random.default_rng(5), fine(seconds)
    n, s = 2 * (f.size - 1), 2j * np.pi * f
    columns = []
    for k, place in enumerate(rig.places):
        kL, c, S = (rig.linear[place][name].value for name in ("kL", "c", "S"))
        force = np.fft.rfft(rng.normal(size=n) * np.sqrt(S * f[-1])) * np.sqrt(
            1 + colour[0] / (1 + (f / colour[1]) ** 2)
        )
        a = force * s**2 / ((rig.cap_mass(place) or 0.0) * s**2 + c * s + kL) * H
        if resonance and k == 0:
            a /= 1.0 - (f / resonance[0]) ** 2 + 1j * f / resonance[0] / resonance[1]
        columns.append(np.fft.irfft(a, n)[::FINER])
    y = np.stack(columns, axis=1)
    return np.asarray(y + 0.02 * rng.normal(size=y.shape))


FINER = 8


def fine(seconds: float) -> Array:
    return np.asarray(np.fft.rfftfreq(int(seconds * RATE) * FINER, 1 / (FINER * RATE)))


def test_what_is_folded_back_went_through_the_sensor_at_its_image() -> None:
    """Of a resonance at 0.55 of the rate, behind a mean over a sample of 64 samples each."""
    rig, over, f0, quality = one_bearing(), 64, 0.55 * RATE, 5.0
    sensor = EffectUse("sensor_resonance", {"bearing1.x": {"frequency": Setting(f0), "quality": Setting(quality)}})
    off = roll_off.Filter(RATE, TOP, means=1.0)
    model = replace(rig, effects=(sensor,), roll_off=dict.fromkeys(rig.places, off))
    f, whole = np.linspace(0.05, 0.3, 8) * RATE, np.arange(-over // 2, over // 2)
    wanted = np.zeros(f.size)
    for k in whole:
        image = np.abs(f + k * RATE)
        dirichlet = np.sin(np.pi * image / RATE) / (over * np.sin(np.pi * image / RATE / over))
        wanted += np.abs(dirichlet / (1.0 - (image / f0) ** 2 + 1j * image / f0 / quality)) ** 2
    found = 1.0 + folded_images(model, "bearing1.x", "acceleration", f).sum(axis=0)  # over what is not folded
    undone = np.abs(channel_response(model, "bearing1.x", 2 * np.pi * f)) ** 2
    assert found * undone == pytest.approx(wanted, rel=0.02)


def test_the_psd_is_in_doubt_by_a_mean_over_a_sample_that_is_not_seen() -> None:
    """Of a soft cap it looks like noise of the sensors: S was 1.7 % low, 4 standard deviations."""
    rig = replace(one_bearing(), effects=())
    rig = replace(rig, linear={place: {**own, "kL": Setting(3e6)} for place, own in rig.linear.items()})
    f = fine(10.0)
    behind = {name: fit_all_effects(rig, linear_behind(rig, 10.0, H), RATE)
              for name, H in {"mean": np.sinc(f / RATE), "none": (f < RATE / 2).astype(float)}.items()}  # fmt: skip
    for whole in behind.values():
        assert not whole.model.roll_off
        for place in rig.places:
            p = whole.parameters[f"{place}.S"]
            assert p.value == pytest.approx(rig.linear[place]["S"].value, abs=3 * (p.sd or 0.0))
    assert behind["mean"].S_sd_rel > 4 * behind["none"].S_sd_rel


@pytest.mark.slow
def test_what_a_resonant_sensor_shuts_out_is_not_folded_back() -> None:
    """It had as much folded back as the others: of resonances undone 0.6 % off a filter was not seen, 1.6 % of the
    force was missing and c 9 % low."""
    rig, true = replace(one_bearing(), effects=()), (5600.0, 12.0)
    y = linear_behind(rig, 12.0, np.sinc(fine(12.0) / RATE), true)
    sensor = EffectUse("sensor_resonance", {"bearing1.x": {}})
    whole = fit_all_effects(replace(rig, effects=(sensor,)), y, RATE)
    assert whole.model.roll_off is not None
    assert {round(off.means, 1) for off in whole.model.roll_off.values()} == {1.0}
    wanted = dict(zip(("sensor_resonance.frequency", "sensor_resonance.quality"), true, strict=True))
    wanted |= {name: rig.linear["bearing1.x"][name].value for name in ("kL", "c", "S")}
    for name, value in wanted.items():
        p = whole.parameters[f"bearing1.x.{name}"]
        assert p.value == pytest.approx(value, abs=4 * (p.sd or 0.0)), name


@pytest.mark.slow
@pytest.mark.parametrize("recorder", RECORDERS)
def test_a_complete_model_behind_a_filter_is_complete(recorder: str) -> None:
    rig = one_bearing()
    y = through(simulate(rig, RATE, 30.0, seed=5, noise=0.02), recorder)
    found = diagnose(rig, y, RATE)
    assert found.verdict == "complete"
    assert any("recorder's filter" in m.text for m in found.messages)


@pytest.mark.slow
@pytest.mark.parametrize("means", [1, 2])
def test_what_sampling_folds_back_is_no_colour_of_the_force(means: int) -> None:
    """Averaged over the sample by the recorder itself, not by a filter; in a band from a twentieth of the resonance the
    verdict was coloured_excitation."""
    rig, over = one_bearing(), 8
    rig = replace(rig, band=(60.0, TOP))
    fine = simulate(rig, over * RATE, 30.0, seed=9)
    for _ in range(means - 1):
        fine = np.stack([np.convolve(z, np.full(over, 1 / over), "same") for z in fine.T], axis=1)
    y = fine.reshape(-1, over, fine.shape[1]).mean(axis=1)
    found = diagnose(rig, y + 0.02 * np.random.default_rng(1).normal(size=y.shape), RATE)
    assert found.verdict == "complete"
    assert any(m.code == "recorder_folds" for m in found.messages)


def folding(rig: Model, seconds: float, sos: Array, over: int = 8) -> Array:
    """(n, channels) of a rig through a filter before the samples, with all that sampling folds back."""
    fine = simulate(rig, over * RATE, seconds, seed=9)
    y = signal.sosfilt(sos, fine, axis=0)[::over]
    return np.asarray(y + 0.02 * np.random.default_rng(1).normal(size=y.shape))


DESIGNS = {
    "bessel 6 at 0.45": signal.bessel(6, 0.45 * RATE, fs=8 * RATE, output="sos", norm="mag"),
    "bessel 4 at 0.3": signal.bessel(4, 0.3 * RATE, fs=8 * RATE, output="sos", norm="mag"),
    "butterworth 3 at 0.4": signal.butter(3, 0.4 * RATE, fs=8 * RATE, output="sos"),
    "butterworth 4 at 0.42": signal.butter(4, 0.42 * RATE, fs=8 * RATE, output="sos"),
}


@pytest.mark.slow
@pytest.mark.parametrize("design", DESIGNS)
def test_a_complete_model_behind_a_filter_that_folds_is_complete(design: str) -> None:
    """In a band from a ninth of the resonance, and S is that of the rotor."""
    rig = replace(one_bearing(), band=(120.0, TOP))
    whole = fit_all_effects(rig, y := folding(rig, 20.0, DESIGNS[design]), RATE)
    assert any("recorder's filter" in m.text for m in whole.messages)
    for place in rig.places:
        S = whole.parameters[f"{place}.S"]
        assert S.value == pytest.approx(rig.linear[place]["S"].value, abs=4 * (S.sd or 0.0)), place
    assert diagnose(rig, y, RATE).verdict == "complete"


@pytest.mark.slow
@pytest.mark.parametrize("order", [0, 6])
def test_the_colours_of_all_forces_do_not_hide_the_filter(order: int) -> None:
    """Less than half of its fall was found behind a Bessel filter, and the gain was 13.8, 12 standard deviations."""
    seconds, f = 40.0, fine(40.0)
    own = {"kL": Setting(5.2e6), "c": Setting(41.0), "S": Setting(8.5e-6)}
    rig = replace(one_bearing(), band=(97.0, TOP), effects=())
    rig = replace(rig, linear=dict.fromkeys(rig.places, own))
    b, a = signal.bessel(6, 0.45 * RATE, analog=True, norm="mag")
    H = signal.freqs(b, a, f)[1] if order else 1.0 * (f < RATE / 2)
    y = linear_behind(rig, seconds, H, colour=(12.0, 800.0))
    sought = {p: {"gain": Setting(), "corner": Setting()} for p in rig.places}
    whole = fit_all_effects(replace(rig, effects=(EffectUse("coloured_excitation", sought),)), y, RATE)
    assert bool(whole.model.roll_off) == bool(order)
    for place in rig.places:
        for name, value in (("gain", 12.0), ("corner", 800.0)):
            p = whole.parameters[f"{place}.coloured_excitation.{name}"]
            assert p.value == pytest.approx(value, abs=4 * (p.sd or 0.0)), name


@pytest.mark.slow
@pytest.mark.parametrize("shaft", ["chain", "beam"])
def test_noise_comes_through_a_stiff_shaft_and_is_no_force_of_the_other_bearing(shaft: str) -> None:
    """0.6 % of the bearing force was missing, as following the other bearing, and kL was 4 standard deviations off."""
    rig = replace(coupled_on_a_stiff_shaft(), effects=(), shaft=shaft, band=(120.0, TOP))
    found = compare(rig, folding(rig, 20.0, DESIGNS["bessel 6 at 0.45"]), RATE)
    assert found.missing[0] == 0.0
    for place in rig.places:
        kL = found.parameters[f"{place}.kL"]
        assert kL.value == pytest.approx(rig.linear[place]["kL"].value, abs=4 * (kL.sd or 0.0)), place


@pytest.mark.slow
def test_of_a_common_force_what_is_folded_back_is_common_too() -> None:
    """It passed for noise of the sensors: with one bearing four times as stiff as the other 0.27 % of the bearing force
    was missing, following the other bearing, and rho was 9 standard deviations low."""
    rig = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model
    stiffer = {p: {"kL": Setting(4.0 * (own["kL"].value or 0.0))} if "2" in p else {} for p, own in rig.linear.items()}
    linear = {p: {**own, **stiffer[p]} for p, own in rig.linear.items()}
    rig = replace(rig, band=(120.0, TOP), effects=(), linear=linear)
    common = EffectUse("correlated_force", {"bearing1.x": {"rho": Setting(0.4)}})
    y = folding(replace(rig, effects=(common,)), 20.0, DESIGNS["bessel 6 at 0.45"])
    whole = compare(replace(rig, effects=(EffectUse("correlated_force", {"bearing1.x": {}}),)), y, RATE)
    assert whole.missing[0] == 0.0
    rho = whole.parameters["bearing1.x.correlated_force.rho"]
    assert rho.value == pytest.approx(0.4, abs=4 * (rho.sd or 0.0))


@pytest.mark.slow
def test_an_effect_behind_a_filter_is_named() -> None:
    rig = one_bearing()
    found = diagnose(rig, through(record(rig, "clearance", 0.06, seconds=30.0), "bessel"), RATE)
    assert found.verdict == "clearance"
    assert any("recorder's filter" in m.text for m in found.messages)


@pytest.mark.slow
@pytest.mark.parametrize("recorder", ["mean of a sample", "bessel"])
def test_the_filter_is_sought_again_once_a_law_is_added(recorder: str) -> None:
    """What a missing law makes of the spectra had been taken for a filter and was kept: it was half too strong here,
    and a colour was named after it, with a law more, behind five means of half a sample."""
    rig = one_bearing()
    ladder = improve(rig, through(record(rig, "stiffness_drift", 0.2, seconds=20.0), recorder), RATE)
    assert [use.name for use in ladder.model.effects] == ["cubic", "stiffness_drift"]
    assert ladder.last.verdict == "complete"
    top = np.array([TOP])
    assert ladder.model.roll_off is not None
    for own in ladder.model.roll_off.values():
        assert 10 * np.log10(own.passed(top) / power(recorder, top)) == pytest.approx(0.0, abs=0.15)


@pytest.mark.slow
def test_lines_do_not_hide_the_filter() -> None:
    """They raised a few cells of the spectrum, and what fell was named a resonant sensor, behind the lines."""
    rig = one_bearing()
    y = simulate(rig, RATE, 30.0, seed=8, noise=0.02)
    t = np.arange(len(y)) / RATE
    y += sum(0.3 * y.std() * np.cos(2 * np.pi * hz * t + hz) for hz in (1450.0, 2900.0, 5210.0))[:, None] * [1.0, 0.8]
    found = diagnose(rig, through(y, "bessel"), RATE)
    assert found.verdict == "line"
    assert not {"sensor_resonance", "coloured_excitation"} & {e.effect for e in found.ranking if e.p_value < 0.01}
    assert any("recorder's filter" in m.text for m in found.messages)


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["coloured_excitation", "sensor_resonance", "pedestal", "bouc_wen", "coulomb"])
@pytest.mark.parametrize("strength", [0.02, 0.06])
def test_no_shape_of_a_rotor_passes_for_a_filter(effect: str, strength: float) -> None:
    rig = one_bearing()
    whole = fit_all_effects(rig, record(rig, effect, strength, seconds=30.0), RATE)
    assert not recorder_fall.find_roll_off(whole.model, whole.point)
    assert not whole.model.roll_off


@pytest.mark.slow
def test_as_it_rolls_the_force_is_that_of_the_rotor() -> None:
    """c was 5 and S 30 standard deviations low."""
    rig = one_bearing()
    rolling = RollingEstimator(rig, RATE, 10.0)
    for part in np.array_split(through(simulate(rig, RATE, 20.0, seed=7, noise=0.02), "bessel"), 80):
        rolling.update(part)
    estimate = rolling.snapshot()
    for place in rig.places:
        for name in ("kL", "c", "S"):
            p = estimate.parameters[f"{place}.{name}"]
            assert p.value == pytest.approx(rig.linear[place][name].value, abs=4 * (p.sd or 0.0)), (place, name)


@pytest.mark.slow
def test_one_channel_that_falls_is_its_sensor() -> None:
    rig = one_bearing()
    y = simulate(rig, RATE, 30.0, seed=6, noise=0.02)
    y[:, 0] = through(y[:, :1], "bessel")[:, 0]
    found = diagnose(rig, y, RATE)
    assert found.verdict in ("sensor_resonance", "coloured_excitation")
    assert found.ranking[0].at == ("bearing1",) or "bearing1.x" in found.ranking[0].at


def two_devices(seconds: float, one: str, two: str = "") -> tuple[Model, Array]:
    """The paper's rig, the channels of each bearing behind a filter of its own."""
    rig = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model
    y = simulate(rig, RATE, seconds, seed=2, noise=0.02)
    for recorder, own in ((one, slice(0, 2)), (two, slice(2, 4))):
        y[:, own] = through(y[:, own], recorder) if recorder else y[:, own]
    return rig, y


def test_each_bearing_may_have_a_recorder_of_its_own() -> None:
    """One fall for all left S 45 standard deviations low at the bearing behind the filter."""
    rig, y = two_devices(4.0, "bessel")
    whole = fit_all_effects(rig, y, RATE)
    assert whole.model.roll_off is not None
    assert set(whole.model.roll_off) == {"bearing1.x", "bearing1.y"}
    assert [(m.code, m.place) for m in whole.messages] == [("recorder_rolls_off", "bearing1")]
    for place in rig.places:
        S = whole.parameters[f"{place}.S"]
        assert S.value == pytest.approx(rig.linear[place]["S"].value, abs=4 * (S.sd or 0.0)), place


@pytest.mark.parametrize("two", ["", "bessel"])
def test_a_bearing_whose_own_spectra_do_not_tell_has_the_filter_of_the_other_if_that_explains_them(two: str) -> None:
    """As beside a late sensor on a stiff shaft: each channel of the other bearing was called resonant."""
    rig, y = two_devices(4.0, "bessel", two)
    point = fit_record(rig, prepare(rig, y, RATE))
    first, second = (recorder_fall.measured_cells(point, at) for at in ([0, 1], [2, 3]))
    _, off = recorder_fall.common_fall(point, first, 0.5)
    assert off is not None
    before = -2 * sum(fit[0] for _, _, fit in second)
    assert recorder_fall.explains_half(point, off, second, before) == bool(two)


@pytest.mark.slow
@pytest.mark.parametrize("two", ["", "butterworth"])
def test_a_complete_model_behind_two_recorders_is_complete(two: str) -> None:
    found = diagnose(*two_devices(20.0, "bessel", two), RATE)
    assert found.verdict == "complete"


@pytest.mark.slow
def test_one_channel_that_falls_at_one_of_two_bearings_is_its_sensor() -> None:
    rig, y = two_devices(20.0, "")
    y[:, 0] = through(y[:, :1], "bessel")[:, 0]
    whole = fit_all_effects(rig, y, RATE)
    assert whole.model.roll_off is None
