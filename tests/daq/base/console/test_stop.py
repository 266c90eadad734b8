"""Signals as an event."""

import random
import signal
import threading
import time

import pytest

from daq.base.console.stop import Stop


@pytest.mark.timeout(60)
def test_a_signal_at_any_moment_of_a_wait_ends_it() -> None:
    """The handler runs between any two steps of the main thread, also while that holds the lock of the event."""
    rng = random.Random(1)
    for _ in range(60):
        with Stop() as stop:
            at_s = 0.001 + 0.002 * rng.random()
            sender = threading.Thread(target=lambda s=at_s: (time.sleep(s), signal.raise_signal(signal.SIGTERM)))
            sender.start()
            while not stop.event.wait(0.0):
                pass
            sender.join()
            assert not stop.interrupted


def test_a_second_interrupt_is_one() -> None:
    with Stop() as stop:
        signal.raise_signal(signal.SIGINT)
        assert stop.event.wait(5.0)
        assert stop.interrupted
        signal.raise_signal(signal.SIGTERM)  # does not
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
