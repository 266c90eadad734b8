"""Shapes of the inferred force's spectrum that sensors and filters make."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hidden_effects import RATE, one_bearing
from scipy.signal import butter, lfilter

from estimator import force_colour
from estimator.simulate import simulate
from estimator.whole import fit_whole


def test_a_fall_without_a_peak_may_be_an_anti_alias_filter() -> None:
    """A filter of one channel that falls within the band is found as a resonant sensor; so much is said."""
    rig = replace(one_bearing(), effects=())
    y = simulate(rig, RATE, 6.0, seed=0, noise=0.0)
    said = {}
    filtered = np.stack([lfilter(*butter(3, 8500.0, fs=RATE), y[:, 0]), y[:, 1]], axis=1)
    for name, seen in (("whole", y), ("filtered", filtered)):
        whole = fit_whole(rig, seen, RATE)
        found = [s for s in force_colour.find(rig, whole.point) if s.effect == "sensor_resonance"]
        said[name] = [s.note for s in found]
    assert not any(said["whole"])
    assert any("anti-alias filter" in note for note in said["filtered"])
