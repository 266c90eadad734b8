"""What only root may do to a computer, done to the guest: its clock is set while a session runs. Run by run.sh."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import pytest
from can_guest import RATE_HZ, Device, Session, up_fd
from mcap.reader import make_reader

pytestmark = [pytest.mark.guest, pytest.mark.timeout(600)]
STEPS_S = 3600.0, -2 * 86_400.0


def test_the_clock_of_the_computer_is_set(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    """Forward by an hour, back by two days: each named, and the log's times go on as if nothing had been."""
    up_fd("can2", "can3")
    moved = 0.0
    with Device(tmp_path, "can2"):
        session = Session(tmp_path, "can:socketcan:can3")
        session.until("samples", lambda log: log.n_samples > 2 * RATE_HZ, 120.0)
        try:
            for number, step in enumerate(STEPS_S):
                time.clock_settime(time.CLOCK_REALTIME, time.time() + step)
                moved += step
                session.until("word", lambda log, n=number: len(_told(log)) > n)  # type: ignore[misc]
                time.sleep(3.0)
        finally:
            time.clock_settime(time.CLOCK_REALTIME, time.time() - moved)
        log = session.finish()
    moves = [float(text.split("moved by ")[1].split()[0]) for text in _told(log)]
    assert moves[:2] == pytest.approx(STEPS_S, abs=0.1)
    times: dict[str, list[int]] = defaultdict(list)
    with session.path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            if message.log_time:  # the description of the log is of no time
                times[channel.topic].append(message.log_time)
    back = sum(b < a for own in times.values() for a, b in zip(own, own[1:], strict=False))
    span_s = (max(map(max, times.values())) - min(map(min, times.values()))) / 1e9
    measured = f"named; no time goes back, from first to last {span_s:.1f} s; {log.lost_samples} lost"
    print(measured)
    how = "forward by an hour, then back by two days, under `rotorscope run`"
    record_property("reliability", f"clock of the computer is set | {how} | named, the log's times go on | {measured}")
    assert back == 0
    assert span_s < 300.0
    assert log.lost_samples == 0


def _told(log: object) -> list[str]:
    return [n.text for n in log.notices if n.code == "wall_clock_set"]  # type: ignore[attr-defined]
