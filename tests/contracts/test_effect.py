"""What every effect of the catalogue must satisfy; a new one is collected from the dict and cannot avoid it."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimator.effects import CATALOGUE
from estimator.effects.engine.law_loop import force_array
from estimator.effects.engine.memory_loop import memory_array
from estimator.effects.engine.page import markdown
from estimator.effects.engine.strength import Size, defaults, rms, search_range, strengths
from estimator.model.effect import Effect, EffectParameter

CONTRACT_EFFECTS = """cubic, quintic, quadratic, clearance, stop, hertz, coulomb, stribeck, quadratic_damping,
displacement_damping, bouc_wen, imbalance, misalignment, bow, ball_pass, local_defect, crack, rub, cross_coupling,
anisotropy, gyroscopic, pedestal, stiffness_drift, correlated_force, coloured_excitation, line, sensor_gain,
sensor_clipping, sensor_skew, sensor_resonance, sensor_noise"""
AT = Size(x=1.9e-7, v=1.36e-3, m=0.2, kL=1e7, a=4.0, c=60.0)
ALL = list(CATALOGUE.values())
LAWS = [e for e in ALL if e.force is not None]
CONSERVATIVE = [e for e in LAWS if e.stationary_density and e.name != "gyroscopic"]


def of(effects: list[Effect]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("effect", effects, ids=lambda e: e.name)


def states(n: int = 500, seed: int = 1, spread: float = 2.0) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    x, v, xo, vo = rng.normal(size=(4, n)) * spread * np.array([AT.x, AT.v, AT.x, AT.v])[:, None]
    return x, v, xo, vo, rng.uniform(0, 60, n), rng.uniform(0, 900, n)


def random_parameters(effect: Effect, rng: np.random.Generator) -> np.ndarray:
    """Allowed values: amplitudes that make a force like the bearing's, searched ones anywhere in their range."""
    p = defaults(effect, AT)
    for k, q in enumerate(effect.parameters):
        if q.linear:
            p[k] = rng.uniform(0.0 if q.low == 0.0 else -1.0, 1.0)
        elif not q.given:
            p[k] = rng.uniform(*search_range(q, AT))
    linear = [k for k, q in enumerate(effect.parameters) if q.linear]
    if linear and effect.kind != "memory":
        p[linear] *= AT.force / max(rms(effect, p, AT), 1e-300)
    return p


def test_every_name_of_the_contract_is_there() -> None:
    assert list(CATALOGUE) == re.split(r",\s*", CONTRACT_EFFECTS)
    assert all(name == effect.name for name, effect in CATALOGUE.items())


def test_the_page_of_the_docs_is_the_catalogue() -> None:
    page = Path(__file__).parents[2] / "docs" / "effects.md"
    assert page.read_text() == markdown(), "python -m estimator.effects.engine.page > docs/effects.md"


@of(ALL)
def test_texts_are_complete(effect: Effect) -> None:
    assert len(effect.equation) > 3
    for text in (effect.signature, effect.distinguish, effect.reference, effect.check):
        assert len(text) > 20
    assert re.search(r"\d", effect.reference), "a reference names a year, a standard or a section"
    assert len(effect.on_machine) > 20
    assert effect.confused_with
    assert set(effect.confused_with) <= set(CATALOGUE) - {effect.name}
    for p in effect.parameters:
        assert p.unit
        assert p.description
        assert p.low < p.high
        assert p.low <= p.default <= p.high
        assert p.name.isidentifier()
    assert len({p.name for p in effect.parameters}) == len(effect.parameters)


@of([e for e in ALL if e.refines])
def test_a_law_that_refines_another_one_contains_it(effect: Effect) -> None:
    """With some amplitudes at zero, the force is that of the other law."""
    assert effect.refines in CATALOGUE
    assert effect.refines in effect.confused_with
    other = CATALOGUE[effect.refines]
    assert (other.kind, other.scope, other.refines) == (effect.kind, effect.scope, None)
    shared = {q.name for q in other.parameters}
    p, own = random_parameters(effect, np.random.default_rng(4)), random_parameters(other, np.random.default_rng(4))
    for k, q in enumerate(effect.parameters):
        if q.name in shared:
            p[k] = own[[o.name for o in other.parameters].index(q.name)]
        elif q.linear:
            p[k] = 0.0
    np.testing.assert_array_equal(force_array(effect, p, *states()), force_array(other, own, *states()))


