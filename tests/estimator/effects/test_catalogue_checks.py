"""Each effect's own check: the value that its file names, from an independent formula."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import csd, welch

from estimator.effects import CATALOGUE
from estimator.effects.engine.law_loop import force_array
from estimator.effects.engine.memory_loop import memory_array
from estimator.model.bearing_theory import kinematics
from estimator.model.rig import BearingGeometry

A, W = 2e-7, 2 * np.pi * 1100.0
ANGLE = np.linspace(0.0, 2 * np.pi, 200001)[:-1]
X, V = A * np.cos(ANGLE), -A * W * np.sin(ANGLE)


def law(name: str, *p: float, **state: object) -> np.ndarray:
    return force_array(CATALOGUE[name], np.array(p), state.pop("x", X), **state)  # type: ignore[arg-type]


def stiffness(f: np.ndarray, harmonic: int = 1) -> float:
    """Cosine part of a harmonic of a force over the amplitude of x: the describing function."""
    return float(2 * np.mean(f * np.cos(harmonic * ANGLE)) / A)


def damping(f: np.ndarray) -> float:
    """Equivalent viscous damping: mean power over mean squared velocity."""
    return float(np.mean(f * V) / np.mean(V**2))


def test_odd_powers() -> None:
    assert stiffness(law("cubic", 1e18)) == pytest.approx(0.75 * 1e18 * A**2)
    assert stiffness(law("quintic", 1e31)) == pytest.approx(5 / 8 * 1e31 * A**4)


def test_cubic_raises_the_frequency_of_free_vibration() -> None:
    from scipy.integrate import quad

    k, k3 = 1e7, 2e19
    rise = 3 * k3 * A**2 / (8 * k)

    def slowness(s: float) -> float:  # exact period by the energy integral, x = A sin s
        return 1.0 / np.sqrt(k + 0.5 * k3 * A**2 * (1 + np.sin(s) ** 2))

    exact = (np.pi / 2 / quad(slowness, 0, np.pi / 2)[0]) / np.sqrt(k) - 1
    assert exact == pytest.approx(rise, rel=0.06)


def test_quadratic_makes_a_mean_and_a_second_harmonic() -> None:
    f = law("quadratic", 1e13)
    assert f.mean() == pytest.approx(0.5e13 * A**2)
    assert stiffness(f, 2) * A == pytest.approx(0.5e13 * A**2)
    assert stiffness(f) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("ratio", [0.1, 0.5, 0.9])
def test_clearance_and_stop_describing_functions(ratio: float) -> None:
    truth = 2 / np.pi * (np.arccos(ratio) - ratio * np.sqrt(1 - ratio**2))
    assert stiffness(law("clearance", 1e6, ratio * A)) == pytest.approx(1e6 * truth, rel=1e-6)
    for side in (1, -1):
        assert stiffness(law("stop", 1e6, side * ratio * A)) == pytest.approx(0.5e6 * truth, rel=1e-6)
        assert np.sign(law("stop", 1e6, side * ratio * A).mean()) == side


def test_hertz_small_displacements_and_the_rig_of_the_paper() -> None:
    k, g = 2.813e5 * 10**4.5, 0.2e-6  # N/mm^1.5 in SI
    x = np.linspace(-0.05, 0.05, 11) * g
    expected = -(9 / 64) * k * g**-1.5 * x**3
    np.testing.assert_allclose(law("hertz", k, g, 6.0, x=x), expected, rtol=0.01, atol=1e-9 * k * g**1.5)
    assert 4.5 * k * np.sqrt(g) == pytest.approx(1.80e7, rel=0.01)  # N/m, physics.md section 4
    whole = (
        law("hertz", k, g, 6.0, x=np.array([g * 0.999, g * 1.001]))
        + 4.5 * k * np.sqrt(g) * np.array([0.999, 1.001]) * g
    )
    softest = np.diff(whole)[0] / (0.002 * g) / (4.5 * k * np.sqrt(g))
    assert 0.70 < softest < 0.80
    # all six balls out of contact in a clearance but those on the loaded side
    loose = law("hertz", k, -g, 6.0, x=np.array([0.0, 0.9 * g, 2.0 * g]))
    assert loose[0] == loose[1] == 0.0
    assert loose[2] == pytest.approx(k * g**1.5)


def test_hertz_is_the_same_for_both_directions_of_an_isotropic_ring() -> None:
    k, g, r = 8.9e9, 0.3e-6, 0.2e-6
    th = np.deg2rad(np.arange(0, 360, 60) + 20.0)
    x, y = r * np.cos(th), r * np.sin(th)
    fx, fy = law("hertz", k, g, 6.0, x=x, xo=y), law("hertz", k, g, 6.0, x=y, xo=x, s=-1.0)
    radial = fx * np.cos(th) + fy * np.sin(th)
    np.testing.assert_allclose(radial, radial[0], rtol=1e-9)  # six-fold symmetry


@pytest.mark.parametrize("balls", [3, 7, 8, 40, 41])
def test_hertz_made_for_its_balls_is_the_law(balls: int) -> None:
    """What loops are made of does not read how many there are: of the wrong number it would go unnoticed."""
    hertz, p = CATALOGUE["hertz"], [8.9e9, 0.1e-6, float(balls)]
    assert hertz.force is not None
    assert hertz.for_given is not None
    own = hertz.for_given(p)
    for s in (1.0, -1.0):
        state = (0.3e-6, 0.0, -0.2e-6, 0.0, 0.0, 0.0, s)
        assert own(*state, p) == hertz.force(*state, p) == own(*state, [*p[:2], 5.0])


def test_friction_and_nonlinear_damping() -> None:
    assert damping(law("coulomb", 0.05, v=V)) == pytest.approx(4 * 0.05 / (np.pi * W * A), rel=1e-6)
    assert damping(law("quadratic_damping", 2e3, v=V)) == pytest.approx(8 * 2e3 * W * A / (3 * np.pi), rel=1e-6)
    assert damping(law("displacement_damping", 1e15, v=V)) == pytest.approx(1e15 * A**2 / 4, rel=1e-6)
    rng = np.random.default_rng(0)
    x, v = 1e-7 * rng.normal(size=1_000_000), 1e-3 * rng.normal(size=1_000_000)
    for name, p, truth in (
        ("quadratic_damping", 2e3, 2e3 * np.sqrt(8 / np.pi) * 1e-3),
        ("displacement_damping", 1e15, 10.0),
    ):
        f = law(name, p, x=x, v=v)
        assert np.mean(f * v) / np.mean(v**2) == pytest.approx(truth, rel=0.01)


def test_bouc_wen_slips_and_encloses_a_loop() -> None:
    k, slip, n = 1e6, 2e-8, 20000
    t = np.arange(10 * n) / n * 2 * np.pi / W
    x, v = A * np.sin(W * t), A * W * np.cos(W * t)
    f = memory_array(CATALOGUE["bouc_wen"], np.array([k, slip]), np.zeros(3), x, v, n * W / (2 * np.pi))
    assert np.max(f) == pytest.approx(k * slip, rel=0.01)
    loop = np.trapezoid(f[-n - 1 :], x[-n - 1 :])
    assert loop == pytest.approx(4 * k * slip * A, rel=0.15)
    small = memory_array(CATALOGUE["bouc_wen"], np.array([k, 1.0]), np.zeros(3), x, v, n * W / (2 * np.pi))
    np.testing.assert_allclose(small, k * x, atol=1e-5 * k * A)


def test_pedestal_against_its_transfer_function() -> None:
    m, kL, c = 0.2, 1e7, 60.0
    mp, fp, zeta = 0.4, 1500.0, 0.05
    w0, rate = 2 * np.pi * fp, 2e6
    for f in (300.0, 1400.0, 4000.0):
        w = 2 * np.pi * f
        t = np.arange(round(0.05 * rate)) / rate
        x, v = A * np.cos(w * t), -A * w * np.sin(w * t)
        force = memory_array(CATALOGUE["pedestal"], np.array([mp, fp, zeta]), np.array([m, kL, c]), x, v, rate)
        last = t > 0.05 - round(0.02 * f) / f - 1e-9
        found = 2 * np.mean((force * np.exp(-1j * w * t))[last]) / A
        kc = kL + 1j * w * c
        truth = -(kc**2) / (kc + mp * (w0**2 - w**2) + 2j * zeta * mp * w0 * w)
        assert found == pytest.approx(truth, rel=5e-3)
    stiff = memory_array(CATALOGUE["pedestal"], np.array([mp, 1e5, zeta]), np.array([m, kL, c]), x, v, 1e8)
    assert np.abs(stiff).max() < 0.02 * kL * A


@pytest.mark.parametrize("name", ["imbalance", "bow"])
def test_rotating_forces_rotate_forward(name: str) -> None:
    zero = 0.0 * ANGLE
    fx, fy = (-law(name, 0.3, -0.4, x=zero, phase=ANGLE, s=s) for s in (1.0, -1.0))
    in_shaft_frame = (fx + 1j * fy) * np.exp(-1j * ANGLE)
    np.testing.assert_allclose(in_shaft_frame, 0.3 - 0.4j, atol=1e-12)


def harmonics(f: np.ndarray, n: int) -> np.ndarray:
    return 2 * np.abs(np.fft.rfft(f))[: n + 1] / len(f)


def test_orders_of_shaft_synchronous_laws() -> None:
    zero, one = 0.0 * ANGLE, 0.0 * ANGLE + A
    lines = harmonics(law("misalignment", 0.3, 0.4, x=zero, phase=ANGLE), 5)
    np.testing.assert_allclose(lines, [0, 0, 0.5, 0, 0, 0], atol=1e-9)
    lines = harmonics(law("crack", 1e5, 3e4, 4e4, x=one, phase=ANGLE), 3)
    np.testing.assert_allclose(lines, np.array([2e5, 5e4, 0, 0]) * A, atol=1e-9)
    # a tone at order 10: sidebands of equal size at 10 +- 2
    tone = A * np.cos(10 * ANGLE)
    lines = harmonics(law("ball_pass", 3e5, 4e5, 2.0, x=tone, phase=ANGLE), 14)
    np.testing.assert_allclose(lines[[8, 10, 12]], np.array([2.5e5, 0, 2.5e5]) * A, atol=1e-9)


def test_strikes_of_a_local_defect() -> None:
    order, width = 3.0, 0.05
    f = law("local_defect", -2.0, order, 0.4, width, x=0.0 * ANGLE, phase=ANGLE)
    assert f.max() == pytest.approx(2.0, rel=1e-3)
    assert ANGLE[np.argmax(f)] % (2 * np.pi / order) == pytest.approx(0.4 / 3, abs=1e-4)
    lines = harmonics(f, 30)
    n = np.arange(1, 11)
    truth = 2 * 2.0 * width / (2 * np.pi) / np.sqrt(1 + (n * width) ** 2)
    np.testing.assert_allclose(lines[3 * n], truth, rtol=1e-3)
    np.testing.assert_allclose(np.delete(lines, np.arange(0, 31, 3)), 0.0, atol=1e-3 * truth[0])


def test_symmetric_and_antisymmetric_coupling() -> None:
    zero = np.zeros(1)
    for name, column in (("cross_coupling", [5.0, -5.0]), ("anisotropy", [5.0, 5.0])):
        assert [law(name, 5.0, x=zero, xo=1.0, s=s)[0] for s in (1.0, -1.0)] == column
    K = np.array([[1e7, 2e5], [2e5, 1e7]])
    np.testing.assert_allclose(np.linalg.eigvalsh(K), [1e7 - 2e5, 1e7 + 2e5])


def test_kinematic_orders_of_the_rig_of_the_paper() -> None:
    assert kinematics(BearingGeometry(6, 6e-3, 20e-3, 3.09e-3)) == pytest.approx(
        {"FTF": 0.350, "BPFO": 2.100, "BPFI": 3.900, "BSF": 1.517}, abs=5e-4
    )


def test_sensors_do_what_they_say() -> None:
    rng, rate = np.random.default_rng(1), 25600.0
    y = rng.normal(size=200_000)

    def sensed(name: str, *p: float) -> np.ndarray:
        apply = CATALOGUE[name].apply
        assert apply is not None
        return np.asarray(apply(y, rate, np.array(p), np.random.default_rng(2)))

    assert sensed("sensor_gain", 0.1).std() == pytest.approx(1.1 * y.std())
    np.testing.assert_array_equal(sensed("sensor_gain", -2.0), -y)
    clipped = sensed("sensor_clipping", 1.5)
    assert np.abs(clipped).max() == 1.5
    np.testing.assert_array_equal(clipped[np.abs(y) < 1.5], y[np.abs(y) < 1.5])
    noisy = sensed("sensor_noise", 0.3) - y
    assert noisy.std() == pytest.approx(0.3, rel=0.01)
    level = welch(noisy, rate, nperseg=1024)[1][1:-1]
    assert level.mean() == pytest.approx(0.09 / (rate / 2), rel=0.02)
    assert level.std() < 0.2 * level.mean()

    f, cross = csd(y, sensed("sensor_skew", 2e-5), rate, nperseg=1024)
    keep = slice(5, 480)
    np.testing.assert_allclose(np.unwrap(np.angle(cross[keep])), -2 * np.pi * f[keep] * 2e-5, atol=0.02)
    f, cross = csd(y, sensed("sensor_resonance", 5000.0, 10.0), rate, nperseg=4096)
    gain = cross / welch(y, rate, nperseg=4096)[1]
    r = f / 5000.0
    truth = 1 / (1 - r**2 + 0.1j * r)
    np.testing.assert_allclose(gain[10:-10], truth[10:-10], rtol=0.1)
    assert np.abs(gain[np.argmin(np.abs(f - 5000))]) == pytest.approx(10, rel=0.05)
    np.testing.assert_allclose(sensed("sensor_skew", 1 / rate)[100:-100], y[99:-101], atol=1e-6)


def test_stribeck_friction_of_a_gaussian_velocity() -> None:
    fc, df, vs, sigma = 0.05, 0.08, 7e-4, 1.3e-3
    v = sigma * np.sqrt(2.0) * np.linspace(-6.0, 6.0, 400001)
    weight = np.exp(-0.5 * (v / sigma) ** 2)
    f = law("stribeck", fc, df, vs, x=0.0 * v, v=v)
    expected = np.sqrt(2 / np.pi) * (fc / sigma + df / (sigma * (1 + 2 * sigma**2 / vs**2)))
    assert np.sum(weight * f * v) / np.sum(weight * v**2) == pytest.approx(expected, rel=1e-6)
    assert law("stribeck", fc, df, vs, x=np.zeros(2), v=np.array([1e-9, 1.0])) == pytest.approx([fc + df, fc])
