"""A law whose third harmonic lies beyond half the sampling rate is told."""

import numpy as np
import pytest
from scipy.signal import lfilter

from estimator.model import Channel, EffectUse, Model
from estimator.spectral import fit

RATE = 1000.0


@pytest.mark.parametrize(
    ("hz", "effect", "told"), [(220.0, "cubic", True), (50.0, "cubic", False), (220.0, "displacement_damping", True)]
)
def test_it_is_told(hz: float, effect: str, told: bool) -> None:
    pole = np.exp((-0.03 + 1j) * 2 * np.pi * hz / RATE)
    x = lfilter([1.0], [1.0, -2 * pole.real, abs(pole) ** 2], np.random.default_rng(3).normal(size=40000))
    channel = (Channel("d", "bearing1", "x", "displacement"),)
    model = Model(channel, (20.0, 420.0), "none", {"bearing1": 1.0}, effects=(EffectUse(effect, {"bearing1.x": {}}),))
    said = [m for m in fit(model, 1e-6 * x[:, None], RATE).messages if "third harmonic" in m]
    assert bool(said) == told
    assert all(m.startswith("bearing1.x: three times") for m in said)
