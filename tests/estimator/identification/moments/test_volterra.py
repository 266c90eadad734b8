from __future__ import annotations

import numpy as np
import pytest

from estimator.errors import DataError
from estimator.identification.moments import volterra
from estimator.identification.moments.volterra import Kernels, first_wiener_kernel, nearest_kernels
from estimator.model.rig import Channel, EffectUse, Model, Setting

RATE = 25600.0
TRUE = Kernels(0.2, 60.0, 1.0e7, 1.3e18)


def driven(force: np.ndarray, kernels: Kernels, sub: int = 4) -> np.ndarray:
    """(n, 3) x, v, a under a force held over each sample, by RK4 written here."""
    import numba

    @numba.njit
    def run(force, m, c, k, kNL, dt, sub):  # type: ignore[no-untyped-def]
        out = np.empty((len(force), 3))
        x = v = 0.0
        h = dt / sub
        for i in range(len(force)):
            F = force[i]
            out[i] = x, v, (F - c * v - k * x - kNL * x**3) / m
            for _ in range(sub):
                a1 = (F - c * v - k * x - kNL * x**3) / m
                x2, v2 = x + h / 2 * v, v + h / 2 * a1
                a2 = (F - c * v2 - k * x2 - kNL * x2**3) / m
                x3, v3 = x + h / 2 * v2, v + h / 2 * a2
                a3 = (F - c * v3 - k * x3 - kNL * x3**3) / m
                x4, v4 = x + h * v3, v + h * a3
                a4 = (F - c * v4 - k * x4 - kNL * x4**3) / m
                x += h / 6 * (v + 2 * v2 + 2 * v3 + v4)
                v += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        return out

    return np.asarray(run(force, kernels.m, kernels.c, kernels.k, kernels.kNL, 1.0 / RATE, sub))


def smooth_force(n: int, seed: int, rms: float) -> np.ndarray:
    """White force over 100-9000 Hz; what a hammer or shaker with its amplifier gives."""
    spectrum = np.fft.rfft(np.random.default_rng(seed).standard_normal(n))
    f = np.fft.rfftfreq(n, 1.0 / RATE)
    force = np.fft.irfft(np.where((f > 100.0) & (f < 9000.0), spectrum, 0.0), n)
    return np.asarray(force * rms / np.std(force))


