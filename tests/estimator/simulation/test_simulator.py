"""The simulator against independent computations: scipy's integrator, exact covariances, densities and responses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import solve_discrete_lyapunov
from scipy.signal import csd, freqz, welch

from estimator.effects import CATALOGUE
from estimator.effects.engine.law_loop import force_array
from estimator.errors import ModelError
from estimator.model.rig import Channel, EffectUse, Model, Setting
from estimator.model.rotor import assemble, linear_covariance, propagator
from estimator.simulation.plan import simulation_plan
from estimator.simulation.shaft_speed import ShaftSpeed
from estimator.simulation.simulator import Simulator, antialias_taps, quantise, simulate
from estimator.simulation.stepper import Stepper

RATE = 25600.0


def use(name: str, at: tuple[str, ...], **values: float) -> EffectUse:
    return EffectUse(name, {place: {k: Setting(v) for k, v in values.items()} for place in at})


def two_bearings(*effects: EffectUse, **changes: object) -> Model:
    linear = {
        "bearing1.x": (10.0e6, 60.0, 9e-5),
        "bearing2.x": (11.0e6, 65.0, 8e-5),
        "bearing1.y": (9.2e6, 55.0, 9e-5),
        "bearing2.y": (10.4e6, 58.0, 8e-5),
    }
    model = Model(
        channels=tuple(Channel(p, *p.split(".")) for p in linear),
        band=(150.0, 8000.0),
        shaft="chain",
        mass={"disc": 0.515, "bearing1": 0.2, "bearing2": 0.2},
        shaft_stiffness=155e3,
        shaft_damping=0.5,
        speed_rpm=2100.0,
        linear={p: dict(zip(("kL", "c", "S"), map(Setting, v), strict=True)) for p, v in linear.items()},
        effects=effects,
    )
    return replace(model, **changes)  # type: ignore[arg-type]


def one_bearing(*effects: EffectUse, kL: float = 1e7, c: float = 60.0, S: float = 9e-5, **changes: object) -> Model:
    values: Mapping[str, Setting] = {"kL": Setting(kL), "c": Setting(c), "S": Setting(S)}
    model = Model(
        channels=(Channel("a", "bearing1", "x"),),
        band=(150.0, 8000.0),
        mass={"bearing1": 0.2},
        speed_rpm=2100.0,
        linear={"bearing1.x": values},
        effects=effects,
    )
    return replace(model, **changes)  # type: ignore[arg-type]


# -- the steps -------------------------------------------------------------------------------------------------------

STRONG = (
    use("cubic", ("bearing1.x", "bearing2.y"), kNL=2e18),
    use("quadratic_damping", ("bearing1.x",), cq=5e3),
    use("cross_coupling", ("bearing2",), k=8e5),
    use("ball_pass", ("bearing1.y",), k_cos=2e6, k_sin=1e6, order=2.1),
    use("crack", ("disc",), loss=2e4, loss_cos=1e4, loss_sin=1e4),
    use("pedestal", ("bearing2.x",), mass=0.5, frequency=1500.0, damping=0.05),
)


def run(model: Model, factor: int, seconds: float, start: np.ndarray) -> np.ndarray:
    """Free motion from `start` (x, v over the degrees of freedom) with factor * 25600 steps a second."""
    stepper = Stepper(simulation_plan(model), 1.0 / (RATE * factor), ShaftSpeed(2100.0))
    n = len(start) // 2
    stepper.x[:n], stepper.v[:n] = start[:n], start[n:]
    steps = round(seconds * RATE * factor)
    stepper.step(np.zeros((steps, n + 1)), np.empty((len(stepper.plan.channels), steps)))
    return np.concatenate([stepper.x[:n], stepper.v[:n]])


def exact_path(model: Model, seconds: float, start: np.ndarray) -> np.ndarray:
    """The same by scipy, from laws and matrices put together here."""
    rig = assemble(model)
    n = len(rig.dofs)
    d = {name: i for i, name in enumerate(rig.dofs)}
    w = 2 * np.pi * 1500.0
    k2, c2 = 11.0e6, 65.0

    def flow(t: float, u: np.ndarray) -> np.ndarray:
        x, v, (z, dz) = u[:n], u[n : 2 * n], u[2 * n :]
        phase = 2 * np.pi * 35.0 * t
        f = np.zeros(n)
        f[d["bearing1.x"]] += 2e18 * x[d["bearing1.x"]] ** 3 + 5e3 * v[d["bearing1.x"]] * abs(v[d["bearing1.x"]])
        f[d["bearing2.y"]] += 2e18 * x[d["bearing2.y"]] ** 3
        f[d["bearing2.x"]] += 8e5 * x[d["bearing2.y"]]
        f[d["bearing2.y"]] -= 8e5 * x[d["bearing2.x"]]
        f[d["bearing1.y"]] += (2e6 * np.cos(2.1 * phase) + 1e6 * np.sin(2.1 * phase)) * x[d["bearing1.y"]]
        for direction in "xy":
            i, j, k = (d[f"{node}.{direction}"] for node in ("disc", "bearing1", "bearing2"))
            pull = -(2e4 + 1e4 * np.cos(phase) + 1e4 * np.sin(phase)) * (x[i] - 0.5 * (x[j] + x[k]))
            f[i] += pull
            f[j] -= 0.5 * pull
            f[k] -= 0.5 * pull
        i = d["bearing2.x"]
        f[i] += -k2 * z - c2 * dz
        push = k2 * (x[i] - z) + c2 * (v[i] - dz)
        a = np.linalg.solve(rig.M, -f - rig.K @ x - rig.C @ v)
        return np.concatenate([v, a, [dz, push / 0.5 - w * w * z - 2 * 0.05 * w * dz]])

    u0 = np.concatenate([start, [0.0, 0.0]])
    return solve_ivp(flow, (0, seconds), u0, method="DOP853", rtol=1e-12, atol=1e-20).y[: 2 * n, -1]


@pytest.mark.slow
def test_order_of_convergence() -> None:
    """Every kind of effect at once: cap, memory, shaft, circulating, parametric."""
    factors = (8, 16, 32)
    model = two_bearings(*STRONG)
    rng = np.random.default_rng(2)
    start = np.concatenate([3e-7 * rng.normal(size=6), 2e-3 * rng.normal(size=6)])
    scale = np.repeat([3e-7, 2e-3], 6)
    truth = exact_path(model, 0.005, start)
    errors = [np.max(np.abs(run(model, f, 0.005, start) - truth) / scale) for f in factors]
    slope = -np.polyfit(np.log(factors), np.log(errors), 1)[0]
    assert slope == pytest.approx(2.0, abs=0.25), errors
    assert errors[0] < 5e-3


def test_energy_is_kept_without_damping() -> None:
    """55 periods of the bearing mode with a cubic, to 1e-8 of the energy."""
    k3 = 2e18
    free = two_bearings(
        use("cubic", ("bearing1.x", "bearing2.x", "bearing1.y", "bearing2.y"), kNL=k3), shaft_damping=0.0
    )
    linear = {p: {**s, "c": Setting(0.0)} for p, s in free.linear.items()}
    model = replace(free, linear=linear)
    rig = assemble(model)
    caps = [i for i, dof in enumerate(rig.dofs) if dof.startswith("bearing")]

    def energy(u: np.ndarray) -> float:
        x, v = u[:6], u[6:]
        return float(0.5 * v @ rig.M @ v + 0.5 * x @ rig.K @ x + 0.25 * k3 * np.sum(x[caps] ** 4))

    rng = np.random.default_rng(3)
    start = np.concatenate([2e-7 * rng.normal(size=6), 1.4e-3 * rng.normal(size=6)])
    assert abs(energy(run(model, 512, 0.05, start)) / energy(start) - 1.0) < 1e-8


def test_the_exponential_scheme_is_exact_for_the_linear_rotor_at_any_step() -> None:
    model = two_bearings()
    start = np.random.default_rng(4).normal(size=12)
    rig = assemble(model)
    E, _, _ = propagator(rig.M, rig.C, rig.K, 0.01)
    for factor in (2, 16):
        np.testing.assert_allclose(run(model, factor, 0.01, start), E @ start, rtol=1e-9, atol=1e-6)


# -- stationary state and levels -------------------------------------------------------------------------------------


def test_held_noise_gives_the_exact_linear_covariance() -> None:
    """No sampling error: the discrete Lyapunov equation of the scheme against the continuous one."""
    rig = assemble(two_bearings())
    Q = np.diag(rig.S / 2)
    truth = linear_covariance(rig.M, rig.C, rig.K, Q)
    for oversample, tolerance in ((8, 4e-4), (16, 1e-4)):
        dt = 1.0 / (RATE * oversample)
        E, G0, _ = propagator(rig.M, rig.C, rig.K, dt)
        scale = 1.0 / np.sqrt(np.diag(truth))
        E, G0 = E * scale[:, None] / scale, G0 * scale[:, None]
        held = solve_discrete_lyapunov(E, G0 @ Q @ G0.T / dt)
        assert np.max(np.abs(held - truth * np.outer(scale, scale))) < tolerance


def test_simulated_variance_is_that_of_lyapunov() -> None:
    kinds = ("displacement", "velocity")
    model = two_bearings()
    channels = tuple(Channel(f"{c.name}.{k}", c.node, c.direction, k) for k in kinds for c in model.channels)
    y = simulate(replace(model, channels=channels), RATE, 20.0, seed=6)
    rig = assemble(model)
    P = linear_covariance(rig.M, rig.C, rig.K, np.diag(rig.S / 2))
    for i, c in enumerate(channels):
        j = rig.index(c.place) + (6 if c.kind == "velocity" else 0)
        blocks = np.var(y[:, i].reshape(100, -1), axis=1)
        assert abs(blocks.mean() - P[j, j]) < 4 * blocks.std() / 10, c.name


@pytest.mark.parametrize("kind", ["acceleration", "velocity", "displacement"])
def test_spectrum_level_is_s_times_the_response_squared(kind: str) -> None:
    model = two_bearings()
    channels = tuple(replace(c, kind=kind) for c in model.channels[:2])
    y = simulate(replace(model, channels=channels), RATE, 30.0, seed=7)
    f, found = welch(y[:, 0], RATE, nperseg=4096)
    keep = (f > 300) & (f < 10000)
    rig = assemble(model)
    w = 2 * np.pi * f[keep][:, None, None]
    D = rig.K + 1j * w * rig.C - w**2 * rig.M
    H = np.linalg.inv(D)[:, rig.index("bearing1.x"), :]
    power = {"acceleration": 4, "velocity": 2, "displacement": 0}[kind]
    truth = (2 * np.pi * f[keep]) ** power * (np.abs(H) ** 2 @ rig.S)
    ratio = found[keep] / truth
    away = np.abs(f[keep] - 1140) > 150  # the window smears the peak itself
    averages = 2 * 30.0 * RATE / 4096
    assert ratio[away].mean() == pytest.approx(1.0, abs=0.01)
    assert ratio[away].std() < 2.0 / np.sqrt(averages)


def test_measured_force_and_motion_are_in_step() -> None:
    """The response found from the two channels is the analytic one in size and phase up to the band's edge."""
    channels = (Channel("a", "bearing1", "x"), Channel("f", "bearing1", "x", "force"))
    y = simulate(one_bearing(channels=channels), RATE, 20.0, seed=8, oversample=16)
    f, cross = csd(y[:, 1], y[:, 0], RATE, nperseg=8192)
    _, force = welch(y[:, 1], RATE, nperseg=8192)
    keep = (f > 200) & (f < 11000) & (np.abs(f - 1125) > 100)
    w = 2 * np.pi * f[keep]
    truth = -(w**2) / (1e7 - 0.2 * w**2 + 60j * w)
    error = cross[keep] / force[keep] / truth - 1.0
    assert np.max(np.abs(error)) < 0.02
    assert force[(f > 200) & (f < 11000)].mean() == pytest.approx(9e-5, rel=0.01)


