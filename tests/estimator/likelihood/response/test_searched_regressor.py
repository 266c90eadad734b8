"""The regressor of a parameter that a law is not linear in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimator.likelihood.motion.located_law import LocatedLaw, located_laws, needs_finer_grid
from estimator.likelihood.motion.prepare import motion_record
from estimator.likelihood.response.regressor_set import regressors
from estimator.model.rig import Channel, EffectUse, Model, Setting
from estimator.simulation.simulator import simulate

RATE = 4096.0
PLACE = "bearing1.x"
LINEAR = {PLACE: {"kL": Setting(1.3e6), "c": Setting(20.0), "S": Setting(1e-4)}}
LAW = EffectUse("clearance", {PLACE: {"k": Setting(4e5), "gap": Setting(1e-6)}})
RIG = Model((Channel("a", *PLACE.split(".")),), (150.0, 1600.0), mass={"bearing1": 0.2}, linear=LINEAR, effects=(LAW,))


def with_gap(law: LocatedLaw, gap: float) -> LocatedLaw:
    return replace(law, p=np.array([law.p[0], gap]))


def test_both_ends_of_a_difference_are_evaluated_on_one_grid() -> None:
    """Where one end needed a finer grid and the other did not, a gap had a standard deviation 40 times too small."""
    data = motion_record(RIG, simulate(RIG, RATE, 8.0, seed=1), RATE)
    (law,) = located_laws(RIG, data)
    gaps = np.geomspace(0.5e-6, 2e-6, 801)
    finer = np.array([needs_finer_grid(law.effect, with_gap(law, g).p, data, 0) for g in gaps])
    (edge,) = np.flatnonzero(np.diff(finer.astype(int)))[:1]
    rms = []
    for gap in (np.sqrt(gaps[edge] * gaps[edge + 1]), 1.01 * gaps[edge + 1]):  # steps are of 0.1 %
        made = {t.name: t for t in regressors(with_gap(law, float(gap)), data, np.array([[0.2, 1.3e6, 20.0]]))}
        rms.append(np.std(made[f"{PLACE}.clearance.gap"].series[0]))
    assert 0.9 < rms[0] / rms[1] < 1.1
