"""Lines that move: found block by block, left out without bias, tracked by a tacho; the estimate through them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference_rig import PLACES, RATE, rig_model, rig_record, run_up_angle

from estimator.identification.rolling.estimator import RollingEstimator
from estimator.model.rig import Channel, Model
from estimator.results import Estimate
from estimator.signals.blocks import block_layout, block_spectra
from estimator.signals.moving_lines import MovingLines, bin_weights, line_bins
from estimator.signals.shaft_angle import ShaftAngle, shaft_angle

GRID = block_layout(RATE, (150.0, 8000.0))
SECONDS, RUN_UP = 14.0, (320.0, 460.0, 0.3)


def force_blocks(seconds: float, line: tuple[float, float, float] | None, seed: int) -> list[np.ndarray]:
    """(places, bins) of each block of white noise of PSD 1 at four places, with a line (Hz, Hz, amplitude)."""
    rng = np.random.default_rng(seed)
    n = int(seconds * RATE)
    y = rng.standard_normal((4, n)) * np.sqrt(RATE / 2)
    if line is not None:
        angle = run_up_angle(line, seconds, np.arange(n) / RATE)
        y += line[2] * np.cos(angle + np.arange(4)[:, None])
    blocks = np.arange((n - GRID.size) // GRID.hop + 1)
    return list(np.moveaxis(block_spectra(y, blocks, GRID), 1, 0))


def test_noise_has_hardly_ever_a_line() -> None:
    lines = MovingLines(GRID.f_hz)
    found = [lines(F) is not None for F in force_blocks(60.0, None, 1)]
    assert np.mean(found) < 0.02


def test_a_resonance_is_no_line() -> None:
    """A peak as wide as that of a bearing on its spring, 30 times over its surroundings."""
    f = GRID.f_hz
    shape = 1.0 / np.abs(1.0 - (f / 1125.0) ** 2 + 1j * 0.042 * f / 1125.0)
    lines = MovingLines(f)
    found = [lines(F * shape) is not None for F in force_blocks(30.0, None, 2)]
    assert np.mean(found) < 0.05


def test_what_is_left_out_is_made_up_for_by_its_neighbours() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        ratio = np.where(rng.random(600) < 0.02, rng.choice([20.0, 1e3, 1e6], 600), 0.0)
        out = line_bins(ratio)
        w = bin_weights(out)
        assert w[out].max(initial=0.0) == 0.0
        assert w.sum() == pytest.approx(600.0)
        slope = np.arange(600.0)
        if not out[:40].any() and not out[-40:].any():
            assert w @ slope == pytest.approx(slope.sum(), rel=5e-3)


def test_a_line_is_left_out_wherever_it_is_and_the_power_stays() -> None:
    line = (400.0, 600.0, 300.0)
    lines, clean = MovingLines(GRID.f_hz), force_blocks(20.0, None, 3)
    power, expected = 0.0, 0.0
    for b, (F, quiet) in enumerate(zip(force_blocks(20.0, line, 3), clean, strict=True)):
        w = lines(F)
        assert w is not None
        now = line[0] + (line[1] - line[0]) / 20.0 * (b + 1) * GRID.hop / RATE
        assert w[np.argmin(np.abs(GRID.f_hz - now))] == 0.0
        assert (w == 0.0).sum() < 20
        near = np.abs(GRID.f_hz - now) < 100.0
        power += float((np.abs(F) ** 2 * w)[:, near].sum())
        expected += float((np.abs(quiet) ** 2)[:, near].sum())
    assert power == pytest.approx(expected, rel=0.03)


def test_a_weak_line_is_tracked_with_the_speed_that_a_tacho_gives() -> None:
    """Too weak for one block, and too fast for an average by frequency."""
    line, seconds = (400.0, 640.0, 6.0), 20.0
    shares = []
    for orders in (False, True):
        lines = MovingLines(GRID.f_hz, orders)
        hit = []
        for b, F in enumerate(force_blocks(seconds, line, 5)):
            now = line[0] + (line[1] - line[0]) / seconds * (b + 1) * GRID.hop / RATE
            w = lines(F, now / 10.0 if orders else None)
            hit.append(w is not None and w[np.argmin(np.abs(GRID.f_hz - now))] == 0.0)
        shares.append(np.mean(hit[10:]))
    assert shares[1] > 0.8
    assert shares[1] > shares[0] + 0.3


def pulses(seconds: float) -> np.ndarray:
    """(n,) a tacho of the run-up's shaft: the line is its tenth order."""
    angle = run_up_angle(RUN_UP, seconds, np.arange(int(seconds * RATE)) / RATE) / 10.0
    return (np.mod(angle, 2 * np.pi) < 0.3).astype(float)


def with_tacho(model: Model) -> Model:
    return replace(model, channels=(*model.channels, Channel("tacho", "", "", "tacho")))


def test_the_angle_of_a_stream_is_that_of_the_record() -> None:
    y = pulses(6.0)
    whole = shaft_angle(y, RATE)
    stream = ShaftAngle(with_tacho(rig_model()), RATE)
    at, last = 0, None
    for k in range(0, len(y) - 1024, 1024):
        stream.push(np.stack([np.zeros(1024)] * 4 + [y[k : k + 1024]], axis=1))
        if k < 2 * RATE:
            continue
        at = k - int(1.5 * RATE)
        angle = stream.angle(at, k - 2048)
        assert angle is not None
        rest = angle - whole[at : k - 2048]
        assert np.ptp(rest) < 0.02
        assert last is None or abs(rest[0] - last) < 0.02
        last = rest[0]
        stream.drop(at)


def rolled(model: Model, y: np.ndarray) -> list[Estimate]:
    rolling, out = RollingEstimator(model, RATE, 10.0, watch=()), []
    for part in np.split(y, np.arange(1024, len(y), 1024)):
        rolling.update(part)
        out.append(rolling.snapshot())
    return out[::12]


@pytest.mark.slow
def test_a_run_up_does_not_disturb_the_estimate() -> None:
    """The shaft's tenth order, forty times the random force in its bin, rises through the band."""
    quiet = rolled(rig_model("cubic"), rig_record(SECONDS, seed=4))
    turning = rig_record(SECONDS, seed=4, run_up=RUN_UP)
    tacho = np.column_stack([turning, pulses(SECONDS)])
    for y, model in ((turning, rig_model("cubic")), (tacho, with_tacho(rig_model("cubic")))):
        estimates = rolled(model, y)
        for now, expected in zip(estimates, quiet, strict=True):
            assert bool(now.parameters) == bool(expected.parameters)
            for name in [f"{place}.{key}" for place in PLACES for key in ("kL", "c")] if now.parameters else []:
                a, b = now.parameters[name], expected.parameters[name]
                assert abs(a.value - b.value) < b.sd
                assert a.sd < 1.1 * b.sd