@pytest.mark.parametrize("name", ["cubic", "hertz"])
def test_displacement_density_is_that_of_boltzmann(name: str) -> None:
    """One bearing driven far into its nonlinearity: moments of x against quadrature of exp(-V/T)."""
    T = 9e-5 / (4 * 300.0)
    sigma = np.sqrt(T / 1e7)
    if name == "cubic":
        p: dict[str, float] = {"kNL": 1e7 / (3 * sigma**2)}
        effects = (use("cubic", ("bearing1.x",), **p),)
        model = one_bearing(*effects, c=300.0)
    else:
        p = {"k": 1e7 / (4.5 * np.sqrt(sigma)), "preload": sigma}
        both = {d: {"kL": Setting(1e7), "c": Setting(300.0), "S": Setting(9e-5)} for d in ("bearing1.x", "bearing1.y")}
        channels = (Channel("a", "bearing1", "x"), Channel("b", "bearing1", "y"))
        model = one_bearing(use("hertz", ("bearing1",), **p), linear=both, channels=channels)
    model = replace(model, channels=tuple(replace(c, kind="displacement") for c in model.channels))
    x = simulate(model, RATE, 10.0, seed=9)[:, 0]
    grid = np.linspace(-8, 8, 801) * sigma
    values = np.array([*p.values(), 6.0][: len(CATALOGUE[name].parameters)])
    if name == "cubic":
        V = 0.5e7 * grid**2 + np.concatenate([[0], np.cumsum(_middle(force_array(CATALOGUE[name], values, grid)))]) * (
            grid[1] - grid[0]
        )
        density = np.exp(-(V - V.min()) / T)
    else:
        X, Y = np.meshgrid(grid, grid, indexing="ij")
        V = 0.5e7 * (X**2 + Y**2) - 0.5 * 4.5 * values[0] * np.sqrt(sigma) * (X**2 + Y**2)
        for j in range(6):
            V += values[0] / 2.5 * np.maximum(sigma + X * np.cos(j * np.pi / 3) + Y * np.sin(j * np.pi / 3), 0) ** 2.5
        density = np.exp(-(V - V.min()) / T).sum(axis=1)
    density /= density.sum()
    for power in (2, 4):
        truth = np.sum(density * grid**power)
        blocks = np.mean((x**power).reshape(64, -1), axis=1)
        assert abs(blocks.mean() - truth) < 4 * blocks.std() / 8
        assert blocks.std() / 8 < (0.015 if power == 2 else 0.04) * truth
    assert abs(np.sum(density * grid**2) / sigma**2 - 1) > 0.1, "it must be off the linear rotor to mean anything"


