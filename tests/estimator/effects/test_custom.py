"""The user's own law: what is understood, what is refused and where, and its standing beside the built-in ones."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.effects import CATALOGUE
from estimator.effects.engine.custom import custom_effect
from estimator.effects.engine.expression import FUNCTION_CODES, ExpressionError, compile_law
from estimator.effects.engine.law_loop import force_array
from estimator.errors import DataError, ModelError
from estimator.identification.batch import spectral
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.located_law import LocatedLaw, located_laws
from estimator.likelihood.motion.prepare import prepare
from estimator.likelihood.path import law_gain
from estimator.model.rig import CustomLaw, EffectUse, Setting
from estimator.simulation.simulator import simulate


def own(expression: str, **parameters: tuple[float | None, str]) -> EffectUse:
    values = {k: Setting(v) for k, (v, _) in parameters.items()}
    law = CustomLaw(expression, None, {k: unit for k, (_, unit) in parameters.items()})
    return EffectUse("mine", {"bearing1.x": values}, law)


STATES = tuple(np.random.default_rng(0).normal(size=(6, 200)))


def test_the_example_of_the_contract_equals_the_built_in_stop() -> None:
    effect = custom_effect(own("k*maximum(x - g, 0)", k=(1e6, "N/m"), g=(1e-7, "m")))
    x = np.linspace(-5e-7, 5e-7, 101)
    p = np.array([1e6, 1e-7])
    np.testing.assert_allclose(force_array(effect, p, x), force_array(CATALOGUE["stop"], p, x), atol=1e-15)
    assert [q.linear for q in effect.parameters] == [True, False]
    assert effect.parameters[1].low < 1e-7 < effect.parameters[1].high
    assert effect.stationary_density
    assert custom_effect(own("k*maximum(x - g, 0)", k=(2e6, "N/m"), g=(1e-7, "m"))).force is effect.force


@pytest.mark.parametrize(
    ("text", "numpy_text"),
    [
        ("a*x**3 - b*v*abs(v)", None),
        ("a*sin(phase)*x + b*cos(3*phase)", None),
        ("a*tanh(x/b) + hypot(x, xo)*sign(vo)", None),
        ("a*where(x > b, x - b, 0) * (t >= 1)", None),
        ("a*clip(x, -b, b) + heaviside(x, 0.5)", None),
        ("a*x if x > 0 and v < b else -x % 2", "where((x > 0) & (v < b), a*x, -x % 2)"),
        ("a*power(abs(x), 1.5) + exp(-b*square(v)) + pi", None),
        ("a*arctan2(x, b) + log1p(fabs(v)) + floor(t) // 2", None),
    ],
)
def test_values_are_those_of_numpy(text: str, numpy_text: str | None) -> None:
    law, _ = compile_law(text, ("a", "b"))
    names = dict(zip(("x", "v", "xo", "vo", "t", "phase"), STATES, strict=True)) | {"a": 1.3, "b": 0.7}
    expected = eval(numpy_text or text, {n: getattr(np, n) for n in [*FUNCTION_CODES, "pi"]}, names)
    effect = replace(CATALOGUE["cubic"], force=law)
    found = force_array(effect, np.array([1.3, 0.7]), *STATES[:6])
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("expression", "message", "column"),
    [
        ("k*q", 'unknown name "q"', 3),
        ("k*x + __import__('os')", "not one of the functions", 7),
        ("k*x.real", "attribute", 3),
        ("k*x[0]", "index", 3),
        ("k*(lambda: x)()", "not one of the functions", 3),
        ("k*[x for x in (1,)]", "a list", 3),
        ("k*x + 'a'", "is not a number", 7),
        ("k*x +", "not an expression", 6),
        ("k*x if", "not an expression", 7),
        ("k*sin(x, v)", r"takes 1 argument\(s\), 2 given", 3),
        ("k*sin", "is a function", 3),
        ("k*x*1e999", "too large", 5),
        ("k*x & 3", "& is not allowed", 4),
        ("k*x; x", "not an expression", 4),
        ("", "empty", 1),
        ("k*x^3", r"\^ is not allowed; a power is \*\*", 4),
        ("k*np.tanh(x)", "without a module", 3),
        ("k*2", "constant", 1),
        ("k*(" * 45 + "x" + ")" * 45, "too involved", 1),
        ("k" + "*x" * 600, "longer", 1001),
        ("(k:=x)", ":=", 2),
    ],
)
def test_what_is_refused_is_said_with_its_column(expression: str, message: str, column: int) -> None:
    with pytest.raises(ExpressionError, match=message) as error:
        compile_law(expression, ("k",))
    assert error.value.column == column
    assert "\n" not in str(error.value)
    assert f"(column {column})" in str(error.value)


def test_a_parameter_that_is_not_used_is_named() -> None:
    with pytest.raises(ExpressionError, match="does not use it") as error:
        compile_law("2*x", ("k",))
    assert error.value.parameter == "k"


def test_parameters_cannot_hide_a_state_or_function() -> None:
    for name in ("x", "sin", "pi", "2a"):
        with pytest.raises(ExpressionError, match="cannot be called"):
            compile_law(f"{name}*v", (name,))


def test_parameters_may_have_the_names_that_compiled_laws_use_inside() -> None:
    effect = custom_effect(own("p*s*tanh(x/s)", p=(2.0, "N/m"), s=(1.0, "m")))
    x = np.array([-2.0, 0.5])
    np.testing.assert_allclose(force_array(effect, np.array([3.0, 0.7]), x), 2.1 * np.tanh(x / 0.7))


def test_a_law_that_is_not_finite_is_refused_where_it_happens() -> None:
    with pytest.raises(ModelError, match=r"custom effect mine: the law is not finite at x = 0, .*with k = 1"):
        custom_effect(own("k/x", k=(1.0, "N m")))
    with pytest.raises(ModelError, match="not finite"):
        custom_effect(own("k*log(x)", k=(1.0, "N")))
    with pytest.raises(ModelError, match=r"mine: unknown name .*column 5"):
        custom_effect(own("k*x+z", k=(1.0, "N")))
    with pytest.raises(ModelError, match="has not been loaded"):
        custom_effect(EffectUse("mine", {}, CustomLaw(None, "a.py:B", {})))


@pytest.mark.parametrize(
    ("expression", "linear"),
    [
        ("a*x + b*x**3", {"a", "b"}),
        ("a*b*x", {"a"}),
        ("a*sin(x/b)", {"a"}),
        ("a*x + b*x**3 + 7*x", set()),
        ("(a + b*x)*v", {"a", "b"}),
        ("x**3*abs(a)", set()),
    ],
)
def test_linear_parameters_are_found(expression: str, linear: set[str]) -> None:
    effect = custom_effect(own(expression, **{n: (1.5, "1") for n in ("a", "b") if n in expression.replace("abs", "")}))
    assert {q.name for q in effect.parameters if q.linear} == linear


def test_a_loaded_module_object_is_taken_as_it_is() -> None:
    use = EffectUse("mine", {"bearing1.x": {}}, CustomLaw(None, "m.py:Mine", {}, effect=CATALOGUE["cubic"]))
    assert custom_effect(use) is CATALOGUE["cubic"]


def test_a_module_object_that_cannot_work_is_refused() -> None:
    def with_effect(effect: object) -> EffectUse:
        return EffectUse("mine", {"bearing1.x": {}}, CustomLaw(None, "m.py:Mine", {}, effect=effect))  # type: ignore[arg-type]

    def bad(x, v, xo, vo, t, phase, s, p):  # type: ignore[no-untyped-def]
        return x.real_part_of("nothing")

    with pytest.raises(ModelError, match="mine: the module's object is a int, not an Effect"):
        custom_effect(with_effect(3))
    with pytest.raises(ModelError, match="kind force needs force"):
        custom_effect(with_effect(replace(CATALOGUE["cubic"], force=None)))
    with pytest.raises(ModelError, match="numba cannot compile it"):
        custom_effect(with_effect(replace(CATALOGUE["cubic"], force=bad)))


def test_a_user_law_has_the_standing_of_a_built_in_one_in_simulation() -> None:
    from estimator.model.rig import Channel, Model
    from estimator.simulation.simulator import simulate
    from estimator.simulation.start import stationarity

    linear = {"bearing1.x": {"kL": Setting(1e7), "c": Setting(60.0), "S": Setting(9e-5)}}
    model = Model((Channel("a", "bearing1", "x"),), (150.0, 8000.0), mass={"bearing1": 0.2}, linear=linear)
    built_in = EffectUse("cubic", {"bearing1.x": {"kNL": Setting(1e18)}})
    own_law = own("k*x**3", k=(1e18, "N/m^3"))
    one, two = (replace(model, effects=(e,)) for e in (built_in, own_law))
    np.testing.assert_allclose(simulate(two, 25600.0, 0.3, seed=3), simulate(one, 25600.0, 0.3, seed=3), rtol=1e-9)
    assert stationarity(two).exact


@settings(max_examples=200, deadline=None)
@given(st.text(alphabet="xvkp()[]{}*+-/%.,:;='\"_ 019eE<>!&|~@\n\t\\lambdimportsn", max_size=60))
def test_no_text_gets_past_the_parser_in_any_other_way(text: str) -> None:
    law = None
    with contextlib.suppress(ExpressionError):
        law, _ = compile_law(text, ("k",))
    if law is not None:
        assert set(law.__code__.co_names) <= {
            "math",
            "float",
            "abs",
            "max",
            "min",
            "sin",
            "tan",
            *FUNCTION_CODES,
        }


def raising(x, v, xo, vo, t, phase, s, p):  # type: ignore[no-untyped-def]
    if x > 1e-7:
        raise ValueError("too far")
    return p[0] * x


def nowhere(x, v, xo, vo, t, phase, s, p):  # type: ignore[no-untyped-def]
    return p[0] * math.log(x)


def importing(x, v, xo, vo, t, phase, s, p):  # type: ignore[no-untyped-def]
    import json

    return json.loads("1.0") * x


def short(x, v):  # type: ignore[no-untyped-def]
    return x + v


@pytest.mark.parametrize(
    ("law", "said"),
    [
        (raising, "raises or asserts"),
        (nowhere, "not finite at x = 0"),
        (importing, "cannot compile it"),
        (short, "cannot compile it"),
    ],
)
def test_a_modules_law_that_cannot_work_is_refused(law: Callable[..., float], said: str) -> None:
    use = EffectUse("mine", {}, CustomLaw(None, "a.py:B", {}, replace(CATALOGUE["cubic"], force=law)))
    with pytest.raises(ModelError, match=said):
        custom_effect(use)


def test_a_law_that_the_motion_leaves_is_said_by_name() -> None:
    """Beyond what its numbers suggest: it is first seen along the record."""
    rig = one_bearing()
    law = CustomLaw("k*(x + g)*sqrt(1e-7 - abs(x))", None, {"k": "N/m^1.5", "g": "m"})
    use = EffectUse("mine", {"bearing1.x": {"k": Setting(1e6), "g": Setting(1e-9)}}, law)
    y = simulate(rig, RATE, 3.0, seed=1, noise=0.02)
    with pytest.raises(DataError, match=r"effect mine at bearing1.x is not finite along the measured motion"):
        fit_all_effects(replace(rig, effects=(use,)), y, RATE)


def test_a_law_typed_with_a_length_in_metres_is_fitted() -> None:
    """Its derivative had been taken over a millimetre, and "the data leave it free" was said of gap and kL."""
    rig, place, gap = one_bearing(), "bearing1.x", 1.9e-7
    hidden = EffectUse("clearance", {place: {"k": Setting(3e6), "gap": Setting(gap)}})
    y = simulate(replace(rig, effects=(hidden,)), RATE, 4.0, seed=1, noise=0.02)
    law = CustomLaw("k*(maximum(x - g, 0) + minimum(x + g, 0))", None, {"k": "N/m", "g": "m"})
    typed = EffectUse("mine", {place: {"k": Setting(2e6), "g": Setting(1.5e-7)}}, law)
    found = spectral.fit_spectral(replace(rig, effects=(typed,)), y, RATE).parameters
    for name, true in (("mine.k", 3e6), ("mine.g", gap)):
        p = found[f"{place}.{name}"]
        assert p.value is not None
        assert p.sd is not None
        assert abs(p.value - true) < 3.0 * p.sd < 0.5 * true
    assert found[f"{place}.kL"].identifiable


def test_a_law_that_grows_beyond_all_measure_at_a_value_on_trial_is_passed_over() -> None:
    rig = one_bearing()
    data = prepare(rig, simulate(rig, RATE, 2.0, seed=1, noise=0.02), RATE)
    point = fit_model(data, located_laws(rig, data))
    effect = custom_effect(own("f*exp(x/w)", f=(1e-3, "N"), w=(1e-9, "m")))
    assert (
        law_gain.fitted_gain(
            point, LocatedLaw(effect, "bearing1.x.mine", (0,), np.array([1.0, 1e-9]), free=(True, False))
        )
        is None
    )
