"""The ring against a Python list, and its error text."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from daq.session.ring import Ring


class RingMachine(RuleBasedStateMachine):
    """`rows` is the whole history as a list of (value or None); the ring must show its tail."""

    @initialize(capacity=st.integers(1, 12), first=st.integers(0, 2**40))
    def make(self, capacity: int, first: int) -> None:
        self.ring = Ring(capacity, 2, first)
        self.rows: list[float | None] = []
        self.next_value = 0.0

    @rule(count=st.integers(0, 30))
    def append(self, count: int) -> None:
        values = self.next_value + np.arange(count)
        self.next_value += count
        self.ring.append(np.column_stack([values, -values]))
        self.rows += list(values)

    @rule(count=st.integers(0, 30))
    def skip(self, count: int) -> None:
        self.ring.skip(count)
        self.rows += [None] * count

    @rule(data=st.data())
    def window_is_the_history(self, data: st.DataObject) -> None:
        held = self.rows[-self.ring.capacity :]
        low = data.draw(st.integers(0, len(held)))
        high = data.draw(st.integers(low, len(held)))
        start, stop = self.ring.start + low, self.ring.start + high
        expected = held[low:high]
        view = self.ring.window(start, stop)
        assert view.flags.c_contiguous
        np.testing.assert_array_equal(view[:, 0], [np.nan if v is None else v for v in expected])
        np.testing.assert_array_equal(view[:, 1], [np.nan if v is None else -v for v in expected])
        assert self.ring.present(start, stop).tolist() == [v is not None for v in expected]

    @rule(low=st.integers(-3, 3), high=st.integers(-3, 3))
    def outside_raises_with_both_bounds(self, low: int, high: int) -> None:
        start, stop = self.ring.start + low, self.ring.stop + high
        if low >= 0 and high <= 0 and start <= stop:
            return
        with pytest.raises(IndexError, match=rf"\[{self.ring.start}, {self.ring.stop}\)"):
            self.ring.window(start, stop)

    @invariant()
    def bounds(self) -> None:
        if hasattr(self, "ring"):
            assert self.ring.stop - self.ring.first == len(self.rows)
            assert self.ring.stop - self.ring.start == min(len(self.rows), self.ring.capacity)


RingMachine.TestCase.settings = settings(max_examples=60, stateful_step_count=25, deadline=None)
TestRing = RingMachine.TestCase


def test_a_window_cannot_be_written() -> None:
    ring = Ring(4, 1)
    ring.append(np.ones((3, 1)))
    with pytest.raises(ValueError, match="read-only"):
        ring.window(0, 2)[0, 0] = 5.0


def test_a_skip_far_beyond_the_capacity_is_cheap_and_exact() -> None:
    ring = Ring(8, 1)
    ring.append(np.ones((3, 1)))
    ring.skip(10**12)
    ring.append(np.full((2, 1), 7.0))
    assert ring.stop == 10**12 + 5
    assert ring.window(ring.stop - 3, ring.stop)[:, 0].tolist()[1:] == [7.0, 7.0]
    assert ring.present(ring.start, ring.stop).sum() == 2


@pytest.mark.parametrize("wrong", [(0, 1, 0), (4, -1, 0), (4, 1, -1)])
def test_impossible_rings(wrong: tuple[int, int, int]) -> None:
    with pytest.raises(ValueError, match="ring of"):
        Ring(*wrong)
    with pytest.raises(ValueError, match="only grows"):
        Ring(4, 1).skip(-1)
