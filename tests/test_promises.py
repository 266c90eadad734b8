"""What the other tests rely on: a late test is tried again, a busy loop is seen, whatever else the machine does."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from promises import TRIES, Late, crowding, least_share, within

tried: list[Path] = []


def test_a_late_test_is_tried_again_from_its_fixtures_on(tmp_path: Path) -> None:
    assert tmp_path not in tried
    tried.append(tmp_path)
    if len(tried) < TRIES:
        raise Late("twice too late, and then in time")


def test_what_is_late_on_any_machine() -> None:
    within(0.9, 1.0)
    with pytest.raises(Late):
        within(1000.0, 1.0)
    assert crowding() >= 1.0


def test_a_busy_loop_is_in_every_window() -> None:
    def spin(seconds: float) -> None:
        end = time.thread_time() + 0.05 * seconds
        while time.thread_time() < end:
            pass
        time.sleep(0.5 * seconds)

    assert least_share(time.thread_time, spin, 0.02, window_s=0.1) > 0.02
    assert least_share(time.thread_time, time.sleep, 0.02, window_s=0.1) < 0.02
