"""The other simulator against exact results, its laws against the product's, and what the product finds there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from estimator.effects import CATALOGUE
from estimator.effects.engine.law_loop import force_array

from .clean import run
from .hidden import FORMS, PARAMETERS
from .motion import LAWS, Law, Rotor, motion, push
from .record import Case

KNOWN = [name for name in LAWS if name in CATALOGUE and name not in FORMS and CATALOGUE[name].kind == "force"]
NUMBERS = {
    "clearance": (2.0, 0.4), "stop": (2.0, -0.3), "hertz": (2.0, 0.5, 6.0), "ball_pass": (1.0, 0.5, 2.1),
    "stiffness_drift": (0.3, 0.1), "local_defect": (1.5, 2.1, 0.7, 0.05), "rub": (2.0, 0.4, 0.6),
}  # fmt: skip


def even(t: np.ndarray, white: np.ndarray) -> np.ndarray:
    return white


def test_every_law_that_both_have_is_the_same() -> None:
    rng = np.random.default_rng(0)
    x, v, xo, vo = rng.normal(size=(4, 200))
    t, turn = rng.uniform(0.0, 3.0, 200), 30.0
    for name in KNOWN:
        p = NUMBERS.get(name, (2.0,))
        assert len(p) == len(PARAMETERS[name].split())
        theirs = np.array([*p, *np.zeros(5 - len(p))])
        made = [push(LAWS.index(name), theirs, *q, 0.0) for (*q,) in zip(x, v, xo, t, turn * t, strict=True)]
        ours = force_array(CATALOGUE[name], np.array(p), x, v, xo, vo, t, turn * t)
        assert np.allclose(made, ours, rtol=1e-9, atol=1e-12), name


def test_the_linear_rotor_moves_as_theory_says() -> None:
    shaft = 3e6 * np.array([[1.0, 0, -1], [0, 1, -1], [-1, -1, 2]])
    M, C, K = np.diag([0.2, 0.25, 0.8]), np.diag([120.0, 150.0, 20.0]), np.diag([6e6, 8e6, 0.0]) + shaft
    rotor = Rotor(M, C, K, np.array([1e-4, 2e-4, 0.0]), 0.0)
    rate = 102_400.0
    chunks = [z[1:] for z in motion(rotor, even, rate, 20.0, np.random.default_rng(1))]
    x, v, a = (np.concatenate(z) for z in zip(*(z[:3] for z in chunks), strict=True))
    P = rotor.covariance()
    # the disc has some hundred independent swings
    assert np.var(np.hstack([x, v]), axis=0) == pytest.approx(np.diag(P), rel=0.1)
    f, found = signal.welch(a[:, 0], rate, nperseg=8192)
    w = 2 * np.pi * f
    G = np.linalg.inv(K + 1j * w[:, None, None] * C - w[:, None, None] ** 2 * M)
    exact = w**4 * (np.abs(G[:, 0]) ** 2 @ rotor.S)
    band = (f > 300.0) & (f < 8000.0)
    assert np.mean(found[band] / exact[band]) == pytest.approx(1.0, abs=0.01)


def test_a_cubic_has_the_density_of_boltzmann() -> None:
    m, c, k, S, rate = 0.2, 250.0, 8e6, 1e-4, 204_800.0
    T = S / (4 * c)
    kNL = 0.3 * k * k / T
    one = (np.array([[q]]) for q in (m, c, k))
    rotor = Rotor(*one, np.array([S]), 0.0, [Law(name="cubic", along=np.ones(1), across=np.ones(1), numbers=(kNL,))])
    x = np.concatenate([z[1][:, 0] for z in motion(rotor, even, rate, 30.0, np.random.default_rng(2))])
    at = np.linspace(-6, 6, 4001) * np.sqrt(T / k)
    p = np.exp(-(k * at**2 / 2 + kNL * at**4 / 4) / T)
    for power in (2, 4):
        assert np.mean(x**power) == pytest.approx(float((p @ at**power) / p.sum()), rel=0.02)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    "case",
    [
        Case({"clearance": "bearing1"}, "strong", 1, 20.0),
        Case({"quadratic": "bearing1"}, "strong", 0, 30.0),  # on a shaft stiffer than the bearing
        Case({"bouc_wen": "bearing1"}, "strong", 1, 30.0),  # the disc rings long
        Case({"crack": "bearing1"}, "strong", 101, 20.0),
        Case({"crack": "bearing1"}, "strong", 93, 20.0, varied=True),
        Case({}, "-", 2, 20.0),
    ],
    ids=lambda case: case.key,
)
def test_what_was_hidden_is_found(case: Case, tmp_path: Path) -> None:
    found = run(case, tmp_path)
    assert found["verdict"] == "complete"
    assert found["added"] == list(case.hidden)
    assert found["percent"][-1] < 0.3
    assert max(abs(z) for z in found["off"].values()) < 4.5


@pytest.mark.slow
def test_half_sine_strikes_are_a_local_defect(tmp_path: Path) -> None:
    found = run(Case({"half_sine_strikes": "bearing1"}, "strong", 3, 30.0), tmp_path)
    assert found["added"][:1] == [FORMS["half_sine_strikes"]]
    assert found["percent"][1] < 0.4 * found["percent"][0]


@pytest.mark.slow
def test_smooth_friction_is_named_with_its_nearest_law(tmp_path: Path) -> None:
    """Its step takes a tenth to a third of the rms velocity: dry friction leaves a third of it."""
    found = run(Case({"smooth_friction": "bearing1"}, "strong", 3, 30.0), tmp_path)
    assert found["verdict"] == "unknown"
    assert found["messages"][-1].startswith(f"{FORMS['smooth_friction']} fits best but leaves 3")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "verdicts"), [("hertz", ("complete", "unknown")), ("line", ("complete",))])
def test_what_was_hidden_is_found_in_one_direction(name: str, verdicts: tuple[str, ...], tmp_path: Path) -> None:
    """Of a Hertz contact the motion across is not known: the fit has two maxima, and rounding decides between them."""
    found = run(Case({name: "bearing1"}, "strong", 1, 30.0, varied=True), tmp_path)
    assert found["added"] == [name]
    assert found["verdict"] in verdicts
    assert found["percent"][-1] < 0.3 * found["percent"][0]
