"""The rolling estimator: cold start, chunks, gaps, a change that is followed with an honest interval."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from reference_rig import COULOMB, PLACES, RATE, TRUTH, rig_model, rig_record
from scipy.fft import irfft

from estimator.identification.batch import spectral as spectral
from estimator.identification.rolling.background import FoundBackground, Search
from estimator.identification.rolling.estimator import RollingEstimator
from estimator.identification.rolling.watch import DEFAULT_CANDIDATES, watchable_effects
from estimator.model.background import StructuralMode
from estimator.model.rig import Channel, CustomLaw, EffectUse, Model, Setting
from estimator.results import Estimate
from estimator.simulation.simulator import simulate

BLOCK = 1280
LINEAR = {"kL": Setting(1.3e6), "c": Setting(20.0), "S": Setting(1e-4)}


@pytest.fixture(scope="module")
def record() -> np.ndarray:
    return rig_record(14.0, seed=4)


def run(rolling: RollingEstimator, y: np.ndarray, block: int = BLOCK) -> list[Estimate]:
    out: list[Estimate] = []
    for part in np.split(y, np.arange(block, len(y), block)):
        rolling.update(part)
        out.append(rolling.snapshot())
    return out


@pytest.mark.slow
def test_nothing_is_shown_until_it_means_something_then_twice_a_second(record: np.ndarray) -> None:
    estimates = run(RollingEstimator(rig_model("cubic"), RATE, 10.0), record)
    shown = [bool(e.parameters) for e in estimates]
    first = shown.index(True)
    assert [e.extra["warm_up_s"] for e in estimates[:first] if e.extra] == [e.index / RATE for e in estimates[:first]]
    assert estimates[0].extra is not None
    assert estimates[0].extra["warm_up_needed_s"] == pytest.approx(first * BLOCK / RATE, abs=2 * BLOCK / RATE)
    assert estimates[0].status == "warming up: 0.05 of 4.36 s"
    assert 4.0 <= first * BLOCK / RATE < 5.5
    assert all(shown[first:])
    assert estimates[-1].index == len(record)
    different = {id(e.parameters) for e in estimates[first:]}
    assert len(different) >= 2.0 * (len(record) / RATE - first * BLOCK / RATE)


def test_a_long_warm_up_says_what_it_waits_for() -> None:
    rolling = RollingEstimator(replace(rig_model(), band=(2.0, 900.0)), 2048.0, 10.0)
    rolling.update(np.zeros((2048 * 41, 4)))
    assert rolling.snapshot().status == (
        "warming up: 41 of 210 s; the first fit takes 24 blocks of 8 s, 16 periods of band.low = 2 Hz each"
    )


def with_a_part(seconds: float) -> tuple[Model, np.ndarray, dict[str, float]]:
    """A part on the cap at 900 Hz, beside a bearing at 400 Hz, and a force whose spectrum falls by 6 dB an octave.

    The rig file's rig, the record at 8192 Hz, and the true kL and c.
    """
    rate_hz, m, k, c = 8192.0, 0.5, 0.5 * (2 * np.pi * 400.0) ** 2, 60.0
    f, rng = np.arange(int(seconds * rate_hz) // 2 + 1) / seconds, np.random.default_rng(0)
    s = 2j * np.pi * np.maximum(f, 1.0)
    part = StructuralMode(form="attached", mass=0.02, frequency_hz=900.0, damping=0.02)
    stiffness = (m * s**2 + k + c * s + part.attached_stiffness(s)) * np.abs(s) / 2500.0
    force = rng.normal(size=f.size) + 1j * rng.normal(size=f.size)
    y = irfft(100.0 * force * s**2 / stiffness, int(seconds * rate_hz))[:, None]
    rig = Model((Channel("b1x", "bearing1", "x"),), band=(100.0, 1800.0), mass={"bearing1": m})
    return rig, y, {"kL": k, "c": c}


def test_structural_modes_become_part_of_the_estimate_once_they_are_sure() -> None:
    rig, y, truth = with_a_part(36.0)
    estimates = run(RollingEstimator(rig, 8192.0, 10.0, watch=()), y, 4096)
    before, last = estimates[2 * 23].parameters["bearing1.x.kL"], estimates[-1]
    assert "not white" in before.reason
    assert not before.identifiable
    for name, true in truth.items():
        found = last.parameters[f"bearing1.x.{name}"]
        assert abs(found.value - true) < 3.0 * found.sd
    assert last.extra is not None
    assert last.extra["background_found_s"] == pytest.approx(33.0, abs=1.5)


@pytest.mark.slow
def test_a_search_in_a_thread_gives_the_same_bits() -> None:
    def in_a_thread(search: Search) -> Search:
        found: list[FoundBackground | None] = []
        thread = threading.Thread(target=lambda: found.append(search()))
        thread.start()

        def result() -> FoundBackground | None:
            thread.join()
            return found[0]

        return result

    rig, y, _ = with_a_part(36.0)
    at_once = run(RollingEstimator(rig, 8192.0, 10.0, watch=()), y, 4096)[-1]
    assert at_once.extra is not None
    assert "background_found_s" in at_once.extra
    assert run(RollingEstimator(rig, 8192.0, 10.0, watch=(), run=in_a_thread), y, 1280)[-1] == at_once


@pytest.mark.slow
def test_with_a_long_memory_it_agrees_with_the_fit(record: np.ndarray) -> None:
    last = run(RollingEstimator(rig_model("cubic"), RATE, 1e4), record)[-1]
    fit = spectral.fit_spectral(rig_model("cubic"), record, RATE)
    for place in PLACES:
        for key in ("kL", "c"):
            a, b = last.parameters[f"{place}.{key}"], fit.parameters[f"{place}.{key}"]
            assert abs(a.value - b.value) < 0.6 * b.sd  # the last half second is not in it yet
            assert a.sd == pytest.approx(b.sd, rel=0.15)


def test_the_same_rows_in_other_chunks_give_the_same_bits(record: np.ndarray) -> None:
    y = record[: 6 * 25600]
    by_chunk = {size: run(RollingEstimator(rig_model("cubic"), RATE, 5.0), y, size) for size in (1280, 7680, len(y))}
    for estimates in by_chunk.values():
        assert estimates[-1] == by_chunk[1280][-1]
        at = {e.index: e for e in by_chunk[1280]}
        assert all(e == at[e.index] for e in estimates)


def test_gaps_are_left_out(record: np.ndarray) -> None:
    holed = record.copy()
    holed[180000:180700] = np.nan
    holed[250000:250001, 1] = np.nan
    last = run(RollingEstimator(rig_model("cubic"), RATE, 10.0), holed)[-1]
    for i, place in enumerate(PLACES):
        p = last.parameters[f"{place}.kL"]
        assert abs(p.value - TRUTH["kL"][i]) < 4 * p.sd


@pytest.mark.parametrize("every", [6000, 12000])
def test_a_start_without_a_whole_block_says_so_and_goes_on(record: np.ndarray, every: int) -> None:
    """A loose cable: no block of the warm-up is whole, or no row has the support of the filters."""
    holed = record.copy()
    holed[: int(4.3 * RATE) : every] = np.nan
    estimates = run(RollingEstimator(rig_model("cubic"), RATE, 10.0), holed)
    assert any(e.status.startswith("too few stretches") for e in estimates)
    for i, place in enumerate(PLACES):
        p = estimates[-1].parameters[f"{place}.kL"]
        assert abs(p.value - TRUTH["kL"][i]) < 4 * p.sd


def test_noise_without_a_resonance_says_why_there_is_no_estimate() -> None:
    y = np.random.default_rng(0).normal(size=(int(9 * RATE), 4))
    last = run(RollingEstimator(rig_model(), RATE, 5.0), y)[-1]
    assert not last.parameters
    assert "resonance" in last.status


@pytest.mark.slow
def test_a_change_of_two_per_cent_is_followed_within_two_time_constants() -> None:
    tau, changed = 5.0, TRUTH["kL"] * np.array([1.02, 1.0, 1.0, 1.0])
    record = rig_record(45.0, seed=1, change=(20.0, changed))
    estimates = run(RollingEstimator(rig_model("cubic"), RATE, tau), record)
    at = [e for e in estimates if e.index / RATE > 20.0 + 2 * tau]
    z = [(e.parameters["bearing1.x.kL"].value - changed[0]) / e.parameters["bearing1.x.kL"].sd for e in at]
    assert np.mean(np.abs(z) < 2.5) > 0.9
    assert at[0].parameters["bearing1.x.kL"].value > 1.01 * TRUTH["kL"][0]


@pytest.mark.slow
def test_a_force_of_another_level_moves_its_own_level_alone() -> None:
    """Taken as even, what is missing was not known for ten seconds after it, as too much of the memory was let go."""
    tau, before, after = 5.0, 0.6, 1.5
    parts = [rig_record(10.0, seed=6, level=before), np.full((200, 4), np.nan), rig_record(10.0, seed=7, level=after)]
    estimates = run(RollingEstimator(rig_model("cubic"), RATE, tau), np.concatenate(parts))
    later = [e for e in estimates if e.index / RATE > 9.0]
    missing = [0.0 if e.extra is None else e.extra["missing_force_percent"] for e in later]
    assert all(e.extra is not None for e in later)
    assert max(missing) < 0.5
    for i, place in enumerate(PLACES):
        kL, S = (later[-1].parameters[f"{place}.{key}"] for key in ("kL", "S"))
        assert abs(kL.value - TRUTH["kL"][i]) < 4 * kL.sd
        assert S.value == pytest.approx(after**2 * TRUTH["S"][i], rel=0.1)


@pytest.mark.slow
def test_what_dresses_the_laws_goes_with_the_level_of_the_force() -> None:
    """As the first seconds had it, fc was 5 standard deviations low after the step, and a drag seemed missing."""
    friction = np.zeros((4, 7))
    friction[:, COULOMB] = 0.07
    first, second = (
        rig_record(s, seed=8 + k, hidden=friction, level=z) for k, (s, z) in enumerate([(7, 0.7), (14, 1.75)])
    )
    y = np.concatenate([first, np.full((200, 4), np.nan), second])
    last = run(RollingEstimator(rig_model("cubic", "coulomb"), RATE, 6.0), y)[-1]
    assert last.extra is not None
    assert last.extra["missing_force_percent"] < 0.3
    for key, truth in (("c", TRUTH["c"]), ("coulomb.fc", np.full(4, 0.07))):
        found = [last.parameters[f"{place}.{key}"] for place in PLACES]
        assert abs(np.mean([(p.value - t) / p.sd for p, t in zip(found, truth, strict=True)])) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("watch", [DEFAULT_CANDIDATES, watchable_effects()], ids=["usual", "catalogue"])
def test_what_is_missing_is_seen_and_named_as_it_rolls(record: np.ndarray, watch: tuple[str, ...]) -> None:
    model, friction = rig_model("cubic"), np.zeros((4, 7))
    friction[:, COULOMB] = 0.06
    complete = run(RollingEstimator(model, RATE, 10.0, watch), record[: int(8 * RATE)])[-1].extra
    lacking = run(RollingEstimator(model, RATE, 10.0, watch), rig_record(8.0, seed=5, hidden=friction))[-1].extra
    assert complete is not None
    assert lacking is not None
    assert complete["missing_force_percent"] < 0.5
    assert len(complete) == 1
    assert lacking["missing_force_percent"] > 1.0
    named = [k for k in lacking if k.startswith("missing_force_percent_")]
    assert named[0].removeprefix("missing_force_percent_") in ("coulomb", "stribeck")
    assert lacking["missing_force_percent"] >= 0.9 * lacking[named[0]]


def test_without_candidates_nothing_is_said_of_what_is_missing(record: np.ndarray) -> None:
    assert run(RollingEstimator(rig_model("cubic"), RATE, 10.0, watch=()), record[: int(6 * RATE)])[-1].extra is None


def test_a_law_that_is_not_finite_for_a_while_is_said_and_goes_on() -> None:
    """The service stops an estimator that raises."""
    growing = EffectUse("growing", {"bearing1.x": {"a": Setting(None)}}, CustomLaw("a*exp(x/3e-7)", None, {"a": "N"}))
    rig = Model(
        (Channel("b1x", "bearing1", "x"),), (150.0, 1600.0), mass={"bearing1": 0.2}, linear={"bearing1.x": LINEAR}
    )
    y = simulate(rig, 4096.0, 10.0, seed=1)
    y[int(7 * 4096.0) :][:40, 0] += 1e4 * np.hanning(40)
    estimates = run(RollingEstimator(replace(rig, effects=(growing,)), 4096.0, 3.0), y, 512)
    assert any(e.parameters for e in estimates[: 7 * 8])
    assert any("growing at bearing1.x is not finite" in e.status for e in estimates)
    assert estimates[-1].parameters["bearing1.x.kL"].value == pytest.approx(1.3e6, rel=0.05)


@pytest.mark.parametrize("dead", ["all", "one", "later"])
def test_a_place_that_does_not_move_is_named(record: np.ndarray, dead: str) -> None:
    y = record[: int(9 * RATE)].copy()
    if dead == "all":
        y[:] = 0.0
    elif dead == "one":
        y[:, 1] = 9.81
    else:
        y[int(6 * RATE) :, 1] = 0.0
    last = run(RollingEstimator(rig_model(), RATE, 5.0, watch=()), y)[-1]
    assert not last.parameters
    assert f"{PLACES[0 if dead == 'all' else 1]} does not move" in last.status


@pytest.mark.slow
def test_one_wild_sample_is_left_out_and_said(record: np.ndarray) -> None:
    """It hid the motion for as long as the memory, with the status ok."""
    spiked = record.copy()
    spiked[int(9.0 * RATE), 0] = 1e6
    plain = run(RollingEstimator(rig_model(), RATE, 10.0), record)[-1]
    last = run(RollingEstimator(rig_model(), RATE, 10.0), spiked)[-1]
    assert last.extra is not None
    assert last.extra["spikes_left_out"] == 1.0
    assert "spikes_left_out" not in (plain.extra or {})
    for name in ("bearing1.x.kL", "bearing1.x.c", "bearing1.x.S"):
        p, q = last.parameters[name], plain.parameters[name]
        assert p.value is not None
        assert abs(p.value - q.value) < 0.5 * q.sd
