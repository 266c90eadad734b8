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
    told = lines(diagnosis, {"de": "m/s^2"})
    assert [name for name, _ in told if name] == ["record", "machine", "structure", "bearing"]
    assert len(told) <= 8
    text = "\n".join(line for _, line in told)
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
    assert {label for _, label in signal["envelopes"]["de"]["marks"]} == {"BPFO", "BPFI", "BSF", "FTF"}
    psd = np.array(signal["spectra"]["de"]["psd"])
    assert np.median(psd) == pytest.approx(2.0 / RATE_HZ, rel=0.2), "white noise of variance one"
    drawn = signal_figures.pictures(signal)
    assert "BPFO" in str(drawn["envelopes"])
    assert "1X" in str(drawn["measured"])
    assert "* 3000 Hz, 2 %" in str(drawn["modes"])
    page = render("motor", diagnoses=[diagnosis], signal=signal)
    assert page.index("What the record shows") < page.index("Verdict:")