@of(ALL)
def test_one_file_with_its_name(effect: Effect) -> None:
    law = effect.force or effect.rates or effect.apply or effect.shape
    assert law is not None
    assert Path(law.__code__.co_filename).name == f"{effect.name}.py"
    assert {"force": effect.force, "memory": effect.memory_force, "sensor": effect.apply}.get(effect.kind, law)


@of(LAWS)
def test_zero_strength_is_zero_force(effect: Effect) -> None:
    p = defaults(effect, AT)
    p[[q.linear for q in effect.parameters]] = 0.0
    assert not force_array(effect, p, *states()).any()


@of(LAWS)
def test_finite_for_every_allowed_parameter(effect: Effect) -> None:
    rng = np.random.default_rng(2)
    for trial in range(20):
        p = random_parameters(effect, rng)
        for s in (1.0, -1.0):
            assert np.isfinite(force_array(effect, p, *states(seed=trial, spread=5.0), s)).all()
    x, v, xo, vo, t, phase = states()
    for zeros in ((0 * x, v, xo, vo), (x, 0 * v, xo, vo), (0 * x, 0 * v, 0 * xo, 0 * vo)):
        assert np.isfinite(force_array(effect, p, *zeros, t, phase)).all()


@of(LAWS)
def test_declared_amplitudes_are_linear(effect: Effect) -> None:
    rng = np.random.default_rng(3)
    one, two = random_parameters(effect, rng), random_parameters(effect, rng)
    linear = np.array([q.linear for q in effect.parameters])
    assert linear.any()
    two[~linear] = one[~linear]
    both = one.copy()
    both[linear] = 2.0 * one[linear] - 0.5 * two[linear]
    expected = 2.0 * force_array(effect, one, *states()) - 0.5 * force_array(effect, two, *states())
    np.testing.assert_allclose(force_array(effect, both, *states()), expected, atol=1e-12 * AT.force)


@of(LAWS)
def test_pure(effect: Effect) -> None:
    p = random_parameters(effect, np.random.default_rng(4))
    kept, given = p.copy(), states()
    copies = [a.copy() for a in given]
    first = force_array(effect, p, *given)
    assert np.array_equal(first, force_array(effect, p, *given))
    assert np.array_equal(p, kept)
    assert all(np.array_equal(a, b) for a, b in zip(given, copies, strict=True))


@of(CONSERVATIVE)
def test_conservative_forces_do_no_work_around_a_loop(effect: Effect) -> None:
    """The force is -dV/dx for some V(x, y): its integral around any closed loop of positions is zero."""
    p = defaults(effect, AT)
    angle = np.linspace(0.0, 2 * np.pi, 20001)
    x, y = AT.x * (0.4 + 2.0 * np.cos(angle)), AT.x * (-0.3 + 1.5 * np.sin(angle + 0.4))
    fx = force_array(effect, p, x, xo=y, s=1.0)
    fy = force_array(effect, p, y, xo=x, s=-1.0) if effect.scope == "node" else 0.0 * y
    work = np.trapezoid(fx, x) + np.trapezoid(fy, y)
    turnover = np.trapezoid(np.abs(fx), angle) * AT.x
    assert abs(work) < 1e-5 * turnover
    moved = force_array(effect, p, x, v=AT.v, xo=y, vo=-AT.v, t=3.0, phase=1.0)
    assert np.array_equal(fx, moved), "depends on position alone"


@pytest.mark.parametrize("name", ["coulomb", "stribeck", "quadratic_damping", "displacement_damping"])
def test_dissipative_forces_take_power(name: str) -> None:
    effect = CATALOGUE[name]
    x, v, xo, vo, t, phase = states()
    for trial in range(5):
        p = random_parameters(effect, np.random.default_rng(trial))
        power = force_array(effect, p, x, v, xo, vo, t, phase) * v
        assert (power >= 0.0).all()
        assert (power > 0.0).any()


def test_gyroscopic_does_no_work() -> None:
    effect = CATALOGUE["gyroscopic"]
    x, v, xo, vo, t, phase = states()
    fx = force_array(effect, np.array([3.0]), x, v, xo, vo, t, phase, 1.0)
    fy = force_array(effect, np.array([3.0]), xo, vo, x, v, t, phase, -1.0)
    np.testing.assert_allclose(fx * v + fy * vo, 0.0, atol=1e-18)
    assert np.abs(fx * v).max() > 0


