"""When structural modes are sought as samples arrive, and what that may cost."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial

import numpy as np
import pytest
from reference_rig import rig_model

from estimator.identification.rolling.background import BackgroundSearch, FoundBackground, Search
from estimator.identification.rolling.start import FirstFit
from estimator.identification.rolling.thresholds import LIMITS
from estimator.identification.structure.cross_spectra import SearchTooLongError

RATE_HZ, BLOCK, HOUR_S = 8192.0, 2048, 3600.0
Answer = Callable[["partial[FoundBackground | None]"], FoundBackground | None]


def starts_s(answer: Answer) -> list[float]:
    """When searches begin in an hour of a force that is not white, s."""
    seen, out = 0, []

    def run(search: Search) -> Search:
        assert isinstance(search, partial)
        out.append(seen / RATE_HZ)
        found = answer(search)
        return lambda: found

    sought, model = BackgroundSearch(RATE_HZ, 4, BLOCK, run), rig_model()
    first = FirstFit(model, None, {})  # type: ignore[arg-type]
    while seen < HOUR_S * RATE_HZ:
        seen += BLOCK
        if sought.is_due(seen, lambda: True):
            assert sought.step(seen, first, model, [np.zeros((BLOCK, 4))]) is None
    return out


def test_the_next_search_comes_after_twice_the_time_where_nothing_was_found() -> None:
    at = starts_s(lambda search: None)
    assert at[0] == pytest.approx(6.0, abs=0.5)
    assert len(at) <= np.log2(HOUR_S / at[0]) + 1


def test_searches_that_are_given_up_take_no_more_than_their_share_of_a_core() -> None:
    limits = []

    def endless(search: "partial[FoundBackground | None]") -> None:
        work = search.args[-1]
        limits.append(work.limit / 2e7)  # seconds of a core
        with suppress(SearchTooLongError):
            work.add(10**12)

    at = starts_s(endless)
    spent = np.cumsum(limits)
    assert np.all(spent <= LIMITS.max_core_share * np.array(at))
    assert len(at) < 15


def test_parts_that_agree_are_searched_as_one() -> None:
    wholes = []

    def same(search: "partial[FoundBackground | None]") -> FoundBackground:
        wholes.append(search.args[1])
        return FoundBackground({"bearing1.x": 1e6})

    starts_s(same)
    assert wholes[:5] == [False] * 4 + [True]


def test_parts_that_differ_are_not() -> None:
    stiffness = iter(1e6 * 1.08 ** np.arange(1000.0))
    wholes = []

    def other(search: "partial[FoundBackground | None]") -> FoundBackground:
        wholes.append(search.args[1])
        return FoundBackground({"bearing1.x": float(next(stiffness))})

    starts_s(other)
    assert not any(wholes)
