"""The layers of a diagnosis as lines and pictures: what an engineer sees before the verdict."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from daq.report import signal_figures
from daq.report.layers import lines
from daq.report.page import render
from daq.report.signal_spectra import signal_spectra
from estimator import Channel, Model
from estimator.model import BearingGeometry

RATE_HZ = 12000.0
BEARING = BearingGeometry(9, 7.94e-3, 39.04e-3)
HOUSING_RIG = Model((Channel("de", "bearing1", "y"),), band=(500.0, 5000.0), bearing=BEARING)


@pytest.fixture
def diagnosis() -> dict[str, Any]:
    """A record of a motor with an outer race defect: the bearing layer is not judged."""
    amplitude = {"de": 0.012}
    tone = {"kind": "order", "order": 1.0, "frequency_hz": 29.9, "amplitude": amplitude, "unit": "m/s^2", "p_value": 0}
    hum = tone | {"kind": "mains", "order": 3.34, "frequency_hz": 100.0}
    strikes = {"name": "BPFO", "order": 3.585, "slip_percent": 0.1, "channel": "de", "p_value": 0.0, "severity": 1.4}
    strikes |= {"frequency_hz": 107.4, "band_hz": [2500.0, 4000.0]}
    mode = {"place": "bearing1.y", "frequency_hz": 3000.0, "frequency_sd": 9.0, "damping": 0.02, "damping_sd": 2e-3}
    level = {"rms": 1.36, "peak": 6.1, "crest": 4.5, "kurtosis": 3.0, "velocity_rms_mm_s": 0.14}
    return {
        "verdict": "local_defect",
        "ranking": [],
        "record": {
            "channels": {"de": level},
            "findings": [{"code": "spikes", "channels": ["de"], "text": "de spikes"}],
        },
        "machine": {
            "speed_rpm": {"value": 1796.0, "sd": 0.6, "source": "record"},
            "tones": [tone, *[hum] * 20],
            "strikes": [strikes],
        },
        "structure": {
            "modes": [mode | {"bearing": True}],
            "poles": [{"place": "bearing1.y", "order": 1, "frequency_hz": 3001.0, "damping": 0.02, "stable": True}],
        },
        "bearing": {"judged": False, "reason": "several modes"},
    }


def test_the_layers_are_a_few_lines_in_their_order(diagnosis: dict[str, Any]) -> None:
    shown = lines(diagnosis, {"de": "m/s^2"})
    assert [name for name, _ in shown if name] == ["record", "machine", "structure", "bearing"]
    assert len(shown) <= 8
    text = "\n".join(line for _, line in shown)
    for words in (
        "rms 1.36 m/s²", "de spikes", "1796 ± 0.6 rpm", "1X 29.9 Hz", "mains 100 Hz", "and 15 others",
        "BPFO strikes: order 3.585 (slip +0.1 %)", "3000 ± 9.0 Hz (damping 2 %, the bearing's)",
        "cannot be judged here: several modes",
    ):  # fmt: skip
        assert words in text, text


def test_spectra_are_drawn_with_tones_and_defect_frequencies_also_of_many_short_records(
    diagnosis: dict[str, Any],
) -> None:
    y = np.random.default_rng(0).standard_normal((60, 1500, 1))
    y[:, 1244:] = np.nan
    signal = signal_spectra(HOUSING_RIG, y.reshape(-1, 1), RATE_HZ, diagnosis)
    assert signal["envelopes"]["de"]["band_hz"] == [2500.0, 4000.0]
    assert {label for _, label in signal["envelopes"]["de"]["marks"]} == {"1X", "BPFO", "BPFI", "BSF", "FTF"}
    psd = np.array(signal["spectra"]["de"]["psd"])
    assert np.median(psd) == pytest.approx(2.0 / RATE_HZ, rel=0.2), "white noise of variance one"
    drawn = signal_figures.pictures(signal)
    assert "BPFO" in str(drawn["envelopes"])
    assert "1X" in str(drawn["measured"])
    assert "* 3000 Hz, 2 %" in str(drawn["modes"])
    page = render("motor", diagnoses=[diagnosis], signal=signal)
    assert page.index("What the record shows") < page.index("Verdict:")


def test_orders_of_shaft_and_bearing_stand_at_the_lines_of_a_record() -> None:
    """A tone at twice the speed: its amplitude, at order 2; the orders of the bearing from its geometry."""
    t = np.arange(int(20 * RATE_HZ)) / RATE_HZ
    y = 3.0 * np.sin(2 * np.pi * 59.2 * t) + 1e-2 * np.random.default_rng(0).standard_normal(t.size)
    machine = {"speed_rpm": {"value": 1776.0, "sd": 0.1, "source": "record"}}
    found = signal_spectra(HOUSING_RIG, y[:, None], RATE_HZ, {"machine": machine})
    own = found["orders"]["de"]
    top = int(np.argmax(own["amplitude"]))
    assert own["order"][top] == pytest.approx(2.0, abs=0.01)
    assert own["amplitude"][top] == pytest.approx(3.0, rel=0.2)
    assert [label for _, label in own["marks"]] == ["FTF", "1X", "2X", "BSF", "3X", "BPFO", "BPFI"]
    assert [label for _, label in found["spectra"]["de"]["marks"]] == ["1X", "2X", "3X"]
    assert "order of the shaft" in (signal_figures.pictures(found)["orders"] or "")


def test_a_waterfall_follows_a_tone_that_moves_and_leaves_out_what_is_missing() -> None:
    t = np.arange(int(10 * RATE_HZ)) / RATE_HZ
    y = np.sin(2 * np.pi * (500.0 * t + 100.0 * t**2)) + 1e-3 * np.random.default_rng(0).standard_normal(t.size)
    y[int(4 * RATE_HZ) : int(5 * RATE_HZ)] = np.nan
    fall = signal_spectra(HOUSING_RIG, y[:, None], RATE_HZ, {})["waterfalls"]["de"]
    f = np.array(fall["frequency_hz"])
    for at, row in zip(fall["time_s"], fall["level_db"], strict=True):
        if row[0] is None:
            assert 3.8 < at < 5.2
        else:
            assert f[int(np.argmax(row))] == pytest.approx(500.0 + 200.0 * at, rel=0.08)
    assert any(row[0] is None for row in fall["level_db"])
    assert signal_figures.pictures({"waterfalls": {"de": fall | {"unit": "m/s^2"}}})["waterfalls"]
