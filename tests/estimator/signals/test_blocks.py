"""Blocks are a tight frame: sums over bins are sums over time; notches, gaps."""

import numpy as np
import pytest

from estimator.errors import DataError
from estimator.signals.blocks import block_layout, block_spectra, valid_blocks

RATE, BAND = 2000.0, (20.0, 600.0)


def test_energy_in_the_band_is_the_energy_over_time() -> None:
    grid = block_layout(RATE, BAND)
    n = 41 * grid.hop
    t = np.arange(n) / RATE
    fade = np.clip(np.minimum(t, t[-1] - t) / (2 * grid.size / RATE), 0, 1)  # nothing in the half-covered ends
    z = np.array([np.sin(2 * np.pi * 131.7 * t), np.cos(2 * np.pi * 44.2 * t + 0.3)]) * fade**2
    blocks = valid_blocks(np.ones(n, bool), grid)
    G = np.sum(np.abs(block_spectra(z, blocks, grid)) ** 2, axis=(1, 2))
    # one-sided PSD: sum over bins x df = mean square; each row lies in two blocks
    energy = G * (RATE / grid.size) * grid.hop / RATE
    assert energy[0] == pytest.approx((z[0] ** 2).sum() / RATE, rel=1e-5)
    assert energy[1] == pytest.approx((z[1] ** 2).sum() / RATE, rel=1e-5)


def test_white_noise_has_its_density_and_half_as_many_independent_bins() -> None:
    grid = block_layout(RATE, BAND)
    rng = np.random.default_rng(0)
    means = []
    for _ in range(60):
        z = rng.normal(size=(1, 40 * grid.hop))
        blocks = valid_blocks(np.ones(z.shape[1], bool), grid)
        G = np.sum(np.abs(block_spectra(z, blocks, grid)) ** 2)
        means.append(G / (blocks.size * grid.bins.size))
    assert np.mean(means) == pytest.approx(2 / RATE, rel=0.01)
    independent = 0.5 * 39 * grid.bins.size
    assert np.var(means) / np.mean(means) ** 2 * independent == pytest.approx(1.0, rel=0.5)


def test_gaps_and_notches_take_out_blocks_and_bins() -> None:
    grid = block_layout(RATE, BAND, notches=((100.0, 110.0),))
    assert not ((grid.f_hz >= 100.0) & (grid.f_hz <= 110.0)).any()
    valid = np.ones(10 * grid.hop, bool)
    valid[3 * grid.hop + 5] = False
    assert list(valid_blocks(valid, grid)) == [0, 1, 4, 5, 6, 7, 8]
    assert valid_blocks(valid[: grid.size - 1], grid).size == 0


def test_a_band_without_bins_is_refused() -> None:
    with pytest.raises(DataError):
        block_layout(RATE, (20.0, 600.0), notches=((20.0, 590.0),))
