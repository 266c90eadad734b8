"""A mistake in the rig file as a verdict beside a model that leaves nothing."""

from __future__ import annotations

import pytest

from estimator.diagnosis.hypotheses.rig_changes import ScaledMass
from estimator.diagnosis.hypotheses.rig_file import Mistake
from estimator.diagnosis.verdict.mistake import is_sure


@pytest.mark.parametrize(
    ("values", "gain_nats", "sure"),
    [((2.0, 0.05), 300.0, True), ((1.7, 0.09), 29.0, False), ((0.7, 0.03), 300.0, False), ((), 100.0, True)],
)
def test_a_factor_is_a_common_slip_that_gains_what_ten_modes_cost(
    values: tuple[float, ...], gain_nats: float, sure: bool
) -> None:
    """A complete rig was said to have a cap of 1.7 times the mass, by 29 nats: a mode of a support was not found."""
    assert is_sure(Mistake(hypothesis=ScaledMass(key="bearing1"), values=values, gain_nats=gain_nats)) is sure
