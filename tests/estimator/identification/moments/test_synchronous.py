from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference_samples import langevin

from estimator.identification.moments import fokker_planck, score_matching
from estimator.identification.moments.synchronous import (
    line_amplitude,
    stiffness_bias,
    synchronous_lines,
    synchronous_orders,
)
from estimator.model.rig import Channel, EffectUse, Model

RATE = 25600.0
HZ = 400.0  # a high-speed spindle, so that 1X lies in the band


@pytest.fixture(scope="module")
def random_part() -> tuple[np.ndarray, np.ndarray]:
    return langevin([0.2], [60.0], [1e7], [0.0], np.zeros((1, 1)), [4.5e-5], RATE, 20 * 25600, seed=21)


def rig(*effects: str) -> Model:
    channels = (Channel("b1x", "bearing1", "x", "displacement"),)
    used = tuple(EffectUse(e, {"bearing1.x": {}}) for e in effects)
    return Model(channels, (150.0, 8000.0), mass={"bearing1": 0.2}, speed_rpm=60.0 * HZ, effects=used)


def with_line(x: np.ndarray, factor: float) -> tuple[np.ndarray, float]:
    line = factor * float(np.std(x))
    return x + line * np.cos(2 * np.pi * HZ * np.arange(len(x)) / RATE + 0.7)[:, None], line


def test_line_is_removed_and_its_amplitude_known(random_part: tuple[np.ndarray, np.ndarray]) -> None:
    x = random_part[0]
    y, line = with_line(x, 1.5)
    assert line_amplitude(y, RATE, HZ)[0] == pytest.approx(line, rel=0.01)
    left = y - synchronous_lines(y, RATE, HZ, (1,))
    assert line_amplitude(left, RATE, HZ)[0] < 1e-9 * line + 1e-3 * np.std(x)
    assert np.var(left) == pytest.approx(np.var(x), rel=2e-3)


def test_gaps_do_not_stop_the_removal(random_part: tuple[np.ndarray, np.ndarray]) -> None:
    y, line = with_line(random_part[0][:60_000], 1.5)
    y[5000:9000] = np.nan
    left = y - synchronous_lines(y, RATE, HZ, (1,))
    good = np.isfinite(left[:, 0])
    assert good.sum() == 56_000
    assert np.std(left[good]) < 0.8 * np.std(y[good])


def test_bias_of_the_density_stiffness_is_the_formula(random_part: tuple[np.ndarray, np.ndarray]) -> None:
    """1X of 1.5 rms at 400 Hz pulls kL down by 45 %; with imbalance in the model the line is taken out."""
    y, line = with_line(random_part[0], 1.5)
    clean = score_matching.fit_score_matching(rig(), random_part[0], RATE, "density").parameters["bearing1.x.kL"].value
    biased = score_matching.fit_score_matching(rig(), y, RATE, "density")
    cured = score_matching.fit_score_matching(rig("imbalance"), y, RATE, "density").parameters["bearing1.x.kL"].value
    expected = stiffness_bias(line, float(np.std(random_part[0])), HZ, 1125.4)
    assert expected < -0.4
    assert biased.parameters["bearing1.x.kL"].value / clean - 1.0 == pytest.approx(expected, abs=0.02)
    assert cured == pytest.approx(clean, rel=5e-3)
    assert any(m.code == "shaft_line_biases_stiffness" for m in biased.messages)


def test_fokker_planck_with_imbalance_removed(random_part: tuple[np.ndarray, np.ndarray]) -> None:
    y, _ = with_line(random_part[0], 1.0)
    found = fokker_planck.fit_fokker_planck(rig("imbalance"), y, RATE, replicates=40)
    kL = found.parameters["bearing1.x.kL"]
    assert abs(kL.value - 1e7) < 4.0 * kL.sd
    assert not any(m.code == "effects_ignored" for m in found.messages)


def test_rolling_takes_the_line_out_too(random_part: tuple[np.ndarray, np.ndarray]) -> None:
    y, _ = with_line(random_part[0], 1.5)
    found = {}
    for effects in ((), ("imbalance",)):
        rolling = score_matching.RollingScoreMatching(rig(*effects), RATE, 10.0)
        rolling.update(y)
        found[effects] = rolling.snapshot().parameters["bearing1.x.kL"].value / 1e7 - 1.0
    assert found[()] < -0.4
    assert abs(found[("imbalance",)]) < 0.01


def test_orders_need_a_speed() -> None:
    assert synchronous_orders(rig("misalignment", "imbalance")) == (1, 2)
    assert synchronous_orders(replace(rig("imbalance"), speed_rpm=None)) == ()
    assert synchronous_orders(rig("cubic")) == ()
