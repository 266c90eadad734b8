from __future__ import annotations

import numpy as np
import pytest
from reference_samples import langevin

from estimator.errors import DataError
from estimator.identification.moments.score_matching import RollingScoreMatching, fit_score_matching
from estimator.model.rig import Channel, EffectUse, Model, Setting

RATE = 25600.0
TRUE_KL = np.array([1.0e7, 1.2e7])
TRUE_KNL = 1.3e18


def rig(places: tuple[str, ...] = ("bearing1.x", "bearing2.x"), **changes: object) -> Model:
    channels = tuple(Channel(p.replace("bearing", "b").replace(".", ""), *p.split("."), "displacement") for p in places)
    cubic = EffectUse("cubic", {p: {"kNL": Setting()} for p in places})
    mass = {"disc": 0.515, "bearing1": 0.2, "bearing2": 0.22}
    base = {"channels": channels, "band": (150.0, 8000.0), "shaft": "chain", "mass": mass, "shaft_stiffness": 1.55e5}
    return Model(**(base | {"effects": (cubic,)} | changes))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def record() -> np.ndarray:
    ks = 1.55e5
    K = np.array([[ks, 0.0, -ks], [0.0, ks, -ks], [-ks, -ks, 2.0 * ks]])
    m, c, q = [0.2, 0.22, 0.515], [60.0, 50.0, 0.0], [4.5e-5, 4.0e-5, 0.0]
    kL, kNL = np.append(TRUE_KL, 0.0), [TRUE_KNL, TRUE_KNL, 0.0]
    coupled = K + np.diag([0.0, 0.0, 1.0])
    x, _ = langevin(m, c, kL, kNL, coupled, q, RATE, 12 * 25600, seed=11)
    return x[:, :2]


def test_fit_of_a_record_recovers_the_rig(record: np.ndarray) -> None:
    """Band-limited displacement of a flexible rotor whose disc is not measured."""
    found = fit_score_matching(rig(), record, RATE)
    assert found.method == "score-matching"
    assert found.log_likelihood is None
    for i, node in enumerate(("bearing1", "bearing2")):
        kL = found.parameters[f"{node}.x.kL"]
        assert kL.value == pytest.approx(TRUE_KL[i], rel=1e-2)
        assert 0.0 < kL.sd < 4e-3 * TRUE_KL[i]
        kNL = found.parameters[f"{node}.x.cubic.kNL"]
        assert abs(kNL.value - TRUE_KNL) < 4.0 * kNL.sd
        assert kNL.unit == "N/m^3"


def test_rolling_agrees_with_the_fit_and_narrows(record: np.ndarray) -> None:
    rolling = RollingScoreMatching(rig(), RATE, 4.0)
    sds = []
    for at in range(0, len(record), 1024):
        rolling.update(record[at : at + 1024])
        estimate = rolling.snapshot()
        if estimate.parameters:
            sds.append(estimate.parameters["bearing1.x.kL"].sd)
    assert rolling.snapshot().status == "ok"
    assert sds[-1] < sds[0]
    kL = rolling.snapshot().parameters["bearing1.x.kL"]
    assert kL.value == pytest.approx(TRUE_KL[0], rel=0.01)
    assert 0 < rolling.snapshot().index <= len(record)


def test_chunks_do_not_change_a_bit(record: np.ndarray) -> None:
    short = record[:60_000].copy()
    short[20_000:20_010] = np.nan
    one, many = RollingScoreMatching(rig(), RATE, 1.0), RollingScoreMatching(rig(), RATE, 1.0)
    one.update(short)
    rng = np.random.default_rng(1)
    at = 0
    while at < len(short):
        n = int(rng.integers(1, 3000))
        many.update(short[at : at + n])
        at += n
    assert one.snapshot() == many.snapshot()
    assert one.snapshot().parameters


