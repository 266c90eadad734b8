"""Forces that remember: along a path and linearised about it, their mean response, and that of the motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing, record

from estimator.effects import CATALOGUE
from estimator.effects.engine.memory_loop import force_along_path, memory_array
from estimator.effects.engine.strength import size, strengths, with_effect
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.likelihood.motion.memory_law import memory_force_and_response
from estimator.likelihood.path.working_point import point_on_part
from estimator.model.rig import EffectUse
from estimator.simulation.simulator import simulate

BOUC_WEN = CATALOGUE["bouc_wen"]
LIN = np.array([0.2, 1e7, 60.0])
Array = np.ndarray


def path(seconds: float = 4.0, low: float = 150.0, high: float = 8000.0, seed: int = 0) -> tuple[Array, Array]:
    """Displacement of rms 1 and velocity of a mass on a spring under white noise, in a band."""
    n = int(seconds * RATE)
    w = 2 * np.pi * np.fft.rfftfreq(n, 1 / RATE)
    z = np.random.default_rng(seed).normal(size=(2, w.size))
    X = (z[0] + 1j * z[1]) / (7000.0**2 - w**2 + 300j * w)
    X[(w < 2 * np.pi * low) | (w > 2 * np.pi * high)] = 0.0
    x = np.fft.irfft(X, n)
    return x / x.std(), np.fft.irfft(1j * w * X, n) / x.std()


def test_a_branch_that_never_slips_is_a_spring_at_every_frequency() -> None:
    x, v = path(1.0)
    f, mean = memory_force_and_response(BOUC_WEN, np.array([2.0, 1e6]), LIN, x, v, RATE)
    F, X = np.fft.rfft(f - 2.0 * (x - x[0])), np.fft.rfft(x)
    hz = np.fft.rfftfreq(x.size, 1 / RATE)
    for low, high in ((300, 2000), (2000, 5000), (5000, 7900)):  # straight lines between samples: 16 % off at the top
        band = (hz > low) & (hz < high)
        assert np.linalg.norm(F[band]) < 0.01 * 2.0 * np.linalg.norm(X[band])
    assert np.abs(mean.at(np.array([200.0, 1100.0, 7000.0])) - 2.0).max() < 1e-3


@pytest.mark.parametrize("slip", [0.02, 0.3])
def test_a_branch_that_slips_at_once_is_friction(slip: float) -> None:
    """However fast the state follows, the force stays within k slip."""
    x, v = path(1.0)
    f = memory_array(BOUC_WEN, np.array([1.0, slip]), LIN, 4 * x, 4 * v, RATE)
    assert np.abs(f).max() < 1.001 * slip
    assert np.mean(f * np.sign(v)) > 0.5 * slip


def test_mean_response_is_that_to_a_random_probe() -> None:
    x, v = path(8.0)
    p = np.array([1.0, 1.0])
    f, mean = memory_force_and_response(BOUC_WEN, p, LIN, x, v, RATE)
    hz = np.fft.rfftfreq(x.size, 1 / RATE)
    cross, power = np.zeros(hz.size, complex), np.zeros(hz.size)
    for seed in range(1, 7):
        dx, dv = (0.02 * z for z in path(8.0, seed=seed))
        moved, _ = memory_force_and_response(BOUC_WEN, p, LIN, x + dx, v + dv, RATE)
        F, X = np.fft.rfft(moved - f), np.fft.rfft(dx)
        cross, power = cross + F * X.conj(), power + np.abs(X) ** 2
    for low, high in ((400, 900), (900, 1200), (1200, 2500)):
        band = (hz > low) & (hz < high)
        expected = (mean.at(hz[band]) * power[band]).sum() / power[band].sum()
        assert abs(cross[band].sum() / power[band].sum() - expected) < 0.02


def test_mean_response_hardly_depends_on_the_stretch_of_path() -> None:
    """The likelihood sees 1 %: with a step every 31 cycles k scattered by another standard deviation."""
    hz = np.array([160.0, 600.0, 1100.0, 3000.0, 7900.0])
    found = [
        memory_force_and_response(BOUC_WEN, np.array([1.0, 1.0]), LIN, *path(16.0, seed=s), RATE)[1].at(hz)
        for s in (1, 2, 3)
    ]
    mean = np.mean(found, axis=0)
    assert np.abs(np.array(found) - mean).max() < 0.004
    assert abs(mean[-1] - mean[-1].real) < 0.1 * mean[-1].real  # at once it is a spring


@pytest.mark.parametrize("name", ["bouc_wen", "pedestal"])
def test_what_is_linearised_is_the_derivative_along_the_path(name: str) -> None:
    effect = CATALOGUE[name]
    p = np.array([2.0, 0.3]) if name == "bouc_wen" else np.array([0.4, 900.0, 0.02])
    x, v = path(0.05)
    dx, dv = (1e-5 * z for z in path(0.05, seed=1))
    rest, dt = np.zeros(effect.states), 1.0 / RATE
    f, _, about = force_along_path(effect, p, LIN, x, v, dt, rest)
    assert about is not None
    states, moved = rest, []
    for k in range(x.size):
        moved.append(about.force[k] @ [*states, dx[k], dv[k]])
        if k + 1 < x.size:
            states = about.step[k] @ [*states, 0.5 * (dx[k] + dx[k + 1]), dx[k + 1] - dx[k]]
    expected = force_along_path(effect, p, LIN, x + dx, v + dv, dt, rest, about=False)[0] - f
    assert np.linalg.norm(moved - expected) < 2e-3 * np.linalg.norm(expected)


@pytest.mark.slow
def test_hysteresis_is_fitted_from_nothing() -> None:
    """Undressed and on straight lines between the samples, k and slip came out 20 % too small."""
    rig = one_bearing()
    y = record(rig, "bouc_wen", 0.06, seed=3, seconds=20.0)
    model = replace(rig, effects=(*rig.effects, EffectUse("bouc_wen", {p: {} for p in rig.places})))
    found = fit_all_effects(model, y, RATE).parameters
    true = strengths(BOUC_WEN, size(rig, "bearing1.x", RATE), 0.06, rig, 20.0)
    for place in rig.places:
        for name, value in true.items():
            parameter = found[f"{place}.bouc_wen.{name}"]
            assert parameter.value is not None
            assert parameter.sd is not None
            assert abs(parameter.value - value) < 3.0 * parameter.sd
            assert parameter.sd < 0.2 * value


@pytest.mark.slow
def test_part_of_a_record_has_the_response_of_the_values_it_is_at() -> None:
    """After a step of the fit: the response per unit of k changes by what the column of slip says.

    With that from before the step, force and determinant did not balance: at 1 % of damping (60 s, another simulator)
    a fifth of a standard deviation seemed to win 9 nats, and what goes with the level another 27: 0.6 % missing.
    """
    rig = one_bearing()
    at = size(rig, "bearing1.x", RATE)
    y = simulate(with_effect(rig, BOUC_WEN, {"k": 0.05 * at.kL, "slip": 3.0 * at.x}, "bearing1.x"), RATE, 10.0, seed=3)
    model = replace(rig, effects=(*rig.effects, EffectUse("bouc_wen", {"bearing1.x": {}})))
    point = fit_all_effects(model, y, RATE).point
    law = next(u for u in point.placed if u.effect is BOUC_WEN)
    moved = law.with_values(law.p * np.array([1.0, 1.1]))
    after = replace(point, placed=tuple(moved if u is law else u for u in point.placed))
    responses = [{t.name: t.memory.get(0) for t in point_on_part(one, 6.0).regressors} for one in (point, after)]
    k, slip = law.name(0), law.name(1)
    changed = responses[1][k] - responses[0][k]
    expected = 0.1 * law.p[1] / law.p[0] * 0.5 * (responses[0][slip] + responses[1][slip])
    assert np.linalg.norm(changed - expected) < 0.2 * np.linalg.norm(expected)
