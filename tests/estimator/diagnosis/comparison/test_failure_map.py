"""A law found at both bearings stays at those where it is identifiable, all of them fitted together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, ROOT

from daq.rig.rig import load_rig
from estimator.diagnosis.hypotheses import ranking
from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.verdict.joint_fit import at_identifiable_bearings
from estimator.effects import CATALOGUE
from estimator.effects.engine.strength import with_effect
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.likelihood.fitting.gauss_newton import fit_model
from estimator.likelihood.motion.located_law import LocatedLaw
from estimator.model.rig import Model, Setting
from estimator.simulation.simulator import simulate

SECONDS, NODES = 8.0, ("bearing1", "bearing2")


def one_direction() -> Model:
    """The paper's rig in x, with forces at the two bearings that are coherent."""
    rig = load_rig(ROOT / "configs/tiwari_vyas_1997.toml").model
    rig = replace(
        rig,
        channels=tuple(c for c in rig.channels if c.place.endswith("x")),
        linear={k: v for k, v in rig.linear.items() if k.endswith("x")},
        effects=(),
    )
    return with_effect(rig, CATALOGUE["correlated_force"], {"rho": 0.4}, "bearing1.x")


@pytest.mark.parametrize("hidden", [NODES[:1], NODES])
def test_a_bearing_that_only_shares_the_force_of_the_other_is_not_named(hidden: tuple[str, ...]) -> None:
    rig, drift = one_direction(), CATALOGUE["stiffness_drift"]
    truth = with_effect(rig, drift, {"rate": 1.2e5, "curvature": 0.0}, *[f"{n}.x" for n in hidden])
    model = replace(rig, effects=(replace(rig.effects[0], parameters={"bearing1.x": {"rho": Setting(0.4)}}),))
    y = simulate(truth, RATE, SECONDS, seed=3, noise=0.02, full_scale=490.5)
    point = fit_all_effects(model, y, RATE).point
    laws = tuple(
        LocatedLaw(drift, f"{n}.x.stiffness_drift", (i,), np.array([1e5 * (n in hidden), 0.0]), free=(True, False))
        for i, n in enumerate(NODES)
    )
    both = {"bearing1": (90.0, 80.0), "bearing2": (9.0, 8.0)}
    named = Entry(
        "stiffness_drift",
        NODES,
        99.0,
        88.0,
        p_value=1e-9,
        before_percent=3.0,
        after_percent=0.0,
        parameters={},
        score=99.0,
        placed=laws,
        by_node=both,
    )
    entry, after = at_identifiable_bearings(point, named, fit_model(point.data, [*point.placed, *laws], start=point))
    assert entry.at == hidden
    assert entry.heldout_gain == sum(both[n][1] for n in hidden)
    assert {use.key for use in after.placed if use.effect is drift} == {f"{n}.x.stiffness_drift" for n in hidden}


def test_without_a_bearing_its_nats_and_numbers_go() -> None:
    laws = tuple(
        LocatedLaw(CATALOGUE["cubic"], f"{n}.x.cubic", (i,), np.ones(1), free=(True,)) for i, n in enumerate(NODES)
    )
    by_node = {"bearing1": (5.0, 4.0), "bearing2": (3.0, 1.0)}
    parameters = {f"{n}.x.cubic.kNL": object() for n in NODES}
    entry = Entry(
        "cubic",
        NODES,
        8.0,
        5.0,
        p_value=1e-3,
        before_percent=1.0,
        after_percent=0.0,
        parameters=parameters,
        score=8.0,
        placed=laws,
        by_node=by_node,
    )  # type: ignore[arg-type]
    less = ranking.without_nodes(entry, ["bearing2"])
    assert (less.at, less.gain, less.heldout_gain, less.placed) == (("bearing1",), 5.0, 4.0, laws[:1])
    assert set(less.parameters) == {"bearing1.x.cubic.kNL"}
