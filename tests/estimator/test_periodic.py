"""Periodic forces of a model: their series, and their numbers from what is left of the force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing
from numpy.typing import NDArray

from estimator.model import EffectUse, Model, Setting
from estimator.motion_blocks import MotionBlocks
from estimator.periodic import PIECES, known_lines, periodic_of, refined, series
from estimator.preparation import prepare
from estimator.simulate import simulate

LINE = {"a": 0.12, "b": -0.05, "frequency": 791.37}
DEFECT = {"strike": 1.5, "order": 2.1, "angle": 0.7, "width": 0.05}


def with_use(model: Model, name: str, values: dict[str, float], place: str = "bearing1.x") -> Model:
    use = EffectUse(name, {place: {k: Setting(v) for k, v in values.items()}})
    return replace(model, effects=(*model.effects, use))


@pytest.fixture(scope="module")
def rig() -> Model:
    return one_bearing()


@pytest.fixture(scope="module")
def data(rig: Model) -> MotionBlocks:
    return prepare(rig, simulate(rig, RATE, 6.0, seed=5, noise=0.02, full_scale=490.5), RATE)


def series_of(model: Model, data: MotionBlocks) -> NDArray[np.float64]:
    out = series(model, data.places, data.t, data.phase, data.rate_hz, data.band)
    assert out is not None
    return out


def test_a_line_is_what_its_law_says(rig: Model, data: MotionBlocks) -> None:
    turn = 2 * np.pi * LINE["frequency"] * data.t
    F = series_of(with_use(rig, "line", LINE), data)
    np.testing.assert_allclose(F[0], LINE["a"] * np.cos(turn) + LINE["b"] * np.sin(turn), atol=1e-4)
    assert not F[1].any()


def test_a_train_of_strikes_has_the_harmonics_of_its_fourier_series(rig: Model) -> None:
    """2 / (2 pi) strike width / (1 + i k width) exp(-i k angle), where exp(-2 pi / width) is nothing."""
    (one,) = periodic_of(with_use(rig, "local_defect", DEFECT))
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


def test_what_lies_outside_of_the_band_adds_nothing(rig: Model, data: MotionBlocks) -> None:
    slow = with_use(rig, "misalignment", {"a": 1.0, "b": 1.0})  # 70 Hz
    assert series(slow, data.places, data.t, data.phase, data.rate_hz, data.band) is None
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
    rig: Model, data: MotionBlocks, name: str, values: dict[str, float], off: dict[str, float]
) -> None:
    """White noise and the difference of two forces: after some steps the truth lies within its intervals."""
    rig = replace(rig, speed_rpm=6000.0) if name == "misalignment" else rig
    speed = 2 * np.pi * (rig.speed_rpm or 0.0) / 60
    data = replace(data, speed=speed, phase=speed * data.t)
    truth = with_use(rig, name, values)
    S = np.array([9e-5, 9e-5])
    noise = np.random.default_rng(1).normal(size=data.x.shape) * np.sqrt(S[:, None] * RATE / 2)
    model = with_use(rig, name, {k: v + off[k] for k, v in values.items()})
    for _ in range(4):
        force = noise + series_of(truth, data) - series_of(model, data)
        model, found = refined(model, data, force, S)
    for key, value in values.items():
        p = found[f"bearing1.x.{name}.{key}"]
        assert p.identifiable
        assert abs((p.value or 0.0) - value) < 4 * (p.sd or 0.0), key
    if name != "local_defect":  # of a line's amplitude everything is known: sd^2 = S / T
        assert found[f"bearing1.x.{name}.a"].sd == pytest.approx((9e-5 / (data.t.size / RATE)) ** 0.5, rel=2 / PIECES)


def test_what_is_fixed_stays(rig: Model, data: MotionBlocks) -> None:
    use = EffectUse("line", {"bearing1.x": {k: Setting(v, fixed=k == "frequency") for k, v in LINE.items()}})
    model, found = refined(replace(rig, effects=(use,)), data, np.ones_like(data.x), np.ones(2))
    assert model.effects[0].parameters["bearing1.x"]["frequency"].value == LINE["frequency"]
    assert found["bearing1.x.line.frequency"].sd == 0.0
    given = EffectUse("line", {"bearing1.x": {k: Setting(v, fixed=True) for k, v in LINE.items()}})
    assert not refined(replace(rig, effects=(given,)), data, np.ones_like(data.x), np.ones(2))[1]
