"""What sensor noise adds to the residual power: its slopes are those of the value."""

from __future__ import annotations

import numpy as np

from estimator.likelihood.whitening.noise_bias import NoiseBias


def test_slope_and_curvature_are_those_of_the_value() -> None:
    rng = np.random.default_rng(0)
    bins, places, k = 40, 2, 3
    A = rng.normal(size=(bins, places, places)) + 1j * rng.normal(size=(bins, places, places))
    tangents = rng.normal(size=(k, places, places, bins)) + 1j * rng.normal(size=(k, places, places, bins))
    noise, per_psd = rng.uniform(0.5, 1.0, size=(2, places, bins))
    bias, delta, h = NoiseBias(A, noise, per_psd), rng.normal(size=k), 1e-4
    slope, bend = bias.derivatives(tangents, delta)
    steps = h * np.eye(k)
    found = [(bias.value(tangents, delta + e) - bias.value(tangents, delta - e)) / (2 * h) for e in steps]
    np.testing.assert_allclose(slope, found, rtol=1e-6)
    np.testing.assert_allclose(bias.slopes(tangents, delta)[0], slope)
    found = [(bias.derivatives(tangents, delta + e)[0] - slope) / h for e in steps]
    np.testing.assert_allclose(bend, found, rtol=1e-6)
