"""CPU time of the rolling estimator per second of data, and of a fit, on one core.

OPENBLAS_NUM_THREADS=1 pytest -m bench -s tests/bench/test_bench_rolling.py
"""

from __future__ import annotations

import os
import time

import numpy as np
import pytest
from reference_rig import PLACES, RATE, TRUTH, rig_model, rig_record
from structural_rig import PART_MODE, STIFFNESS_N_M, SUPPORT_MODE, drawn_modes, structural_record

from estimator.identification.batch import spectral
from estimator.identification.rolling.background import Search
from estimator.identification.rolling.estimator import RollingEstimator
from estimator.identification.rolling.watch import DEFAULT_CANDIDATES, UNWATCHABLE_EFFECTS, watchable_effects
from estimator.results import BACKGROUND_KEY

pytestmark = [pytest.mark.bench, pytest.mark.timeout(0)]


TRUE_CUBIC = 1.3e18  # N/m^3, of the reference rig
COLUMNS = (
    *watchable_effects(),
    *UNWATCHABLE_EFFECTS,
    "bouc_wen",
)  # every effect of the catalogue that is an amplitude times a column


@pytest.mark.parametrize(
    ("watch", "limit"),
    [((), 0.05), (DEFAULT_CANDIDATES, 0.25), (watchable_effects(), 0.25), (COLUMNS, 0.25)],
    ids=["own effects", "with candidates", "with the catalogue", "with every column"],
)
def test_share_of_a_core(watch: tuple[str, ...], limit: float) -> None:
    y = rig_record(32.0, seed=1)
    rolling = RollingEstimator(rig_model("cubic"), RATE, 10.0, watch=watch)
    blocks = np.split(y, np.arange(1280, len(y), 1280))
    warm = int(8 * RATE / 1280)  # start and compilation
    worst = 0.0
    for block in blocks[:warm]:
        rolling.update(block)
    begin = time.process_time()
    for block in blocks[warm:]:
        one = time.perf_counter()
        rolling.update(block)
        rolling.snapshot()
        worst = max(worst, time.perf_counter() - one)
    share = (time.process_time() - begin) / (24.0)
    assert rolling.snapshot().parameters
    cost = f"{100 * share:.1f} % of a core at 25.6 kS/s, 4 channels; longest update {1e3 * worst:.0f} ms"
    print(f"\n{len(watch)} candidates: {cost}; load {os.getloadavg()[0]:.1f}")
    assert share < limit * (3 if limit < 0.1 else 1)


def test_intervals_cover() -> None:
    """Share of 95 % intervals that hold the truth, at two instants more than two time constants apart."""
    inside: dict[str, list[bool]] = {"kL": [], "c": [], "cubic.kNL": [], "S": []}
    sds: dict[str, list[float]] = {key: [] for key in inside}
    for seed in range(int(os.environ.get("ROTORSCOPE_SEEDS", "20"))):
        y = rig_record(22.0, seed=1000 + seed)
        rolling = RollingEstimator(rig_model("cubic"), RATE, 5.0, watch=())
        for instant, rows in enumerate(np.split(y, [int(10 * RATE)])):
            for block in np.split(rows, np.arange(1280, len(rows), 1280)):
                rolling.update(block)
            found = rolling.snapshot().parameters
            assert found, instant
            for i, place in enumerate(PLACES):
                for key in inside:
                    p = found[f"{place}.{key}"]
                    truth = TRUE_CUBIC if key == "cubic.kNL" else TRUTH[key][i]
                    if p.value is not None and p.sd:
                        inside[key].append(abs(p.value - truth) < 1.96 * p.sd)
                        sds[key].append((p.value - truth) / p.sd)
    print()
    for key, hits in inside.items():
        z = np.array(sds[key])
        print(f"{key}: {100 * np.mean(hits):.1f} % of {len(hits)}; mean {z.mean():+.2f}, scatter {z.std():.2f} sd")


@pytest.mark.parametrize("seconds", [15.0, 30.0, 60.0])
def test_time_of_a_fit(seconds: float) -> None:
    y = rig_record(seconds, seed=1)
    spectral.fit_spectral(rig_model("cubic"), y[: int(8 * RATE)], RATE)
    begin, cpu = time.perf_counter(), time.process_time()
    spectral.fit_spectral(rig_model("cubic"), y, RATE)
    print(f"\nfit of {seconds:g} s: {time.perf_counter() - begin:.2f} s, {time.process_time() - cpu:.2f} s of CPU")


MODES_AND_RATES = {  # by name: modes of a seed by place, and rate, Hz
    "a part on the cap": (lambda seed: {"bearing1.x": [PART_MODE]}, 8192.0),
    "a support": (lambda seed: {"bearing1.x": [SUPPORT_MODE]}, 8192.0),
    "twelve modes": (lambda seed: {place: drawn_modes(3, 10 * seed + k) for k, place in enumerate(PLACES)}, 25600.0),
}


@pytest.mark.parametrize("name", MODES_AND_RATES)
def test_structural_modes(name: str) -> None:
    """When they are found, how far kL is off then, and the time of a core that the search takes."""
    modes, rate_hz = MODES_AND_RATES[name]
    seconds = float(os.environ.get("ROTORSCOPE_SECONDS", "60"))
    for seed in range(int(os.environ.get("ROTORSCOPE_SEEDS", "4"))):
        model, y = structural_record(modes(seed), seconds, rate_hz, seed)
        searches: list[float] = []

        def run(search: Search, searches: list[float] = searches) -> Search:
            begin = time.process_time()
            found = search()
            searches.append(time.process_time() - begin)
            return lambda: found

        rolling, begin = RollingEstimator(model, rate_hz, 10.0, watch=(), run=run), time.process_time()
        for block in np.split(y, np.arange(1280, len(y), 1280)):
            rolling.update(block)
        whole, last = time.process_time() - begin, rolling.snapshot()
        kL = [last.parameters[f"{place}.kL"] for place in model.places]
        percent = [(100 * p.value / STIFFNESS_N_M, 100 * p.sd / STIFFNESS_N_M) for p in kL if p.value and p.sd]
        off = [f"{value - 100:+.2f} +- {sd:.2f}" for value, sd in percent]
        found_s = (last.extra or {}).get(BACKGROUND_KEY)
        print(
            f"\n{name}, {seconds:.0f} s: found {'never' if found_s is None else f'at {found_s:.0f} s'}, kL off by "
            f"{', '.join(off) or 'no number'} %; {len(searches)} searches, {sum(searches):.2f} s of a core, "
            f"{100 * sum(searches) / seconds:.1f} % (all {100 * whole / seconds:.1f} %)",
            end="",
        )
        assert sum(searches) < 0.1 * seconds