def test_snapshot_changes_nothing_and_follows_a_change(record: np.ndarray) -> None:
    """After the stiffness jumps the rolling estimate forgets the old one."""
    x, _ = langevin([0.2], [60.0], [1.4e7], [0.0], np.zeros((1, 1)), [4.5e-5], RATE, 5 * 25600, seed=12)
    rolling = RollingScoreMatching(rig(("bearing1.x",), shaft="none"), RATE, 1.0)
    rolling.update(record[:100_000, :1])
    before = rolling.snapshot()
    assert before == rolling.snapshot()
    assert before.parameters["bearing1.x.kL"].value == pytest.approx(1.0155e7, rel=0.02)  # bearing and shaft
    rolling.update(x)
    assert rolling.snapshot().parameters["bearing1.x.kL"].value == pytest.approx(1.4e7, rel=0.02)


def test_warming_up_shows_nothing(record: np.ndarray) -> None:
    rolling = RollingScoreMatching(rig(), RATE, 10.0)
    assert rolling.snapshot().status == "warming up"
    rolling.update(record[:8000])
    assert rolling.snapshot().status == "warming up"
    assert not rolling.snapshot().parameters


def test_rolling_never_raises_on_data() -> None:
    rolling = RollingScoreMatching(rig(), RATE, 0.5)
    rolling.update(np.zeros((60_000, 2)))
    assert "does not move" in rolling.snapshot().status
    rolling.update(np.full((60_000, 2), np.nan))
    rolling.snapshot()


def test_bad_records_are_named(record: np.ndarray) -> None:
    with pytest.raises(DataError, match="usable samples"):
        fit_score_matching(rig(), record[:5000], RATE)
    dead = record.copy()
    dead[:, 1] = 3.0
    with pytest.raises(DataError, match="b2x is constant"):
        fit_score_matching(rig(), dead, RATE)
    with pytest.raises(DataError, match="no resonance inside the band"):
        fit_score_matching(rig(band=(2500.0, 8000.0)), record, RATE)
    with pytest.raises(DataError, match="2 channels"):
        fit_score_matching(rig(), record[:, :1], RATE)
    with pytest.raises(DataError, match="no valid samples"):
        fit_score_matching(rig(), np.full_like(record, np.nan), RATE)
    holes = record.copy()
    holes[::500] = np.nan
    with pytest.raises(DataError, match="gaps"):
        fit_score_matching(rig(), holes, RATE)


def test_a_gaussian_record_has_no_cubic_to_show() -> None:
    x, _ = langevin([0.2], [60.0], [1e7], [0.0], np.zeros((1, 1)), [4.5e-5], RATE, 6 * 25600, seed=13)
    found = fit_score_matching(rig(("bearing1.x",), shaft="none"), x, RATE)
    kNL = found.parameters["bearing1.x.cubic.kNL"]
    assert not kNL.identifiable
    assert kNL.value is None


def test_what_the_method_cannot_know_is_said(record: np.ndarray) -> None:
    stop = EffectUse("stop", {"bearing1.x": {}})
    found = fit_score_matching(rig(effects=(stop,)), record, RATE)
    assert any("left out: stop" in m.text for m in found.messages)
    unequal = record * [1.0, 1.3]  # a wrong gain looks like unequal temperatures
    assert any("m v^2" in m.text for m in fit_score_matching(rig(), unequal, RATE).messages)


def test_noise_without_a_resonance_gives_no_rolling_estimate() -> None:
    y = np.random.default_rng(0).normal(size=(int(4 * RATE), 4))
    rolling = RollingScoreMatching(rig(), RATE, 5.0)
    rolling.update(y)
    last = rolling.snapshot()
    assert not last.parameters
    assert "no resonance" in last.status


def test_what_it_leaves_out_is_said_as_it_rolls(record: np.ndarray) -> None:
    friction = EffectUse("coulomb", {"bearing1.x": {}})
    rolling = RollingScoreMatching(rig(effects=(friction,)), RATE, 5.0)
    rolling.update(record[: 3 * 25600])
    assert rolling.snapshot().parameters["bearing1.x.coulomb.fc"].reason.startswith("score matching leaves it out")
