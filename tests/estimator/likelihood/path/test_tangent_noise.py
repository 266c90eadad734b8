"""Noise of a displacement sensor in a cubic: what it adds to the Gram matrices is taken out again."""

from __future__ import annotations

import numpy as np
import pytest
from reference_samples import langevin

from estimator.identification.batch import fit_spectral
from estimator.model.rig import Channel, EffectUse, Model

RATE_HZ, SECONDS, NOISE_SHARE = 1000.0, 60.0, 0.1


def test_a_noisy_probe_does_not_weaken_a_cubic() -> None:
    """Along the noisy path the cubic was 5 % too weak."""
    w, one = 2 * np.pi * 50.0, np.ones(1)
    k = w**2 * one
    channels = (Channel("d", "bearing1", "x", "displacement"),)
    cubic = (EffectUse("cubic", {"bearing1.x": {}}),)
    model = Model(channels, (10.0, 450.0), "none", {"bearing1": 1.0}, effects=cubic)
    clean, noisy = [], []
    for seed in range(2):
        x, _ = langevin(one, 0.06 * w * one, k, k, np.zeros((1, 1)), 0.12 * w**3 * one, RATE_HZ,
                        int(RATE_HZ * SECONDS), seed)  # fmt: skip
        noise = NOISE_SHARE * x.std() * np.random.default_rng(seed).normal(size=x.shape)
        for out, y in ((clean, x), (noisy, x + noise)):
            out.append(fit_spectral(model, y, RATE_HZ).parameters["bearing1.x.cubic.kNL"].value)
    assert np.mean(noisy) == pytest.approx(np.mean(clean), rel=0.02)
