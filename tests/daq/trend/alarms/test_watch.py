"""Alarms of a rig file: what is watched, when it is said, what survives a restart."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stand_ins import info_of, paper_rig, vibration

from daq.base.contract.errors import ConfigError
from daq.base.contract.sink import Session
from daq.rig.rig import Rig
from daq.trend.alarms.watch import AlarmState, AlarmWatch
from drivers.contract.reading import Notice
from estimator.results import Estimate, Parameter

PAPER_RIG = paper_rig()
RATE_HZ = 25_600
CLASS = '\n[machine]\niso20816 = { part = 3, group = 2, support = "rigid" }\n'


def rig(alarms: str, more: str = "") -> Rig:
    return Rig.parse(PAPER_RIG.text + more + alarms)


class Watched:
    """A watch, and what it has said."""

    def __init__(self, own: Rig, memory: Path | None = None) -> None:
        self.states: list[AlarmState] = []
        self.watch = AlarmWatch(own, [self.states.append], memory, lambda: 0)
        info = info_of(own)
        self.watch.start(Session(model=own.model, info=info, device="", attachments={}, metadata={}))
        self.second = 0

    def estimates(self, values: Any, every_s: int = 60, sd: float = 1e4) -> list[Notice]:
        """kL of bearing1.x, a value each `every_s`."""
        for value in np.atleast_1d(values):
            self.second += every_s
            p = Parameter(float(value), sd, "N/m")
            estimate = Estimate(self.second * RATE_HZ, {"bearing1.x.kL": p}, 1e5, extra={"missing_force_percent": 3.0})
            self.watch.readings([vibration(self.second * RATE_HZ, 1)])
            self.watch.estimate(estimate)
        return list(self.watch.health().notices)

    def layers(self, velocity: float, p_value: float | None = None) -> list[Notice]:
        """A window of ten seconds."""
        self.second += 10
        train = {"name": "BPFO", "severity": 0.3, "p_value": p_value}
        seen = {
            "record": {"channels": {"b1x": {"velocity_rms_mm_s": velocity, "rms": 1.0, "unit": "m/s^2"}}},
            "machine": {"speed_rpm": None, "tones": [], "strikes": [] if p_value is None else [train]},
        }
        self.watch.layers(self.second * RATE_HZ, seen)
        self.watch.readings([])
        return list(self.watch.health().notices)


def noise(n: int, seed: int) -> Any:
    return 1e7 + 1e4 * np.random.default_rng(seed).standard_normal(n)


CHANGE = '[[alarm]]\nwhat = "bearing1.x.kL"\nchange = "2 %"\nlearn_s = 7200\n'


def test_a_change_is_learned_said_and_over() -> None:
    own = Watched(rig(CHANGE))
    (learned,) = own.estimates(noise(125, 1))
    assert learned.code == "alarm_learned"
    assert "MN/m is usual; a change of 200.0 kN/m is seen after about 1 min" in learned.text
    assert own.estimates(noise(500, 2)) == []
    (alarm,) = own.estimates(noise(5, 3) - 3e5)
    assert (alarm.level, alarm.code) == ("warning", "alarm")
    assert "bearing1.x.kL: 9.7" in alarm.text
    assert "has changed (-2.8 %)" in alarm.text
    (over,) = own.estimates(noise(6, 4))
    assert over.code == "alarm_over"
    assert [s.state for s in own.states] == ["learning", "ok", "alarm", "ok"]
    assert len(own.watch.raised) == 1


def test_what_was_learned_survives_a_restart(tmp_path: Path) -> None:
    memory = tmp_path / "trend" / "alarms.json"
    first = Watched(rig(CHANGE), memory)
    first.estimates(noise(60, 1))
    first.watch.close()  # half of it
    second = Watched(rig(CHANGE), memory)
    assert [n.code for n in second.estimates(noise(70, 2))] == ["alarm_learned"]
    second.watch.close()
    third = Watched(rig(CHANGE), memory)
    assert third.states[0].state == "ok"
    assert [n.code for n in third.estimates(noise(4, 3) - 4e5)] == ["alarm"]
    third.watch.close()
    assert Watched(rig(CHANGE), memory).states[0].state == "alarm"  # it lasts
    assert Watched(rig(CHANGE.replace("2 %", "3 %")), memory).states[0].state == "learning"  # another alarm
    memory.write_text("{broken")
    assert [n.code for n in Watched(rig(CHANGE), memory).watch.health().notices] == ["alarm_memory"]


def test_a_limit_is_held_and_passed_by_what_the_estimate_leaves_uncertain() -> None:
    own = Watched(rig('[[alarm]]\nwhat = "bearing1.x.kL"\nlimit = 9.5e6\nbelow = true\nhold_s = 30\n'))
    assert own.estimates([9.4e6] * 3 + [9.6e6], every_s=10) == []
    assert own.estimates([9.4e6] * 10, every_s=10, sd=1e5) == []  # one standard deviation below
    (alarm,) = own.estimates([9.4e6] * 4, every_s=10)
    assert "below 9.500 MN/m for 30 s" in alarm.text
    assert [n.code for n in own.estimates([9.7e6] * 5, every_s=10)] == ["alarm_over"]


def test_severity_by_zone_and_missing_force() -> None:
    own = Watched(rig('[[alarm]]\nwhat = "severity.b1x"\nlimit = "C"\nhold_s = 20\n', CLASS))
    assert [n.code for v in (2.0, 3.0, 3.0, 2.0, 3.0, 3.0, 3.0) for n in own.layers(v)] == ["alarm"]
    own = Watched(rig('[[alarm]]\nwhat = "missing_force"\nlimit = 2.5\nhold_s = 0\n'))
    assert [n.code for n in own.estimates([1e7] * 3)] == ["alarm"]


def test_strikes_are_an_alarm_if_they_are_seen_more_clearly_than_noise_is_in_a_month() -> None:
    own = Watched(rig('[[alarm]]\nwhat = "strikes.BPFO"\nhold_s = 20\n'))
    assert [own.layers(1.0, p) for p in (1e-5, 1e-5, 1e-5, 1e-5, None)] == [[]] * 5  # once in 100 000 windows
    (alarm,) = [n for p in (1e-8, 1e-8, 1e-8) for n in own.layers(1.0, p)]
    assert alarm.text == "alarm: strikes.BPFO: seen for 20 s, severity 0.300"
    assert [n.code for _ in range(4) for n in own.layers(1.0)] == ["alarm_over"]


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ('what = "bearing1.x.kL"', "needs limit = NUMBER or change"),
        ('what = "bearing1.x.kL"\nlimit = 1.0\nchange = "5 %"', "two alarms"),
        ('what = "bearing1.x.kL"\nchange = "a lot"', 'write "5 %"'),
        ('what = "bearing1.x.kL"\nlimit = 1.0\nper = "never"', "is no rate"),
        ('what = "severity.b9x"\nlimit = 1.0', 'did you mean "b2x"'),
        ('what = "severity.b1x"\nlimit = "C"', "needs [machine] iso20816"),
        ('what = "rms.b1x"\nlimit = "C"', "a zone is one of severity.CHANNEL alone"),
        ('what = "strikes.BPFX"', 'did you mean "BPFO"'),
        ('what = "bearing9.x.kL"\nlimit = 1.0', "nothing that is measured"),
        ('what = "severity"\nlimit = 3.0', "write severity.CHANNEL; channels are "),
        ('what = "missing_force"\nbelow = true\nchange = 1.0', "below needs limit"),
    ],
)
def test_a_wrong_alarm_is_one_line(table: str, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        rig(f"[[alarm]]\n{table}\n")
    assert words in str(caught.value)
    assert "alarm[0]" in str(caught.value)
    assert "\n" not in str(caught.value)
