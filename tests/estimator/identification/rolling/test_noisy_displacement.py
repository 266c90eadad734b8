"""The noise of a displacement sensor in a nonlinear law is taken out as samples arrive, as in a fit."""

import numpy as np
from reference_samples import langevin

from estimator.identification.batch import fit_spectral
from estimator.identification.rolling.estimator import RollingEstimator
from estimator.model.rig import Channel, EffectUse, Model

RATE = 1000.0


def test_the_rolling_estimate_has_no_other_bias_than_the_fit() -> None:
    """5 % noise: without the correction kNL is 0.7 %, 1.2 standard deviations, lower than in the fit.

    The blocks begin at other rows than those of the fit, which moves each value by a third of a standard deviation.
    """
    w, one = 2 * np.pi * 50.0, np.ones(1)
    k = w**2 * one
    channels, cubic = (Channel("d", "bearing1", "x", "displacement"),), (EffectUse("cubic", {"bearing1.x": {}}),)
    wide = Model(channels, (10.0, 450.0), "none", {"bearing1": 1.0}, effects=cubic)
    apart = []
    for seed in range(3):
        x, _ = langevin(one, 0.06 * w * one, k, k, np.zeros((1, 1)), 0.12 * w**3 * one, RATE, 60000, seed)
        y = x + 0.05 * x.std() * np.random.default_rng(seed).normal(size=x.shape)
        rolling = RollingEstimator(wide, RATE, 1e5, watch=())
        for part in np.split(y, np.arange(100, len(y), 100)):
            rolling.update(part)
        a, b = rolling.snapshot().parameters, fit_spectral(wide, y, RATE).parameters
        keys = [f"bearing1.x.{key}" for key in ("kL", "c", "cubic.kNL")]
        apart.append([(a[key].value - b[key].value) / b[key].sd for key in keys])  # type: ignore[operator]
    assert np.abs(np.mean(apart, axis=0)).max() < 0.6, apart