def _middle(a: np.ndarray) -> np.ndarray:
    return 0.5 * (a[1:] + a[:-1])


def test_the_start_is_a_boltzmann_sample_of_the_whole_rotor() -> None:
    """Disc mode included, which would need hours to relax: 200 starts against a grid over both caps."""
    T, c = 3e-7, 60.0
    linear = {p: {"kL": Setting(1e6), "c": Setting(c), "S": Setting(4 * T * c)} for p in ("bearing1.x", "bearing2.x")}
    k3 = 1e6 / (3 * T / 1e6)
    model = two_bearings(
        use("cubic", ("bearing1.x", "bearing2.x"), kNL=k3),
        linear=linear,
        channels=tuple(Channel(p, *p.split(".")) for p in linear),
        shaft_damping=0.0,
        shaft_stiffness=1e6,
    )
    starts = []
    for seed in range(200):
        s = Simulator(model, RATE, seed, oversample=2)._step  # noqa: SLF001
        starts.append(s.x[:3])
    x = np.array(starts)
    grid = np.linspace(-5, 5, 401) * np.sqrt(T / 1e6)
    X, Y = np.meshgrid(grid, grid, indexing="ij")
    V = 0.5e6 * (X**2 + Y**2) + 0.25 * k3 * (X**4 + Y**4) + 0.25e6 * (X - Y) ** 2
    density = np.exp(-V / T)
    density /= density.sum()
    disc = T / 2e6 + np.sum(density * ((X + Y) / 2) ** 2)  # disc about the mean of the caps
    for found, truth in ((x[:, 0], np.sum(density * X**2)), (x[:, 1], np.sum(density * Y**2)), (x[:, 2], disc)):
        assert np.mean(found**2) == pytest.approx(truth, rel=4 * np.sqrt(2 / 200))
    assert np.mean(x[:, 0] * x[:, 1]) == pytest.approx(np.sum(density * X * Y), abs=4 * np.sum(density * X**2) / 14)


