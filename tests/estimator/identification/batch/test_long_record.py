"""A record longer than a working point holds is fitted part by part."""

from __future__ import annotations

from dataclasses import replace

import pytest

from estimator import Channel, EffectUse, Model, Setting, simulate
from estimator.identification.batch import fit_spectral
from estimator.likelihood.motion import prepare

RATE_HZ, SECONDS = 6400.0, 24.0
CAP_X = {"kL": Setting(1.0e6), "c": Setting(20.0), "S": Setting(1.0e-4)}
ONE_CAP_RIG = Model(
    (Channel("b1x", "bearing1", "x"),), band=(100.0, 2500.0), mass={"bearing1": 0.2}, linear={"bearing1.x": CAP_X},
    effects=(EffectUse("cubic", {"bearing1.x": {"kNL": Setting(5.0e16)}}),),
)  # fmt: skip


def test_the_mean_of_the_parts_is_as_sure_as_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    y = simulate(ONE_CAP_RIG, RATE_HZ, SECONDS, seed=2)
    whole = fit_spectral(ONE_CAP_RIG, y, RATE_HZ)
    monkeypatch.setattr(prepare, "MAX_SAMPLES", SECONDS / 4 * RATE_HZ)
    parts = fit_spectral(ONE_CAP_RIG, y, RATE_HZ)
    assert parts.samples > 0.9 * whole.samples
    assert not [m for m in parts.messages if m.code == prepare.RECORD_LONG_CODE]
    for name, p in whole.parameters.items():
        if p.sd:
            q = parts.parameters[name]
            assert q.sd == pytest.approx(p.sd, rel=0.06)
            assert q.value == pytest.approx(p.value, abs=0.5 * p.sd)


def test_a_stiffness_that_changes_from_part_to_part_has_the_standard_deviation_of_the_change(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    y = simulate(ONE_CAP_RIG, RATE_HZ, SECONDS, seed=2)
    once = fit_spectral(ONE_CAP_RIG, y, RATE_HZ).parameters["bearing1.x.kL"].sd
    monkeypatch.setattr(prepare, "MAX_SAMPLES", SECONDS / 2 * RATE_HZ)
    half = len(y) // 12  # each time fold has two parts
    stretched = y.copy()
    stiff = replace(ONE_CAP_RIG, linear={"bearing1.x": {**CAP_X, "kL": Setting(1.05e6)}})
    other = simulate(stiff, RATE_HZ, SECONDS, seed=3)
    for k in range(1, 12, 2):
        stretched[k * half : (k + 1) * half] = other[k * half : (k + 1) * half]
    assert fit_spectral(ONE_CAP_RIG, stretched, RATE_HZ).parameters["bearing1.x.kL"].sd > 3.0 * once  # type: ignore[operator]
