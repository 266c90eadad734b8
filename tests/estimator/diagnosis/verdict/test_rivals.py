"""A law that passed the gates is no answer beside something larger that no law explains."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import pytest

from estimator.diagnosis.hypotheses.ranking import Entry, GateResult
from estimator.diagnosis.verdict.gates import INSIDE_LIMITS, LEAVES_LITTLE, Context
from estimator.diagnosis.verdict.joint_fit import JointFit
from estimator.diagnosis.verdict.rivals import better_predicting, has_mistakes_for_rivals, is_overshadowed, leaves_less
from estimator.effects import CATALOGUE
from estimator.likelihood.motion.located_law import LocatedLaw

GATES_PASSED = (GateResult(gate=INSIDE_LIMITS, passed=True), GateResult(gate=LEAVES_LITTLE, passed=True))
GATES_LEAVING_TOO_MUCH = (GATES_PASSED[0], GateResult(gate=LEAVES_LITTLE, passed=False, measured=0.6, limit=0.2))
GATES_OUTSIDE_LIMITS = (GateResult(gate=INSIDE_LIMITS, passed=False, measured=2.0, limit=1.0),)


def law(nats: float, before: float, after: float, *gates: GateResult) -> Entry:
    """A law at bearing1. before, after : missing force, per cent of the bearing force."""
    return Entry(
        effect="some_law", at=("bearing1",), gain=nats, heldout_gain=nats, p_value=1e-9, before_percent=before,
        after_percent=after, parameters={}, score=nats, by_node={"bearing1": (nats, nats)}, gates=gates,
        placed=cast(tuple[LocatedLaw, ...], ("a law",)),
    )  # fmt: skip


NAMED_LAW = law(60.0, 5.0, 3.0, *GATES_PASSED)  # explains 4 %


@pytest.mark.parametrize(
    ("beside", "overshadowed"),
    [
        (law(65.0, 5.0, 3.0, *GATES_LEAVING_TOO_MUCH), False),  # within the resolution of the record
        (law(90.0, 5.0, 3.0, *GATES_LEAVING_TOO_MUCH), True),  # far likelier
        (law(90.0, 5.0, 3.0, *GATES_PASSED), False),  # that passed too: the ranking decides
        (law(90.0, 5.0, 3.0, *GATES_OUTSIDE_LIMITS), False),  # of a gap that the motion never closes
        (law(40.0, 9.5, 3.0, *GATES_LEAVING_TOO_MUCH), True),  # explains 9 %
        (replace(law(90.0, 5.0, 3.0, *GATES_LEAVING_TOO_MUCH), by_node={"bearing2": (90.0, 90.0)}), False),  # elsewhere
    ],
)
def test_a_refused_law_that_is_larger_or_far_likelier_overshadows(beside: Entry, overshadowed: bool) -> None:
    assert is_overshadowed(NAMED_LAW, [NAMED_LAW, beside]) is overshadowed


@pytest.mark.parametrize("placed", [NAMED_LAW.placed, ()])
def test_what_leaves_more_than_twice_what_it_explains_is_no_answer(placed: tuple[LocatedLaw, ...]) -> None:
    """Forces that are correlated by 2 % were named where 28 % of the bearing force was missing."""
    assert is_overshadowed(replace(law(60.0, 9.9, 9.0, *GATES_PASSED), placed=placed), []), "explains 4 %, leaves 9 %"
    assert not is_overshadowed(replace(law(60.0, 9.9, 7.0, *GATES_PASSED), placed=placed), []), "explains 7 %"


def test_a_law_that_couples_the_directions_has_swapped_channels_as_a_rival() -> None:
    """With b1y and b2x swapped the spring between the caps looks like an anisotropy of each bearing."""

    def placed(name: str) -> Entry:
        return replace(NAMED_LAW, placed=cast(tuple[LocatedLaw, ...], (SimpleNamespace(effect=CATALOGUE[name]),)))

    assert has_mistakes_for_rivals([placed("anisotropy")])
    assert not has_mistakes_for_rivals([placed("cubic")])
    assert has_mistakes_for_rivals([])


@pytest.mark.parametrize(("left_percent", "less"), [(0.0, True), (1.0, True), (2.0, False)])
def test_a_mistake_is_named_where_it_leaves_less_than_half_of_what_the_law_leaves(
    left_percent: float, less: bool
) -> None:
    """An anisotropy left 17 % of the bearing force where two cables were swapped, and had more nats."""
    assert leaves_less(law(9.0, 5.0, left_percent), [NAMED_LAW]) is less
    assert leaves_less(law(9.0, 5.0, left_percent), [])


@pytest.mark.parametrize(
    ("left_rel", "ahead_nats", "beside_modes", "together_nats", "is_answer"),
    [
        (0.4, 30.0, True, 95.0, True),
        (0.4, 30.0, False, 95.0, False),  # no errors of modes that could be what it leaves
        (0.6, 30.0, True, 95.0, False),  # leaves more than half
        (0.4, 5.0, True, 70.0, False),  # within the resolution of the record
        (0.4, 30.0, True, 150.0, False),  # the other law explains another force
    ],
)
def test_where_no_law_passes_the_best_predicting_one_is_the_answer_beside_modes(
    left_rel: float, ahead_nats: float, beside_modes: bool, together_nats: float, is_answer: bool
) -> None:
    gates = (GATES_PASSED[0], GateResult(gate=LEAVES_LITTLE, passed=False, measured=left_rel, limit=0.2))
    best, other = law(90.0, 5.0, 2.0, *gates), replace(law(60.0, 5.0, 3.0, *gates), effect="another_law")
    fits = {
        e.effect: JointFit(entry=e, gain_nats=nats) for e, nats in ((best, 60.0 + ahead_nats), (other, 60.0))
    }  # fmt: skip
    data = SimpleNamespace(background="modes" if beside_modes else None)
    own = SimpleNamespace(fits=fits, point=SimpleNamespace(data=data), gain_together=lambda *_: together_nats)
    context = cast(Context, own)
    assert better_predicting([best, other], None, context) is (best if is_answer else None)
    assert better_predicting([], None, context) is None