# -- a device --------------------------------------------------------------------------------------------------------


def test_chunks_of_any_size_are_the_same_record() -> None:
    model = two_bearings(
        use("cubic", ("bearing1.x",), kNL=1e18),
        use("coloured_excitation", ("bearing1.y",), gain=3.0, corner=800.0),
        use("sensor_noise", ("bearing2.x",), rms=0.5),
        use("sensor_resonance", ("bearing2.y",), frequency=5000.0, quality=10.0),
    )
    whole = Simulator(model, RATE, seed=10).next(6000)
    parts = Simulator(model, RATE, seed=10)
    again = np.concatenate([parts.next(n) for n in (1, 0, 7, 1024, 3000, 1968)])
    assert np.array_equal(whole, again)
    assert not np.array_equal(whole, Simulator(model, RATE, seed=11).next(6000))


def test_sensor_effects_change_the_channel_and_not_the_motion() -> None:
    clean = simulate(two_bearings(), RATE, 0.3, seed=12)
    for name, values in (
        ("sensor_gain", {"error": 0.2}),
        ("sensor_clipping", {"level": 20.0}),
        ("sensor_skew", {"delay": 1e-5}),
        ("sensor_noise", {"rms": 1.0}),
    ):
        y = simulate(two_bearings(use(name, ("bearing2.x",), **values)), RATE, 0.3, seed=12)
        assert np.array_equal(y[:, [0, 2, 3]], clean[:, [0, 2, 3]])
        assert not np.array_equal(y[:, 1], clean[:, 1])
    by_channel = simulate(two_bearings(use("sensor_gain", ("bearing2.x",), error=-2.0)), RATE, 0.1, seed=12)
    np.testing.assert_allclose(by_channel[:, 1], -clean[:2560, 1])


