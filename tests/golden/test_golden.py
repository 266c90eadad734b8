"""The answers to the golden records are the stored ones, within the tolerance between machines."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import pytest

from .make import RESULTS, answers, differences
from .records import RECORDS, GoldenRecord

IMPROVED_RECORDS = {"complete_gap", "quadratic"}  # a second or two of improve: in the fast suite
# one of each kind: complete, with a gap, with the disc in the band, with a measured force
FITTED_RECORDS = {"complete", "complete_gap", "complete_disc_in_band", "quadratic_measured_force"}


def stored(record: GoldenRecord) -> dict[str, Any]:
    """The golden result of a record."""
    return dict(json.loads((RESULTS / f"{record.name}.json").read_text("utf-8")))


def assert_as_stored(record: GoldenRecord, commands: Sequence[str]) -> None:
    """Every command answers what is stored. Of a diagnosis that is known to be wrong the verdict alone is compared."""
    golden, now = stored(record), answers(record, commands)
    for name in commands:
        was, is_now = golden[name]["result"], now[name]["result"]
        if record.known_wrong and "verdict" in was:
            was, is_now = was["verdict"], is_now["verdict"]
        found = [*differences(was, is_now, name)]
        assert not found, [*found, record.known_wrong]


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: record.name)
def test_diagnose_answers_what_is_stored(record: GoldenRecord) -> None:
    """A diagnosis fits and surveys each record, so a change of either shows here."""
    assert_as_stored(record, ("diagnose",))


@pytest.mark.parametrize("record", [r for r in RECORDS if r.name in FITTED_RECORDS], ids=lambda record: record.name)
def test_fit_and_compare_answer_what_is_stored(record: GoldenRecord) -> None:
    assert_as_stored(record, ("fit", "compare"))


@pytest.mark.slow  # half a minute; those above are of the same kinds
@pytest.mark.parametrize("record", [r for r in RECORDS if r.name not in FITTED_RECORDS], ids=lambda record: record.name)
def test_fit_and_compare_of_the_other_records_answer_what_is_stored(record: GoldenRecord) -> None:
    assert_as_stored(record, ("fit", "compare"))


@pytest.mark.parametrize("record", [r for r in RECORDS if r.name in IMPROVED_RECORDS], ids=lambda record: record.name)
def test_improve_answers_what_is_stored(record: GoldenRecord) -> None:
    assert_as_stored(record, ("improve",))


@pytest.mark.slow  # a minute; the two above are of the same kinds: a complete rig and a hidden effect
@pytest.mark.parametrize(
    "record", [r for r in RECORDS if r.name not in IMPROVED_RECORDS], ids=lambda record: record.name
)
def test_improve_of_the_other_records_answers_what_is_stored(record: GoldenRecord) -> None:
    assert_as_stored(record, ("improve",))


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: record.name)
def test_the_stored_verdict_is_the_truth_unless_it_is_known_to_be_wrong(record: GoldenRecord) -> None:
    """A record whose verdict has been mended loses its field known_wrong."""
    right = stored(record)["diagnose"]["result"]["verdict"] == (record.hidden or "complete")
    assert right == (not record.known_wrong)
