"""What laws see beside the noise of sensors."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from reference_rig import CLEARANCE, GAP, PLACES, rig_model, rig_record
from reference_rig import RATE as RIG_RATE
from reference_samples import langevin

from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.rolling.estimator import RollingEstimator
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.prepare import motion_record
from estimator.model.rig import Channel, EffectUse, Model, Setting
from estimator.results import Parameter
from estimator.simulation.simulator import simulate

RATE = 1000.0


def oscillator(seconds: float, seed: int) -> np.ndarray:
    """(n,) m, a resonance of 50 Hz and 3 % of damping, rms 0.3."""
    w, one = 2 * np.pi * 50.0, np.ones(1)
    x, _ = langevin(one, 0.06 * w * one, w**2 * one, 0 * one, np.zeros((1, 1)), 0.12 * w**3 * one, RATE,
                    int(seconds * RATE), seed)  # fmt: skip
    return np.asarray(0.3 * x[:, 0] / x.std())


def measured_by(kind: str, x: np.ndarray) -> np.ndarray:
    """x as a sensor of this kind has it."""
    iw = 2j * np.pi * np.fft.rfftfreq(x.size, 1 / RATE)
    return np.fft.irfft(np.fft.rfft(x) * iw ** ("displacement", "velocity", "acceleration").index(kind), x.size)


@pytest.mark.parametrize("kind", ["velocity", "acceleration"])
def test_the_error_is_as_said_and_independent_of_what_is_seen(kind: str) -> None:
    rng, x = np.random.default_rng(1), oscillator(60.0, 1)
    model = Model((Channel("d", "bearing1", "x", kind),), (10.0, 300.0), "none", {"bearing1": 1.0})
    measured = measured_by(kind, x)
    y = measured + 0.3 * measured.std() * rng.normal(size=x.size)
    data, truth = (
        fit_model(motion_record(model, y[:, None], RATE), []).data,
        motion_record(model, measured[:, None], RATE),
    )
    off = truth.x[0] - data.denoised_displacement(0)
    assert off.std() < 0.8 * (truth.x[0] - data.x[0]).std()
    assert np.asarray(data.denoise_sd)[0, 0] == pytest.approx(off.std(), rel=0.15)
    assert abs(np.corrcoef(off, data.denoised_displacement(0))[0, 1]) < 0.03


@pytest.mark.parametrize(("kind", "share"), [("acceleration", 0.001), ("displacement", 0.1)])
def test_little_noise_and_that_of_displacement_sensors_leave_the_motion_as_it_is(kind: str, share: float) -> None:
    model = Model((Channel("d", "bearing1", "x", kind),), (20.0, 300.0), "none", {"bearing1": 1.0})
    x = oscillator(20.0, 2)
    y = measured_by(kind, x)
    y = y + share * y.std() * np.random.default_rng(2).normal(size=x.size)
    data = fit_model(motion_record(model, y[:, None], RATE), []).data
    assert data.denoise_correction is None
    assert np.array_equal(data.denoised_displacement(0), data.displacement(0))


def noisy(seed: int, **hidden: float) -> np.ndarray:
    """20 s of the RK4 rig, 5 % of white noise in its accelerometers, band from 150 Hz, a seventh of the resonance."""
    columns = np.zeros((4, 7))
    columns[:, CLEARANCE], columns[:, GAP] = hidden.get("k", 0.0), hidden.get("gap", 1.0)
    y = rig_record(20.0, 700 + seed, hidden=columns, noise=0.0)
    return y + 0.05 * y.std(axis=0) * np.random.default_rng(seed).normal(size=y.shape)


def mean_of(found: Mapping[str, Parameter], name: str) -> float:
    return float(np.mean([found[f"{p}.{name}"].value for p in PLACES]))  # type: ignore[arg-type]


@pytest.mark.slow
def test_noisy_accelerometers_leave_a_clearance_as_it_is() -> None:
    """Its stiffness was 29 % low with intervals of 6 %."""
    compared = []
    for seed in range(2):
        y, model = noisy(seed, k=1.5e6, gap=1.9e-7), rig_model("cubic", "clearance")
        compared.append(mean_of(fit_all_effects(model, y, RIG_RATE).parameters, "clearance.k"))
    assert np.mean(compared) == pytest.approx(1.5e6, rel=3.0 * 0.08 / np.sqrt(8))


@pytest.mark.slow
def test_and_a_cubic_as_it_rolls() -> None:
    """It was 16 % low."""
    found = []
    for seed in range(3):
        rolling = RollingEstimator(rig_model("cubic"), RIG_RATE, 1e5, watch=())
        for part in np.split(noisy(seed), np.arange(2560, 20 * int(RIG_RATE), 2560)):
            rolling.update(part)
        found.append(mean_of(rolling.snapshot().parameters, "cubic.kNL"))
    assert np.mean(found) == pytest.approx(1.3e18, rel=3.0 * 0.08 / np.sqrt(12))


def test_beside_a_measured_force_laws_see_the_denoised_displacement() -> None:
    """Along the noisy one, with noise of 1 % of the displacement in power, kNL was 2 % too small."""
    place, channels = PLACES[0], (Channel("a", "bearing1", "x"), Channel("f", "bearing1", "x", "force"))
    numbers = {"kL": 1e7, "c": 60.0, "S": 9e-5}, {"kNL": 3e18}
    linear, law = ({place: {name: Setting(z) for name, z in own.items()}} for own in numbers)
    blank = Model(channels, (60.0, 8000.0), "none", {"bearing1": 0.2}, effects=(EffectUse("cubic", {place: {}}),))
    y = simulate(replace(blank, linear=linear, effects=(EffectUse("cubic", law),)), RIG_RATE, 20.0, seed=5)
    noise = np.random.default_rng(0).normal(size=y.shape) * np.array([0.05, 0.002])
    whole = fit_all_effects(blank, y + noise, RIG_RATE)
    assert whole.point.data.denoise_correction is not None
    for name, truth in (("kL", 1e7), ("c", 60.0), ("cubic.kNL", 3e18)):
        assert whole.parameters[f"{place}.{name}"].value == pytest.approx(truth, rel=3e-3)