def test_antialias_filter_is_flat_and_closed() -> None:
    for oversample in (2, 8, 16):
        taps = antialias_taps(oversample)
        assert len(taps) % 2 == 0
        np.testing.assert_array_equal(taps, taps[::-1])
        f, H = freqz(taps, worN=1 << 15, fs=RATE * oversample)
        assert np.max(np.abs(np.abs(H[f <= 0.45 * RATE]) - 1)) < 1e-4
        assert np.max(np.abs(H[f >= 0.55 * RATE])) < 5e-5


def test_noise_and_counts() -> None:
    model = two_bearings()
    clean = simulate(model, RATE, 1.0, seed=13)
    noisy = simulate(model, RATE, 1.0, seed=13, noise={"bearing1.x": 0.5})
    assert np.std(noisy[:, 0] - clean[:, 0]) == pytest.approx(0.5, rel=0.03)
    assert np.array_equal(noisy[:, 1:], clean[:, 1:])
    counted = simulate(model, RATE, 1.0, seed=13, full_scale=20.0)
    lsb = 20.0 / 32767
    np.testing.assert_allclose(counted / lsb, np.rint(counted / lsb), atol=1e-6)
    assert np.max(np.abs(counted)) <= 20.0
    inside = np.abs(clean) < 20.0
    assert np.max(np.abs(counted - clean)[inside]) <= 0.5001 * lsb
    assert quantise(np.array([1e9, -1e9]), 5.0).tolist() == [5.0, -5.0]


def test_tacho_pulses_follow_the_shaft() -> None:
    channels = (Channel("a", "bearing1", "x"), Channel("k", "shaft", "x", "tacho"))
    y = simulate(one_bearing(channels=channels), RATE, 2.0, seed=14)
    high = y[:, 1] > 0.5
    rises = np.flatnonzero(high[1:] & ~high[:-1])
    assert len(rises) == pytest.approx(70, abs=1)
    assert y[:, 1].mean() == pytest.approx(0.1, abs=0.002)
    ramp = ShaftSpeed(600.0, ramp_rpm_per_s=600.0)
    y = simulate(one_bearing(channels=channels), RATE, 2.0, seed=14, speed=ramp)
    rises = np.flatnonzero((y[1:, 1] > 0.5) & (y[:-1, 1] <= 0.5))
    assert len(rises) == pytest.approx(10 * 2 + 0.5 * 10 * 4, abs=1)


def test_speed_phase_is_the_integral_of_a_fluctuating_speed() -> None:
    speed = ShaftSpeed(3000.0, fluctuation=0.02, fluctuation_hz=2.0, seed=1)
    t = np.linspace(0, 20, 200001)
    rpm = np.gradient(speed.phase(t), t) * 60 / (2 * np.pi)
    assert rpm.mean() == pytest.approx(3000, rel=2e-3)
    assert rpm.std() == pytest.approx(60, rel=0.15)


