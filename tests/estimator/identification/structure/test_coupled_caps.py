"""Gains and delays of sensors beside a stiff shaft: exact linear records, solved frequency by frequency here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, ROOT
from numpy.typing import NDArray

from daq.rig.rig import load_rig
from estimator.diagnosis.verdict.improvement import improve
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.finding import Finding
from estimator.identification.structure import coupled_caps
from estimator.model.rig import EffectUse, Model, Setting
from estimator.simulation.simulator import simulate

Array = NDArray[np.float64]
STIFF = 10e6  # N/m, of half the shaft: as much as a bearing's
SECONDS = 6.0


@pytest.fixture
def rig() -> Model:
    """The x direction of the paper's rig, linear, on a stiff shaft."""
    rig = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model
    channels = tuple(c for c in rig.channels if c.direction == "x")
    return replace(rig, channels=channels, effects=(), shaft_stiffness=STIFF)


def record(rig: Model, gain: float = 1.0, late_s: float = 0.0) -> Array:
    """(n, 2) accelerations of caps and disc as three masses under white forces; the first channel wrong."""
    n = int(SECONDS * RATE)
    f = np.fft.rfftfreq(n, 1 / RATE)
    w = 2 * np.pi * f[1:]
    rng = np.random.default_rng(5)
    own = [rig.linear[f"bearing{k}.x"] for k in (1, 2)]
    m1, m2, m3 = (rig.mass[name] for name in ("bearing1", "bearing2", "disc"))
    kc = rig.shaft_stiffness + 1j * w * rig.shaft_damping
    D = np.zeros((w.size, 3, 3), complex)
    for i, (mass, p) in enumerate(zip((m1, m2), own, strict=True)):
        D[:, i, i] = (p["kL"].value or 0.0) + 1j * w * (p["c"].value or 0.0) - mass * w**2 + kc
        D[:, i, 2] = D[:, 2, i] = -kc
    D[:, 2, 2] = 2 * kc - m3 * w**2
    F = np.zeros((w.size, 3, 1), complex)
    for i, p in enumerate(own):
        F[:, i, 0] = np.sqrt((p["S"].value or 0.0) * n * RATE / 4) * (rng.normal(size=(2, w.size)).T @ [1, 1j])
    A = np.zeros((f.size, 2), complex)
    A[1:] = -(w[:, None] ** 2) * np.linalg.solve(D, F)[:, :2, 0]
    A[:, 0] *= gain * np.exp(-2j * np.pi * f * late_s)
    y: Array = np.fft.irfft(A, n, axis=0)
    return y + rng.normal(scale=0.02, size=y.shape)


def found(rig: Model, y: Array) -> list[Finding]:
    whole = fit_all_effects(rig, y, RATE)
    return coupled_caps.find_coupled_sensor_faults(whole.model, whole.point)


@pytest.mark.parametrize(("gain", "samples"), [(1.1, 0.0), (0.9, 0.0), (1.0, 0.5)])
def test_a_faulty_sensor_is_found_with_its_number(rig: Model, gain: float, samples: float) -> None:
    (one,) = found(rig, record(rig, gain, samples / RATE))
    name, true = ("sensor_skew", samples / RATE) if samples else ("sensor_gain", gain - 1.0)
    assert one.effect == name
    ((place, settings),) = one.settings.items()
    ((_, number),) = settings.items()
    if place == "bearing2.x":  # the other one of the two, by the inverse
        true = -true if samples else 1.0 / (1.0 + true) - 1.0
    assert number.value == pytest.approx(true, abs=4 * (number.sd or 0.0))
    assert 0.0 < (number.sd or 0.0) < 0.1 * abs(true)


def test_another_shaft_or_cap_than_the_rig_files_is_no_sensor(rig: Model) -> None:
    y = record(rig)
    assert found(rig, y) == []
    assert found(replace(rig, shaft_stiffness=1.03 * STIFF), y) == []
    assert found(replace(rig, mass={**rig.mass, "bearing1": 1.05 * rig.mass["bearing1"]}), y) == []


def test_a_soft_shaft_tells_nothing(rig: Model) -> None:
    soft = replace(rig, shaft_stiffness=155e3)
    assert found(soft, record(soft, 1.2)) == []


def test_the_number_is_fitted_unless_it_is_fixed(rig: Model) -> None:
    y = record(rig, gain=1.1)

    def with_gain(setting: Setting) -> Model:
        return replace(rig, effects=(EffectUse("sensor_gain", {"bearing1.x": {"error": setting}}),))

    free = fit_all_effects(with_gain(Setting()), y, RATE)
    number = free.disturbances["bearing1.x.sensor_gain.error"]
    assert number.value == pytest.approx(0.1, abs=4 * (number.sd or 0.0))
    kL = free.parameters["bearing2.x.kL"]
    assert kL.value == pytest.approx(rig.linear["bearing2.x"]["kL"].value, abs=4 * (kL.sd or 0.0))
    kept = fit_all_effects(with_gain(Setting(0.08, fixed=True)), y, RATE).disturbances["bearing1.x.sensor_gain.error"]
    assert (kept.value, kept.sd) == (0.08, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize(("effect", "values"), [("sensor_gain", {"error": 0.05}), ("sensor_skew", {"delay": 1.2e-5})])
def test_no_law_is_named_for_a_faulty_sensor(effect: str, values: dict[str, float]) -> None:
    """Bouc-Wen laws were, with 145 and 5415 nats."""
    rig = replace(load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model, shaft_stiffness=STIFF)
    wrong = EffectUse(effect, {"bearing1.x": {n: Setting(v) for n, v in values.items()}})
    y = simulate(replace(rig, effects=(*rig.effects, wrong)), RATE, 30.0, seed=7, noise=0.02, full_scale=490.5)
    ladder = improve(rig, y, RATE)
    assert [use.name for use in ladder.model.effects] == ["cubic", effect]
    assert ladder.rungs[-1].missing[0] == 0.0


def test_a_delay_beyond_the_next_sample_is_fitted(rig: Model) -> None:
    """By which the caps seem to drive the shaft: a fit that begins there ended at 2.74 samples."""
    stiff = replace(rig, shaft_stiffness=3 * STIFF)
    late = 3.0 / RATE
    y = record(stiff, late_s=late)
    with_delay = replace(stiff, effects=(EffectUse("sensor_skew", {"bearing1.x": {"delay": Setting()}}),))
    number = fit_all_effects(with_delay, y, RATE).disturbances["bearing1.x.sensor_skew.delay"]
    assert number.value == pytest.approx(late, abs=4 * (number.sd or 0.0))
