"""A law with a memory beside a spectrum that nothing explains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing

from estimator.diagnosis.hypotheses.ranking import Entry
from estimator.diagnosis.verdict.gate_residual import mimics_a_spectrum
from estimator.effects import CATALOGUE
from estimator.identification.batch.full_fit import fit_all_effects
from estimator.identification.finding import DisturbanceForce
from estimator.identification.residual.missing_force import MissingForce
from estimator.likelihood.motion.located_law import LocatedLaw
from estimator.simulation.simulator import simulate

SECONDS = 6.0


@pytest.mark.parametrize(("percent", "bends"), [(0.2, True), (9.0, False)])
def test_hysteresis_much_smaller_than_the_spectrum_is_not_its_cause(percent: float, bends: bool) -> None:
    """Of two foreign records with a peak in the force it took 28 and 24 nats, and 4.5 % of the force stayed 4.5 %."""
    rig = one_bearing()
    point = fit_all_effects(rig, simulate(rig, RATE, SECONDS, seed=5, noise=0.02, full_scale=490.5), RATE).point
    power_N2 = float((0.08 * point.bearing_force[0]) ** 2)
    share = DisturbanceForce(place=0, against="frequency", region="above the model", power_N2=power_N2)
    before = MissingForce((), point.bearing_force, (share,))
    law = LocatedLaw(CATALOGUE["bouc_wen"], "bearing1.x.bouc_wen", (0,), np.array([1e5, 1e-8]), (True, True))
    entry = Entry("bouc_wen", ("bearing1",), 28.0, 20.0, 1e-9, 8.0, 8.0, {}, 28.0, percent, (law,))
    assert mimics_a_spectrum(point, before, entry) == bends
    cubic = LocatedLaw(CATALOGUE["cubic"], "bearing1.x.cubic", (0,), np.ones(1), (True,))
    assert not mimics_a_spectrum(point, before, replace(entry, placed=(cubic,)))