def test_one_direction_and_one_bearing_are_allowed() -> None:
    assert simulate(one_bearing(), RATE, 0.05).shape == (1280, 1)
    model = two_bearings()
    x_only = replace(model, channels=model.channels[:2], linear={k: v for k, v in model.linear.items() if k[-1] == "x"})
    assert simulate(x_only, RATE, 0.05).shape == (1280, 2)
    assert simulate(two_bearings(shaft="none"), RATE, 0.05).shape == (1280, 4)
    assert np.isfinite(simulate(two_bearings(shaft="beam"), RATE, 0.05)).all()


def test_start_from_rest_builds_up() -> None:
    y = simulate(
        replace(one_bearing(c=5.0), channels=(Channel("x", "bearing1", "x", "displacement"),)), RATE, 1.0, start="rest"
    )
    assert np.std(y[:500]) < 0.5 * np.std(y[-5000:])


# -- refusals --------------------------------------------------------------------------------------------------------


def test_softening_without_a_stationary_density_is_refused() -> None:
    T = 9e-5 / 240.0
    bad = -(1e14) / (4 * 10 * T)  # barrier kL^2 / (4 |kNL|) of ten T
    with pytest.raises(ModelError, match=r"bearing1\.x: cubic softens.*barrier 10\.0 T, at least 20 T.*hertz"):
        Simulator(one_bearing(use("cubic", ("bearing1.x",), kNL=bad)), RATE)
    assert np.isfinite(simulate(one_bearing(use("cubic", ("bearing1.x",), kNL=bad / 3)), RATE, 0.2)).all()
    quintic = use("quintic", ("bearing1.x",), k5=bad**2 / 1e7)
    assert np.isfinite(simulate(one_bearing(use("cubic", ("bearing1.x",), kNL=bad), quintic), RATE, 0.2)).all()
    with pytest.raises(ModelError, match="quadratic softens"):
        Simulator(one_bearing(use("quadratic", ("bearing1.x",), kq=1e7 / (1.5 * np.sqrt(T / 1e7)))), RATE)


def test_what_cannot_be_simulated_is_said() -> None:
    with pytest.raises(ModelError, match="no shaft speed, but ball_pass needs it"):
        Simulator(one_bearing(use("ball_pass", ("bearing1.x",), k_cos=1e5, k_sin=0.0, order=2.1), speed_rpm=None), RATE)
    with pytest.raises(ModelError, match="no shaft speed, but a tacho channel"):
        Simulator(
            one_bearing(channels=(Channel("a", "bearing1", "x"), Channel("t", "", "", "tacho")), speed_rpm=None), RATE
        )
    with pytest.raises(ModelError, match=r"clearance at bearing1\.x has no gap \(m\)"):
        Simulator(one_bearing(use("clearance", ("bearing1.x",), k=1e6)), RATE)
    with pytest.raises(
        ModelError, match=r"clearance at bearing1\.x: gap is -1e-07 m, it must be a number of at least 0"
    ):
        Simulator(one_bearing(use("clearance", ("bearing1.x",), k=1e6, gap=-1e-7)), RATE)
    with pytest.raises(ModelError, match="cannot act at 'bearing7"):
        Simulator(one_bearing(use("cubic", ("bearing7.x",), kNL=1e6)), RATE)
    with pytest.raises(ModelError, match="no effect 'cubik'"):
        Simulator(one_bearing(use("cubik", ("bearing1.x",), kNL=1e6)), RATE)
    with pytest.raises(ModelError, match="ran away"):
        simulate(two_bearings(use("cross_coupling", ("bearing1",), k=3e7)), RATE, 3.0)
    with pytest.raises(ModelError, match="no force drives"):
        Simulator(one_bearing(S=0.0), RATE)
    with pytest.raises(ModelError, match="rho must lie between"):
        Simulator(two_bearings(use("correlated_force", ("bearing1.x",), rho=1.5)), RATE)
    with pytest.raises(ValueError, match="oversample"):
        Simulator(one_bearing(), RATE, oversample=1)
