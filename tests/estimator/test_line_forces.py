"""Lines in the accelerations: judged by what is really around them."""

from __future__ import annotations

import numpy as np
from hidden_effects import RATE, one_bearing

from estimator.line_forces import spectrum_of


def test_a_record_without_a_mean_has_no_line_at_its_lowest_frequencies() -> None:
    """The bin at 0 Hz was taken for what lies below: with nothing there, noise at 5 Hz was six times its surroundings,
    and 62 % of the force of a complete model of 6 s was missing."""
    y = np.random.default_rng(0).normal(size=(int(6 * RATE), 2))
    s = spectrum_of(one_bearing(), y - np.average(y, axis=0, weights=np.hanning(len(y))), RATE)
    low = (s.f_hz > 3.0) & (s.f_hz < 40.0)
    ratio = (np.abs(s.Y) ** 2 / s.noise)[:, low]
    assert np.all(np.abs(ratio.mean(axis=1) - 1.0) < 0.3)  # exponential, neighbours alike under the window
    assert ratio.max() < 15.0
