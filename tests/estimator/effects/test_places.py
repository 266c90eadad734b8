"""Where effects act, and with which numbers: canonical places, no borrowed values, kinematics, natural sizes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import Size, search_range, size, strengths, with_effect
from estimator.effects.places import at, kinematic, places, values, written
from estimator.errors import ModelError
from estimator.model.rig import BearingGeometry, Channel, EffectUse, Model, Setting

LINEAR = {
    f"{n}.{d}": {"kL": Setting(1e7), "c": Setting(60.0), "S": Setting(9e-5)}
    for n in ("bearing1", "bearing2")
    for d in "xy"
}
RIG = Model(
    channels=tuple(Channel(p.replace(".", ""), *p.split(".")) for p in LINEAR),
    band=(150.0, 8000.0),
    shaft="chain",
    mass={"disc": 0.5, "bearing1": 0.2, "bearing2": 0.2},
    shaft_stiffness=155e3,
    speed_rpm=2100.0,
    linear=LINEAR,
)


def use(name: str, **by_place: dict[str, float | None]) -> EffectUse:
    written = {k.replace("_", "."): {n: Setting(v) for n, v in p.items()} for k, p in by_place.items()}
    return EffectUse(name, written)


def test_canonical_places() -> None:
    caps = tuple(LINEAR)
    assert places(CATALOGUE["cubic"], RIG) == caps
    assert places(CATALOGUE["rub"], RIG) == ("bearing1", "bearing2")
    assert places(CATALOGUE["imbalance"], RIG) == places(CATALOGUE["crack"], RIG) == ("disc",)
    assert places(CATALOGUE["correlated_force"], RIG) == ("bearing1.x", "bearing1.y")
    assert places(CATALOGUE["imbalance"], replace(RIG, shaft="none")) == ()
    x_only = replace(RIG, channels=RIG.channels[::2])
    assert places(CATALOGUE["rub"], x_only) == ()
    assert places(CATALOGUE["hertz"], x_only) == ("bearing1", "bearing2")  # as if nothing moved in y
    assert places(CATALOGUE["correlated_force"], x_only) == ("bearing1.x",)


def test_ways_of_writing_a_place() -> None:
    cubic, rub = CATALOGUE["cubic"], CATALOGUE["rub"]
    node = use("cubic", bearing1={"kNL": 2.0})
    assert at(cubic, node, RIG) == ("bearing1.x", "bearing1.y")
    assert values(cubic, node, RIG, "bearing1.y").tolist() == [2.0]
    turned = use("rub", bearing2_x={"k": 1.0, "kt": 0.1, "clearance": 1e-7})
    assert at(rub, turned, RIG) == ("bearing2",)
    assert values(rub, turned, RIG, "bearing2").tolist() == [1.0, 0.1, 1e-7]
    gain = CATALOGUE["sensor_gain"]
    by_channel = EffectUse("sensor_gain", {"bearing1y": {"error": Setting(0.1)}})
    assert at(gain, by_channel, RIG) == ("bearing1.y",)
    assert values(gain, by_channel, RIG, "bearing1.y").tolist() == [0.1]
    rho = CATALOGUE["correlated_force"]
    assert at(rho, use("correlated_force", bearing2_x={"rho": 0.3}), RIG) == ("bearing1.x",)
    assert at(CATALOGUE["bow"], use("bow", disc_y={"a": 1.0, "b": 0.0}), RIG) == ("disc",)


def test_a_value_is_never_borrowed_from_the_other_direction() -> None:
    one = use("cubic", bearing1_x={"kNL": None}, bearing1_y={"kNL": 5.0})
    with pytest.raises(ModelError, match=r"cubic at bearing1\.x has no kNL \(N/m\^3\)"):
        values(CATALOGUE["cubic"], one, RIG, "bearing1.x")


def test_what_is_written_for_the_place_comes_before_what_is_written_for_its_node() -> None:
    clearance = CATALOGUE["clearance"]
    mixed = use("clearance", bearing1={"k": 1e6, "gap": 1e-7}, bearing1_x={"k": 2e6, "gap": None}, bearing2_x={})
    at_x = written(clearance, mixed, RIG, "bearing1.x")
    assert (at_x["k"].value, at_x["gap"].value) == (2e6, 1e-7)
    assert written(clearance, mixed, RIG, "bearing1.y")["k"].value == 1e6
    assert written(clearance, mixed, RIG, "bearing2.x") == {}


def test_kinematics_come_from_the_rig() -> None:
    geometry = replace(RIG, bearing=BearingGeometry(6, 6e-3, 20e-3, 3.09e-3))
    assert kinematic("bpfo", RIG) is None
    assert kinematic("bpfo", geometry) == pytest.approx(2.1)
    assert kinematic("bpfo", replace(geometry, ball_pass_order=2.05)) == 2.05
    ball = use("ball_pass", bearing1_x={"k_cos": 1.0, "k_sin": 0.0})
    assert values(CATALOGUE["ball_pass"], ball, geometry, "bearing1.x")[2] == pytest.approx(2.1)
    with pytest.raises(ModelError, match="has no order"):
        values(CATALOGUE["ball_pass"], ball, RIG, "bearing1.x")
    hertz = use("hertz", bearing1={"k": 1.0, "preload": 1e-7})
    assert values(CATALOGUE["hertz"], hertz, RIG, "bearing1")[2] == 6.0
    eight = replace(RIG, bearing=BearingGeometry(8, 6e-3, 20e-3, 3.09e-3))
    assert values(CATALOGUE["hertz"], hertz, eight, "bearing1")[2] == 8.0


def test_natural_sizes_come_from_the_linear_rotor() -> None:
    natural = size(RIG, "bearing1")
    assert natural.x == pytest.approx(np.sqrt(9e-5 / (4 * 60 * 1e7)), rel=0.05)
    assert natural.v == pytest.approx(natural.x * np.sqrt(1e7 / 0.2), rel=0.05)
    gap = CATALOGUE["clearance"].parameters[1]
    assert search_range(gap, natural) == pytest.approx((0.02 * natural.x, 4 * natural.x))
    given = strengths(CATALOGUE["clearance"], natural, 0.06)
    assert given["gap"] == pytest.approx(natural.x)
    model = with_effect(RIG, CATALOGUE["clearance"], given, "bearing2.y")
    assert model.effects[-1].parameters["bearing2.y"]["gap"].value == pytest.approx(natural.x)
    assert len(with_effect(RIG, CATALOGUE["clearance"], given).effects[-1].parameters) == 4


def test_a_stiffness_below_zero_has_a_size() -> None:
    """As a fit far from the rotor leaves it: numpy's warning had come through to the user."""
    (frequency,) = (p for p in CATALOGUE["pedestal"].parameters if p.scale == "hz_peak")
    assert Size(x=1e-6, v=1e-2, m=0.2, kL=-1e7).of(frequency) > 0.0