@pytest.mark.parametrize("degrees", range(0, 360, 15))
def test_rub_presses_inward_and_drags_against_rotation_at_every_angle(degrees: int) -> None:
    effect, (k, kt, gap) = CATALOGUE["rub"], (2e6, 5e5, 1e-7)
    th = np.deg2rad(degrees)
    r = 2.5e-7
    x, y = r * np.array([np.cos(th)]), r * np.array([np.sin(th)])
    p = np.array([k, kt, gap])
    on_rotor = -np.array([force_array(effect, p, x, xo=y, s=1.0)[0], force_array(effect, p, y, xo=x, s=-1.0)[0]])
    normal, tangent = np.array([np.cos(th), np.sin(th)]), np.array([-np.sin(th), np.cos(th)])
    assert on_rotor @ normal == pytest.approx(-k * (r - gap))
    assert on_rotor @ tangent == pytest.approx(-kt * (r - gap)), "rotation takes x to y; friction opposes it"
    inside = force_array(effect, p, 0.3 * x, xo=0.3 * y)
    assert inside[0] == 0.0


@of([e for e in LAWS if any(p.scale == "x" for p in e.parameters)])
def test_the_regime_is_entered_at_natural_size(effect: Effect) -> None:
    """With its default gap the law is both in and out of contact in a normal run, and not a linear spring."""
    x, v, xo, vo, t, phase = states(4000, spread=1.0)
    f = force_array(effect, defaults(effect, AT), x, v, xo, vo, t, phase)
    if effect.name != "hertz":
        assert 0.02 < np.mean(f != 0.0) < 0.9
    straight = f - x * (x @ f) / (x @ x)
    assert np.std(straight) > 0.15 * np.std(f)


@of([e for e in ALL if e.kind == "memory"])
def test_memory_effects_are_finite_and_start_from_rest(effect: Effect) -> None:
    rate, n = 2e5, 20000
    t = np.arange(n) / rate
    x = 3 * AT.x * np.sin(2 * np.pi * 1100 * t)
    v = np.gradient(x, 1 / rate)
    lin = np.array([AT.m, AT.kL, AT.c])
    rng = np.random.default_rng(6)
    for _ in range(10):
        f = memory_array(effect, random_parameters(effect, rng), lin, x, v, rate)
        assert np.isfinite(f).all()
        assert f[0] == 0.0
        assert np.abs(f).max() > 0.0


@of([e for e in ALL if e.kind == "sensor"])
def test_sensors_keep_length_and_input_and_repeat(effect: Effect) -> None:
    rng = np.random.default_rng(7)
    y = AT.a * rng.normal(size=3000)
    kept = y.copy()
    p = np.array(list(strengths(effect, AT, 0.06).values()))
    assert effect.apply is not None
    one = effect.apply(y, AT.rate_hz, p, np.random.default_rng(1))
    two = effect.apply(y, AT.rate_hz, p, np.random.default_rng(1))
    assert one.shape == y.shape
    assert np.isfinite(one).all()
    assert np.array_equal(one, two)
    assert np.array_equal(y, kept)
    assert not np.array_equal(one, y)


@of([e for e in ALL if e.shape is not None])
def test_shapes_are_finite_and_flat_at_zero(effect: Effect) -> None:
    f = np.linspace(0.0, 1e5, 1001)
    assert effect.shape is not None
    p = defaults(effect, AT)
    assert np.isfinite(effect.shape(f, p)).all()
    p[0] = 0.0
    assert np.ptp(effect.shape(f, p)) == 0.0


@of(ALL)
@pytest.mark.parametrize("fraction", [0.02, 0.06])
def test_strengths_are_what_was_asked(effect: Effect, fraction: float) -> None:
    given = strengths(effect, AT, fraction)
    assert list(given) == [p.name for p in effect.parameters]
    p = np.array(list(given.values()))
    assert np.isfinite(p).all()
    if not effect.typical or effect.kind == "shaft":  # a shaft's share needs a model
        assert rms(effect, p, AT) == pytest.approx(fraction * AT.force, rel=0.05)


STATE_AND_POWER = {  # state and power, by hand; every other effect has no law of the states alone
    "cubic": ("displacement", 3),
    "quintic": ("displacement", 5),
    "quadratic": ("displacement", 2),
    "clearance": ("displacement", None),
    "stop": ("displacement", None),
    "hertz": ("displacement", None),
    "coulomb": ("velocity", None),
    "stribeck": ("velocity", None),
    "quadratic_damping": ("velocity", None),
    "displacement_damping": ("both", None),
    "rub": ("directions", None),
    "cross_coupling": ("directions", None),
    "anisotropy": ("directions", None),
    "gyroscopic": ("directions", None),
}


