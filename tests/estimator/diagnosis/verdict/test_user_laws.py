"""A candidate law of the user passes and fails the gates that a law of the catalogue has to pass."""

from __future__ import annotations

from dataclasses import replace

from estimator import Channel, Diagnosis, EffectUse, Model, Setting, diagnose, simulate
from estimator.effects.engine.custom import custom_effect
from estimator.model import CustomLaw

RATE_HZ = 25600.0
CAP = "bearing1.x"
ONE_CAP_RIG = Model(
    (Channel("b1x", "bearing1", "x"),),
    band=(150.0, 8000.0),
    mass={"bearing1": 0.2},
    linear={CAP: {"kL": Setting(1.0e7), "c": Setting(60.0), "S": Setting(1.0e-4)}},
)


def user_law(name: str, expression: str, **parameters: tuple[float | None, str]) -> EffectUse:
    """A law at the cap. parameters : value (None: unknown) and unit."""
    settings = {n: Setting(value) for n, (value, _) in parameters.items()}
    return EffectUse(
        name, {CAP: settings}, CustomLaw(expression, None, {n: unit for n, (_, unit) in parameters.items()})
    )


def diagnosed(hidden: EffectUse, candidate: EffectUse) -> Diagnosis:
    """The diagnosis of two seconds of a rig with a hidden law, by a model with a candidate."""
    y = simulate(replace(ONE_CAP_RIG, effects=(hidden,)), rate_hz=RATE_HZ, seconds=2.0, seed=1)
    return diagnose(replace(ONE_CAP_RIG, candidates=(candidate,)), y, RATE_HZ)


def test_a_candidate_of_the_right_shape_is_named() -> None:
    """It is judged on the largest amplitudes, as every law of displacement."""
    saturating = {"w": (5.0e-8, "m")}
    hidden = user_law("hidden", "f*tanh(x/w)", f=(0.8, "N"), **saturating)
    found = diagnosed(hidden, user_law("mine", "f*tanh(x/w)", f=(None, "N"), **saturating))
    assert found.verdict == "mine"
    assert found.ranking[0].amplitude_gain is not None
    assert found.ranking[0].after_percent < 0.1 * found.ranking[0].before_percent


def test_a_candidate_of_the_wrong_shape_is_refused_although_it_is_ahead() -> None:
    """A law even in the velocity explains one half of a drag of one direction, and leaves the odd half."""
    hidden = user_law("hidden", "d*v*maximum(v, 0)", d=(3.0e5, "N s^2/m^2"))
    found = diagnosed(hidden, user_law("mine", "d*abs(v)", d=(None, "N s/m")))
    assert found.verdict == "unknown"
    assert found.ranking[0].effect == "mine"
    assert found.shape is not None
    assert found.shape.against == "velocity"
    assert any("mine fits best but leaves" in message.text for message in found.messages)


def test_amplitudes_of_any_unit_count_in_the_character_of_a_law() -> None:
    """1 N/m^3 and 1 N s/m make parts that differ by fifteen orders of magnitude."""
    both = custom_effect(user_law("mine", "a*x**3 + d*v", a=(None, "N/m^3"), d=(None, "N s/m")))
    mixed = custom_effect(user_law("mine", "a*x**3 + b*x**6", a=(None, "N/m^3"), b=(None, "N/m^6")))
    assert (both.state, mixed.state) == ("both", "displacement")
