"""Comparison: held-out numbers, missing force with its interval, the map and the pictures' data."""

from __future__ import annotations

import json

import jsonschema
import numpy as np
import pytest
from hidden_effects import RATE, one_bearing, record, schema

from estimator.diagnosis.comparison.comparison import compare
from estimator.identification.record.clipping import clipping_level
from estimator.likelihood.whitening.determinant import Jacobian
from estimator.model.rig import Model
from estimator.simulation.simulator import simulate


@pytest.fixture(scope="module")
def rig() -> Model:
    return one_bearing()


def test_complete_model_leaves_nothing(rig: Model) -> None:
    y = simulate(rig, RATE, 10.0, seed=8, noise=0.02, full_scale=490.5)
    steps: list[float] = []
    c = compare(rig, y, RATE, progress=lambda fraction, text: steps.append(fraction))
    value = c.to_json()
    jsonschema.validate(value, schema("compare"))
    json.dumps(value, allow_nan=False)
    assert c.adequate
    assert c.missing[1] == 0.0
    assert c.missing[0] < 0.3
    assert c.where == ()
    assert c.reference_nll <= c.heldout_nll
    assert c.heldout_nll - c.reference_nll < 1e-3
    assert steps == sorted(steps)
    assert steps[-1] == 1.0
    assert max(c.pdf_distance.values()) < 0.05
    assert max(c.psd_distance_db.values()) < 2.0


@pytest.mark.slow
def test_of_a_short_record_it_is_said_that_little_is_seen_in_it(rig: Model) -> None:
    y = simulate(rig, RATE, 2.0, seed=8, noise=0.02, full_scale=490.5)
    assert any(m.code == "record_short" for m in compare(rig, y, RATE).messages)


def test_the_map_points_at_the_state_and_the_curve_shows_the_law(rig: Model) -> None:
    c = compare(rig, record(rig, "quadratic", 0.06), RATE)
    assert not c.adequate
    assert {w.against for w in c.where} == {"displacement"}
    assert sum(w.share_percent for w in c.where) == pytest.approx(100.0)
    assert c.missing[1] > 1.0
    assert c.reference_nll < c.heldout_nll
    curve = next(k for k in c.curves if k.against == "displacement" and k.channel == "b1x")
    inside = np.abs(curve.at) < 2.5 * np.median(np.abs(curve.at))
    even = np.polyfit(curve.at[inside], curve.force[inside], 2)[0]
    assert even > 0  # kq x^2 on the restoring side


def test_jacobian_derivatives_agree_with_differences() -> None:
    rng = np.random.default_rng(0)
    A0 = np.eye(2) * 0.2 + 0.05 * (rng.standard_normal((30, 2, 2)) + 1j * rng.standard_normal((30, 2, 2)))
    tangents = 0.02 * (rng.standard_normal((3, 2, 2, 30)) + 1j * rng.standard_normal((3, 2, 2, 30)))
    J = Jacobian(A0)
    delta = np.array([0.1, -0.2, 0.05])
    gradient, second = J.derivatives(tangents, delta)
    h = 1e-5
    for k in range(3):
        e = np.eye(3)[k] * h
        assert gradient[k] == pytest.approx(
            (J.value(tangents, delta + e) - J.value(tangents, delta - e)) / (2 * h), rel=1e-5, abs=1e-6
        )
        up, down = J.derivatives(tangents, delta + e)[0], J.derivatives(tangents, delta - e)[0]
        np.testing.assert_allclose(second[k], (up - down) / (2 * h), rtol=1e-4, atol=1e-4)


def test_clipping_is_seen_in_the_raw_samples_and_a_gaussian_is_not_clipped() -> None:
    y = np.random.default_rng(1).standard_normal(100_000)
    assert clipping_level(y) is None
    found = clipping_level(np.clip(y, -2.5, 2.5) + 0.002 * np.random.default_rng(2).standard_normal(y.size))
    assert found is not None
    assert found[0] == pytest.approx(2.5, rel=0.01)


@pytest.mark.parametrize("step", [1e-4, 0.01, 0.25])
def test_a_converters_full_scale_is_seen_in_a_few_samples_and_its_steps_are_none(step: float) -> None:
    """0.02 % of a record at one value made S 10 % too large, without a word; a log marks them, other files do not."""
    y = np.round(np.random.default_rng(1).standard_normal(400_000) / step) * step
    assert clipping_level(y) is None
    if step < 0.1:  # a coarser step has as many samples beside the limit as at it
        top = float(np.quantile(np.abs(y), 0.9998))
        found = clipping_level(np.clip(y, -top, top))
        assert found is not None
        assert found[0] == top
        assert 60 < found[1] < 400


@pytest.mark.slow
def test_a_comparison_says_that_a_channel_is_clipped(rig: Model) -> None:
    y = simulate(rig, RATE, 5.0, seed=8, noise=0.02, full_scale=490.5)
    top = float(np.quantile(np.abs(y[:, 0]), 0.9995))
    found = compare(rig, np.clip(y, -top, top), RATE)
    assert "b1x is clipped at" in " ".join(m.text for m in found.messages)
    assert "b1x is clipped" in found.parameters["bearing1.x.kL"].reason