@of(ALL)
def test_state_and_power_are_those_of_the_law(effect: Effect) -> None:
    if effect.name in STATE_AND_POWER:
        assert (effect.state, effect.power) == STATE_AND_POWER[effect.name]
    else:
        assert effect.state in ("time", "shaft_angle", "none")


def test_a_law_of_a_user_has_its_character_by_evaluation() -> None:
    def law(x: float, v: float, xo: float, vo: float, t: float, phase: float, s: float, p: Sequence[float]) -> float:
        return p[0] * (math.tanh(v / p[1]) + 1.0)

    speed = EffectParameter("vs", "m/s", 1e-5, 1.0, default=1e-3, description="")
    own = replace(CATALOGUE["coulomb"], force=law, parameters=(*CATALOGUE["coulomb"].parameters, speed))
    assert own.state == "velocity"


@of(ALL)
def test_how_it_is_found_has_what_that_needs(effect: Effect) -> None:
    assert (effect.found_by == "harmonics") == (effect.harmonics is not None)
    if effect.found_by == "law":
        assert effect.force or effect.rates
        assert effect.in_likelihood
    if effect.found_by == "spectrum":
        known = effect.spectral_factor or effect.channel_response or effect.adds_noise or effect.adds_resonance
        assert known
    if effect.found_by == "samples":
        assert effect.kind == "sensor"
        assert not effect.in_likelihood
    assert (effect.found_by == "coherence") == (effect.scope == "bearings")
    if effect.watched:
        assert effect.kind == "force"
        assert effect.found_by == "law"


@of([e for e in ALL if e.harmonics is not None])
def test_harmonics_are_those_of_the_law(effect: Effect) -> None:
    n = 4096
    angle = 2 * np.pi * np.arange(n) / n
    p = defaults(effect, AT)
    own = [k for k, q in enumerate(effect.parameters) if not q.linear and q.scale in ("bpfo", "hz_peak")]
    p[own] = 1.0  # one turn of its angle, whatever that is
    spectrum = np.abs(np.fft.rfft(force_array(effect, p, 0.0 * angle, t=angle / (2 * np.pi), phase=angle)))[1:30]
    heard = 1 + np.flatnonzero(spectrum > 1e-6 * spectrum.max())
    assert tuple(heard) == (tuple(range(1, 30)) if effect.harmonics == "all" else effect.harmonics)


@of([e for e in ALL if e.channel_response is not None])
def test_a_response_is_what_the_sensor_does(effect: Effect) -> None:
    assert effect.channel_response is not None
    assert effect.apply is not None
    n, rate = 4096, AT.rate_hz
    p = np.array(list(strengths(effect, AT, 0.06).values()))
    k = 200
    y = np.cos(2 * np.pi * k * np.arange(n) / n)
    middle = slice(n // 4, 3 * n // 4)
    seen = effect.apply(y, rate, p, np.random.default_rng(0))[middle]
    w = np.array([2 * np.pi * k * rate / n])
    expected = (effect.channel_response(w, p)[0] * np.exp(2j * np.pi * k * np.arange(n) / n)).real[middle]
    np.testing.assert_allclose(seen, expected, atol=0.02 * np.abs(expected).max())
    assert effect.scales_channel == (effect.name == "sensor_gain")


@of([e for e in ALL if e.spectral_factor is not None])
def test_a_spectral_factor_is_that_of_the_response_or_the_shape(effect: Effect) -> None:
    assert effect.spectral_factor is not None
    f = np.linspace(1.0, 9000.0, 50)
    p = defaults(effect, AT)
    if effect.channel_response is not None:
        expected = np.abs(effect.channel_response(2 * np.pi * f, p)) ** 2
    else:
        assert effect.shape is not None
        expected = effect.shape(f, p)
    np.testing.assert_allclose(effect.spectral_factor(f, p), expected, rtol=1e-10)
    assert not effect.flat_magnitude


@of(ALL)
def test_typical_values_are_allowed(effect: Effect) -> None:
    parameters = {q.name: q for q in effect.parameters}
    for name, (weak, strong) in effect.typical.items():
        q = parameters[name]
        assert weak != strong
        assert q.low <= min(weak, strong)
        assert max(weak, strong) <= q.high
    assert effect.typical or any(q.linear for q in effect.parameters)