def test_harmonic_probing_against_the_integrated_equation() -> None:
    """Under F cos(wt): third harmonic |H3(w,w,w)| F^3/4, fundamental |H1 + (3/4) F^2 H3(w,w,-w)| F."""
    w = 2.0 * np.pi * 640.0
    t = np.arange(20_000) / RATE / 4
    fine = Kernels(TRUE.m, TRUE.c, TRUE.k, TRUE.kNL)
    import scipy.integrate

    F = 0.9
    solution = scipy.integrate.solve_ivp(
        lambda s, u: [u[1], (F * np.cos(w * s) - fine.c * u[1] - fine.k * u[0] - fine.kNL * u[0] ** 3) / fine.m],
        (0.0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-9, atol=[1e-15, 1e-11],
    )  # fmt: skip
    use = slice(12_000, 20_000)  # after the transient, whole periods: 8000 samples are 50 of them
    x = solution.y[0, use]
    first = 2.0 * np.mean(x * np.exp(-1j * w * t[use]))
    third = 2.0 * np.mean(x * np.exp(-3j * w * t[use]))
    one = np.array([w])
    assert third == pytest.approx(fine.h3(one, one, one)[0] * F**3 / 4.0, rel=0.02)
    assert first == pytest.approx(fine.h1(one)[0] * F + 0.75 * F**3 * fine.h3(one, one, -one)[0], rel=2e-4)


@pytest.mark.slow
def test_identify_from_a_measured_white_force() -> None:
    force = smooth_force(6 * 25600, 1, 0.6)
    x = driven(force, TRUE)[:, 0]
    x = x + 0.01 * np.std(x) * np.random.default_rng(2).standard_normal(len(x))
    # the record holds F over each sample: half a sample of delay, which the band-limited force must share
    shifted = np.fft.irfft(np.fft.rfft(force) * np.exp(-1j * np.pi * np.fft.rfftfreq(len(force))), len(force))
    found, cov, left = nearest_kernels(x, shifted, RATE, (150.0, 8000.0), None, np.ones(len(x), bool))
    sd = np.sqrt(np.diag(cov))
    truth = [TRUE.k, TRUE.c, TRUE.kNL, TRUE.m]
    for value, true, s in zip([found.k, found.c, found.kNL, found.m], truth, sd, strict=True):
        assert abs(value - true) < max(4.0 * s, 4e-3 * true)
        assert s < 0.1 * true
    assert found.kNL == pytest.approx(TRUE.kNL, rel=0.05)
    assert left < 0.03


@pytest.mark.slow
def test_the_first_wiener_kernel_is_stiffer_than_the_volterra_one() -> None:
    """G-functionals: K1 is H1 at k + 3 kNL E[x^2] (Gaussian closure), here 6 % stiffer."""
    strong = Kernels(0.2, 60.0, 1.0e7, 1.2e19)
    force = smooth_force(12 * 25600, 3, 0.6)
    x = driven(force, strong)[:, 0]
    f, h = first_wiener_kernel(x, force, RATE)
    near = (f > 500.0) & (f < 1000.0)  # below the resonance, where 1/H is k - m w^2
    stiff = np.mean((1.0 / h[near]).real + strong.m * (2 * np.pi * f[near]) ** 2)
    expected = strong.k + 3.0 * strong.kNL * np.mean(x**2)
    assert expected > 1.05 * strong.k
    assert stiff == pytest.approx(expected, rel=0.015)


def rig(kinds: tuple[str, ...] = ("acceleration", "force"), mass: bool = True) -> Model:
    channels = tuple(Channel(f"b1x_{k}", "bearing1", "x", k) for k in kinds)
    cubic = EffectUse("cubic", {"bearing1.x": {"kNL": Setting()}})
    return Model(channels, (150.0, 8000.0), mass={"bearing1": 0.2} if mass else {}, effects=(cubic,))


@pytest.mark.parametrize("mass", [True, False])
def test_fit_with_a_force_channel_and_a_gap(mass: bool) -> None:
    from estimator.simulation.simulator import Simulator

    linear = {"bearing1.x": {"kL": Setting(1.0e7), "c": Setting(60.0), "S": Setting(9e-5)}}
    truth = Model(
        rig().channels, (150.0, 8000.0), mass={"bearing1": 0.2}, linear=linear,
        effects=(EffectUse("cubic", {"bearing1.x": {"kNL": Setting(1.3e18)}}),),
    )  # fmt: skip
    y = Simulator(truth, RATE, seed=4).next(6 * 25600)
    y[70_000:70_005] = np.nan
    found = volterra.fit_volterra(rig(mass=mass), y, RATE)
    assert found.method == "volterra"
    p = found.parameters
    assert p["bearing1.x.kL"].value == pytest.approx(1e7, rel=5e-3)
    assert p["bearing1.x.c"].value == pytest.approx(60.0, rel=0.03)
    assert p["bearing1.x.cubic.kNL"].value == pytest.approx(1.3e18, rel=0.1)
    assert ("bearing1.x.m" in p) == (not mass)
    if not mass:
        assert p["bearing1.x.m"].value == pytest.approx(0.2, rel=5e-3)


def test_bad_records_are_named() -> None:
    y = np.random.default_rng(1).standard_normal((60_000, 2))
    with pytest.raises(DataError, match='kind "force"'):
        volterra.fit_volterra(rig(("acceleration", "velocity")), y, RATE)
    with pytest.raises(DataError, match="usable samples"):
        volterra.fit_volterra(rig(), y[:9000], RATE)
    force = smooth_force(60_000, 5, 0.6)
    a = driven(force, TRUE)[:, 2]
    with pytest.raises(DataError, match="sign"):
        volterra.fit_volterra(rig(mass=False), np.stack([-a, force], axis=1), RATE)
