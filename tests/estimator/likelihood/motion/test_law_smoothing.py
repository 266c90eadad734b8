"""Smoothed laws against the integral they stand for; tangents; the finer grid against a dense one."""

import ctypes
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import erf

from estimator.effects import CATALOGUE
from estimator.effects.engine.compiled import address
from estimator.effects.engine.law_loop import force_array
from estimator.likelihood.motion.law_smoothing import (
    MARGIN_ROWS,
    LawStates,
    decimated,
    has_jump,
    law_force,
    reads_states,
)

N, RATE = 20000, 25600.0


def state(sx: float = 0.0, sv: float = 0.0, f: float = 1125.0) -> LawStates:
    t = np.arange(N) / RATE
    rng = np.random.default_rng(0)
    w = 2 * np.pi * f
    a, b = rng.normal(size=2)
    x = 1e-7 * (a * np.cos(w * t) + b * np.sin(w * 1.01 * t))
    v = 1e-7 * w * (-a * np.sin(w * t) + 1.01 * b * np.cos(w * 1.01 * t))
    h = np.sqrt(3) * np.array([sx, sv, 0.0, 0.0])
    zero = np.zeros(N)
    return LawStates(x, v, zero, zero, t=t, phase=zero, s=1.0, h=h, valid=np.ones(N, bool))


def test_a_polynomial_is_smoothed_exactly() -> None:
    s = state(sx=2e-8)
    out, sums = law_force(CATALOGUE["cubic"], np.ones(1), s, np.array([True, False, False, False]))
    assert np.allclose(out, s.x**3 + 3 * s.x * (2e-8) ** 2, rtol=1e-9)  # E (x + e)^3
    assert sums[0] == pytest.approx(np.sum(3 * s.x**2 + 3 * (2e-8) ** 2), rel=1e-9)


def test_a_step_gets_the_density_of_its_argument_as_its_mean_tangent() -> None:
    sd = 5e-5
    s = replace(state(sv=sd), v=np.random.default_rng(1).normal(size=N) * 1e-3)
    sums = law_force(CATALOGUE["coulomb"], np.ones(1), s, np.array([False, True, False, False]))[1]
    wanted = np.sum(2 / np.sqrt(2 * np.pi) / sd * np.exp(-0.5 * (s.v / sd) ** 2))  # sum of d/dv erf
    assert sums[1] == pytest.approx(wanted, rel=0.1)
    out = law_force(CATALOGUE["coulomb"], np.ones(1), s, np.array([False, True, False, False]))[0]
    assert np.mean((out - erf(s.v / sd / np.sqrt(2))) ** 2) < 0.01


def test_what_a_law_reads_and_whether_it_jumps() -> None:
    scale = np.array([1e-7, 1e-3, 1e-7, 1e-3])
    one = np.ones(1)
    assert list(reads_states(CATALOGUE["cubic"], one, scale)) == [True, False, False, False]
    assert list(reads_states(CATALOGUE["displacement_damping"], one, scale)) == [True, True, False, False]
    assert list(reads_states(CATALOGUE["cross_coupling"], one, scale)) == [False, False, True, False]
    assert not has_jump(CATALOGUE["cubic"], one, scale)
    assert not has_jump(CATALOGUE["clearance"], np.array([1.0, 1.5e-7]), scale)
    assert has_jump(CATALOGUE["coulomb"], one, scale)


def test_the_finer_grid_takes_the_folded_harmonics_out() -> None:
    """sgn of a tone: its harmonics above the Nyquist frequency may not come back into the band."""
    f, dense = 1125.3, 64
    s = state(f=f)
    states = {key: np.ascontiguousarray(getattr(s, key)) for key in ("x", "v", "xo", "vo", "t", "phase")}
    wide = LawStates(**states, s=1.0, h=s.h * 0, valid=s.valid)
    fine = wide.finer(np.array([False, True, False, False]))
    out = decimated(law_force(CATALOGUE["coulomb"], np.ones(1), fine, np.array([False, True, False, False]))[0])
    assert out.size == N - 2 * MARGIN_ROWS
    inner = slice(MARGIN_ROWS, N - MARGIN_ROWS)
    at = np.arange(N * dense) / (RATE * dense)
    w, rng = 2 * np.pi * f, np.random.default_rng(0)
    a, b = rng.normal(size=2)
    v = -a * np.sin(w * at) + 1.01 * b * np.cos(w * 1.01 * at)
    true = np.fft.irfft(np.fft.rfft(np.sign(v))[: N // 2 + 1] / dense, N)[inner]
    window = np.hanning(out.size)
    keep = np.fft.rfftfreq(out.size, 1 / RATE) < 8000

    def error(z: np.ndarray) -> float:
        difference = np.fft.rfft((z - true) * window)[keep]
        return float(np.linalg.norm(difference) / np.linalg.norm(np.fft.rfft(true * window)[keep]))

    assert error(out) < 0.3 * error(np.sign(s.v)[inner])


@pytest.mark.parametrize("name", ["cubic", "hertz", "rub", "ball_pass", "gyroscopic"])
def test_a_law_in_its_loop_is_the_law_called_by_its_address(name: str) -> None:
    s = state()
    effect = CATALOGUE[name]
    p = np.array([q.default * (1e-7 if q.scale == "x" else 1.0) for q in effect.parameters])
    p[[q.linear for q in effect.parameters]] = 1.0
    out, _ = law_force(effect, p, replace(s, xo=s.x[::-1].copy(), vo=s.v[::-1].copy()), np.ones(4, bool))
    assert np.array_equal(out, force_array(effect, p, s.x, s.v, s.x[::-1], s.v[::-1], s.t, s.phase))
    assert effect.force is not None
    law = ctypes.CFUNCTYPE(*[ctypes.c_double] * 8, ctypes.c_void_p)(address(effect.force))
    rows = zip(s.x, s.v, s.x[::-1], s.v[::-1], s.t, s.phase, strict=True)
    assert np.array_equal(out, [law(*row, s.s, p.ctypes.data) for row in rows])


def test_signals_that_may_not_be_written_or_lie_apart() -> None:
    s, reads = state(sx=2e-8), np.array([True, False, False, False])
    apart = np.repeat(s.v, 2)[::2]
    s.x.flags.writeable = False
    out, sums = law_force(CATALOGUE["cubic"], np.ones(1), replace(s, v=apart), reads)
    assert np.allclose(out, s.x**3 + 3 * s.x * (2e-8) ** 2, rtol=1e-9)
    assert sums[0] > 0


def test_a_law_that_no_module_holds() -> None:
    def force(x, v, xo, vo, t, phase, s, p):  # type: ignore[no-untyped-def]
        return p[0] * x * x * x

    s = state(sx=2e-8)
    reads = np.array([True, False, False, False])
    kx = np.empty(N), np.empty(N)
    own, sums = law_force(replace(CATALOGUE["cubic"], force=force), np.ones(1), s, reads, kx)
    out, others = law_force(CATALOGUE["cubic"], np.ones(1), s, reads)
    assert np.allclose(own, out, rtol=1e-12)
    assert sums == pytest.approx(others)
    assert kx[0].sum() == pytest.approx(sums[0])
