"""The core loop's body called by hand, with a clock that stands still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stand_ins import FakeClock, MomentEstimator, Recorder, info_of, paper_rig, vibration

from daq.base.contract.errors import ConfigError
from daq.base.contract.sink import Session, SinkHealth, Status
from daq.log.codec import encode_estimate
from daq.session.estimation import LONGEST_GAP_S, Estimation, block_rows
from daq.session.estimator_runner import EstimatorRunner
from daq.session.ledger import Ledger
from daq.session.pipeline import Pipeline, Plan
from drivers.contract.reading import Block, Gap, Info, LinkStats, Notice, Reading

RIG = paper_rig()
INFO = info_of(RIG)
PLAN = Plan(RIG.model, MomentEstimator, 25600.0)


def run(batches: Sequence[Sequence[Reading]], plan: Plan = PLAN) -> tuple[Pipeline, Recorder]:
    sink = Recorder()
    pipeline = Pipeline(plan, [sink], FakeClock())
    for batch in batches:
        pipeline.step(batch)
    pipeline.finish(LinkStats(), {})
    return pipeline, sink


def coded(sink: Recorder) -> list[bytes]:
    return [encode_estimate(e) for e in sink.of("estimate")]  # type: ignore[arg-type]


def stream(rows: int, cuts: Sequence[int], first: int = 0) -> list[Reading]:
    edges = [0, *sorted({c for c in cuts if 0 < c < rows}), rows]
    return [vibration(first + a, b - a) for a, b in zip(edges, edges[1:], strict=False)]


def test_raw_is_logged_before_anything_computed_from_it() -> None:
    _, sink = run([[INFO, *stream(60_000, range(0, 60_000, 700))]])
    assert sink.calls[0][0] == "start"
    stored = 0
    for what, value in sink.calls:
        if what == "readings":
            blocks = [r for r in value if isinstance(r, Block)]  # type: ignore[attr-defined]
            stored = max([stored, *(b.index + len(b.counts) for b in blocks)])
        if what == "estimate":
            assert value.index <= stored  # type: ignore[attr-defined]
    assert len(sink.of("estimate")) == 60_000 // (12 * 1024) + 1
    assert sink.calls[-1][0] == "close"


@settings(max_examples=30, deadline=None)
@given(
    first=st.integers(0, 10**6),
    cuts=st.lists(st.integers(1, 40_000), max_size=12),
    sizes=st.lists(st.integers(1, 5), min_size=1, max_size=5),
    hole=st.integers(0, 40_000),
    missing=st.sampled_from([0, 1, 1023, 1024, 1025, 30_000]),
)
def test_estimates_do_not_depend_on_how_the_bytes_arrived(
    first: int, cuts: list[int], sizes: list[int], hole: int, missing: int
) -> None:
    def estimates(readings: list[Reading], per_step: list[int]) -> list[bytes]:
        batches: list[list[Reading]] = [[INFO]]
        at, k = 0, 0
        while at < len(readings):
            batches.append(readings[at : at + per_step[k % len(per_step)]])
            at += per_step[k % len(per_step)]
            k += 1
        return coded(run(batches)[1])

    def readings(cuts: list[int]) -> list[Reading]:
        parts = stream(hole, cuts, first) if hole else []
        gap = [Gap(first + hole, missing, "crc")] if missing else []
        return [*parts, *gap, *stream(40_000 - hole, cuts, first + hole + missing)] if hole < 40_000 else [*parts, *gap]

    reference = estimates(readings([]), [1])
    assert len(reference) >= 3
    assert estimates(readings(cuts), sizes) == reference


def test_blocks_lie_on_multiples_of_the_absolute_index_and_gaps_are_nan() -> None:
    made: list[MomentEstimator] = []

    def make(model: object, rate_hz: float) -> MomentEstimator:
        made.append(MomentEstimator(RIG.model, rate_hz))
        return made[0]

    rows = block_rows(25600.0)
    assert rows == 1024
    run([[INFO, vibration(1500, 3000), Gap(4500, 10, "crc"), vibration(4510, 1634 + 1000)]], replace(PLAN, make=make))
    # the first block is [1024, 2048), filled with NaN up to 1500; the gap is in [4096, 5120)
    assert made[0].blocks == [(1024, True), (1024, False), (1024, False), (1024, True), (1024, False)]


def test_an_estimate_says_which_sample_it_is_up_to() -> None:
    _, sink = run([[INFO, vibration(10_000, 30_000)]])
    indices = [e.index for e in sink.of("estimate")]  # type: ignore[attr-defined]
    assert indices == [12_288, 24_576, 36_864, 39_936]


def test_at_least_two_estimates_a_second_at_any_rate() -> None:
    for rate_hz in (10.0, 100.0, 1000.0, 8000.0, 25_600.0, 51_200.0, 400_000.0):
        runner = EstimatorRunner(MomentEstimator(RIG.model, rate_hz))
        Estimation(runner, 4, rate_hz, 0).append(np.zeros((int(5 * rate_hz), 4)))
        due = [answer.estimate.index for answer in runner.take()]
        assert np.diff([0, *due]).max() <= rate_hz / 2


def test_clipped_counts_are_nan_for_the_estimator_only() -> None:
    made: list[MomentEstimator] = []

    def make(model: object, rate_hz: float) -> MomentEstimator:
        made.append(MomentEstimator(RIG.model, rate_hz))
        return made[0]

    block = vibration(0, 4096)
    block.counts[2000, 1] = 32767
    block.counts[2001, 2] = -32768
    pipeline, sink = run([[INFO, block]], replace(PLAN, make=make))
    assert [nan for _, nan in made[0].blocks] == [False, True, False, False]
    assert pipeline.clipped == 2
    logged = next(r for r in sink.delivered if isinstance(r, Block))
    assert logged.counts[2000, 1] == 32767
    notices = [r for r in sink.delivered if isinstance(r, Notice)]
    assert [n.code for n in notices] == ["clipped"]
    assert "b1y, b2x at full scale" in notices[0].text


def test_channels_are_found_by_name_or_taken_in_order_or_refused() -> None:
    shuffled = Info(tuple(reversed(INFO.signals)), 25600.0)
    block = vibration(0, 20_480)
    turned = replace(block, counts=np.ascontiguousarray(block.counts[:, ::-1]))
    assert coded(run([[shuffled, turned]])[1]) == coded(run([[INFO, block]])[1])
    unnamed = Info(tuple(replace(s, name=f"ch{i}") for i, s in enumerate(INFO.signals)), 25600.0)
    _, sink = run([[unnamed, block]])
    assert "channels_by_order" in [r.code for r in sink.delivered if isinstance(r, Notice)]
    with pytest.raises(ConfigError, match="not the rig's channel b2y"):
        run([[Info(INFO.signals[:3], 25600.0), block]])


def test_readings_before_the_device_said_what_it_is_are_kept() -> None:
    early = Notice(1, "warning", "slow_start", "nothing yet")
    pipeline, sink = run([[early], [INFO, vibration(0, 100)]])
    assert [type(r) for r in sink.delivered[:2]] == [Notice, Info] or early in sink.delivered
    assert pipeline.ledger.samples == 100


def test_a_silent_device_still_makes_a_session() -> None:
    pipeline, sink = run([[Notice(1, "error", "silent", "no data for 2 s")]])
    assert [what for what, _ in sink.calls] == ["start", "readings", "status", "close"]
    assert pipeline.problems == ["no data for 2 s"]


def test_a_new_rate_begins_anew() -> None:
    fast, slow = INFO, replace(INFO, rate_hz=6400.0)
    _, sink = run([[fast, vibration(0, 30_000)], [slow, vibration(30_000, 30_000)]])
    assert slow in sink.delivered
    assert [r.code for r in sink.delivered if isinstance(r, Notice)] == ["rate_untrue"]
    indices = [e.index for e in sink.of("estimate")]  # type: ignore[attr-defined]
    assert indices[:2] == [12_288, 24_576]
    assert np.diff(indices[2:-1]).max() <= 3200


def test_seconds_are_those_of_each_rate() -> None:
    """A device that comes back at half its rate in a run of given length."""
    half = replace(INFO, rate_hz=INFO.rate_hz / 2)
    first = round(INFO.rate_hz)
    batches = [[INFO, *stream(first, [])], [half, *stream(4 * first, range(0, 4 * first, 700), first=first)]]
    pipeline, _ = run(batches, replace(PLAN, limit_s=2.5))
    assert pipeline.seconds == 2.5
    assert pipeline.ledger.samples == first + 1.5 * half.rate_hz


@pytest.mark.parametrize("seconds", [10, 10_000, 10**9])
def test_long_gaps_cost_a_bounded_time_and_keep_the_index(seconds: int) -> None:
    count = seconds * 25_600
    made: list[MomentEstimator] = []

    def make(model: object, rate_hz: float) -> MomentEstimator:
        made.append(MomentEstimator(RIG.model, rate_hz))
        return made[0]

    plan = replace(PLAN, make=make)
    readings = [INFO, vibration(0, 30_000), Gap(30_000, count, "silent"), vibration(30_000 + count, 30_000)]
    pipeline, sink = run([readings], plan)
    assert pipeline.ledger.lost == count
    assert pipeline.ledger.stop == 60_000 + count
    assert sink.of("estimate")[-1].index == (60_000 + count) // 1024 * 1024  # type: ignore[attr-defined]
    assert len(made[0].blocks) <= (LONGEST_GAP_S + 4) * 25


class Failing(MomentEstimator):
    def update(self, block: np.ndarray) -> None:
        super().update(block)
        if len(self.blocks) > 20:
            raise ZeroDivisionError("a defect")


def test_a_failing_estimator_does_not_stop_acquisition() -> None:
    pipeline, sink = run([[INFO, *stream(60_000, range(0, 60_000, 1000))]], replace(PLAN, make=Failing))
    assert pipeline.ledger.samples == 60_000
    assert sum(len(r.counts) for r in sink.delivered if isinstance(r, Block)) == 60_000
    assert "the estimator has stopped: ZeroDivisionError('a defect')" in pipeline.problems[0]


def test_a_model_that_cannot_be_estimated_is_said() -> None:
    def refuse(model: object, rate_hz: float) -> MomentEstimator:
        raise ValueError("the band is above half the rate")

    _, sink = run([[INFO, vibration(0, 30_000)]], replace(PLAN, make=refuse))
    assert sink.of("estimate") == []
    assert [r.text for r in sink.delivered if isinstance(r, Notice)] == [
        "no rolling estimate: the band is above half the rate"
    ]


@pytest.mark.parametrize("method", ["start", "readings", "estimate", "status", "close"])
def test_one_sink_that_fails_disturbs_no_other(method: str) -> None:
    for error, stays in ((OSError(28, "No space left on device"), True), (RuntimeError("a defect"), False)):
        bad, good = Recorder(fail={method: error}), Recorder()
        pipeline = Pipeline(PLAN, [bad, good], FakeClock())
        pipeline.step([INFO])
        for reading in stream(60_000, range(0, 60_000, 1000)):
            pipeline.step([reading])
        pipeline.tick(LinkStats(), {}, final=True)
        pipeline.finish(LinkStats(), {})
        assert sum(len(r.counts) for r in good.delivered if isinstance(r, Block)) == 60_000
        assert len(good.of("estimate")) == 5
        assert len(good.of("close")) == 1
        assert len(pipeline.problems) == 1
        assert f"Recorder failed at {method}" in pipeline.problems[0]
        assert (len(bad.of(method)) > 1) == (stays and method not in ("start", "close"))


class Reporter(Recorder):
    def health(self) -> SinkHealth:
        notices = (Notice(1, "error", "log_fault", "disk full"),) if not self.of("status") else ()
        return SinkHealth(1.5, 7, notices)


def test_notices_of_a_sink_with_a_thread_are_reported() -> None:
    clock, sink, notices = FakeClock(), Reporter(), []
    pipeline = Pipeline(PLAN, [sink], clock, notify=notices.append)
    pipeline.step([INFO, vibration(0, 25_600)])
    clock.t_ns += 10**9
    pipeline.tick(LinkStats(frames=3), {"reader": 5})
    status = sink.of("status")[0]
    assert isinstance(status, Status)
    assert status.rate_hz == 25_600.0
    assert status.link.frames == 3
    assert status.dropped == {"reader": 5, "Reporter": 7, "clipped": 0}
    assert status.lag_s["Reporter"] == 1.5
    assert {"core", "estimate"} <= set(status.lag_s)
    pipeline.tick(LinkStats(), {})
    assert len(sink.of("status")) == 1  # a second has not passed
    assert Notice(1, "error", "log_fault", "disk full") in notices
    assert {notice.code for notice in notices} == {"log_fault", "overflow"}
    assert any(": the oldest 5 in the queue are dropped" in notice.text for notice in notices)
    assert [notice.code for notice in notices].count("overflow") == 1  # not again before ten seconds


def test_the_session_says_what_the_log_must_know() -> None:
    plan = replace(PLAN, attachments={"rig.toml": b"x"}, metadata={"a": "b"}, device="left")
    _, sink = run([[INFO]], plan)
    session = sink.of("start")[0]
    assert session == Session(
        model=RIG.model, info=INFO, device="left", attachments={"rig.toml": b"x"}, metadata={"a": "b"}
    )


def test_seconds_are_seconds_of_data() -> None:
    readings = [INFO, vibration(100, 20_000), Gap(20_100, 100, "crc"), vibration(20_200, 20_000)]
    pipeline, sink = run([readings], replace(PLAN, limit_s=1.0))
    assert pipeline.done
    assert pipeline.ledger.samples == 25_500
    assert (pipeline.ledger.first, pipeline.ledger.stop) == (100, 25_700)
    assert sum(len(r.counts) for r in sink.delivered if isinstance(r, Block)) == 25_500


@settings(deadline=None)
@given(
    items=st.lists(st.tuples(st.booleans(), st.integers(0, 300), st.integers(0, 60)), max_size=25),
    limit=st.none() | st.integers(1, 200),
)
def test_the_ledger_lets_nothing_through_twice_and_leaves_no_hole(
    items: list[tuple[bool, int, int]], limit: int | None
) -> None:
    """Whatever a driver delivers: indices grow, every index is a sample or in a gap, the sums agree."""
    ledger = Ledger()
    if limit is not None:
        ledger.limit_to(limit)
    at: int | None = None
    samples = lost = 0
    for is_block, index, count in items:
        block = Block(index, np.full((count, 1), 7, np.int32), 0, 5)
        reading: Reading = block if is_block else Gap(index, count, "crc")
        for out in ledger.accept(reading):
            if isinstance(out, Gap) and out.count == 0:
                continue
            assert isinstance(out, Block | Gap)
            n = len(out.counts) if isinstance(out, Block) else out.count
            assert n > 0
            at = out.index if at is None else at
            assert out.index == at
            at += n
            samples += n if isinstance(out, Block) else 0
            lost += n if isinstance(out, Gap) else 0
    assert (ledger.samples, ledger.lost) == (samples, lost)
    assert limit is None or samples + lost <= limit
    assert ledger.lost == sum(g.count for g in ledger.gaps)


def test_what_is_said_before_the_device_is_known_is_reported_at_once_and_logged_later() -> None:
    sink, notices = Recorder(), list[Notice]()
    pipeline = Pipeline(PLAN, [sink], FakeClock(), notify=notices.append)
    silent = Notice(1, "warning", "silent", "nothing for 1 s")
    pipeline.step([silent])
    assert notices == [silent]
    pipeline.step([INFO, vibration(0, 256)])
    pipeline.finish(LinkStats(), {})
    assert notices == [silent]
    logged = [r for batch in sink.of("readings") for r in batch if isinstance(r, Notice)]  # type: ignore[attr-defined]
    assert logged == [silent]


def test_a_step_of_this_computers_clock_is_reported_once() -> None:
    class Stepped(FakeClock):
        wall_ns = 0

        def wall_offset_ns(self) -> int:
            return super().wall_offset_ns() + self.wall_ns

    def steps(live: bool) -> list[str]:
        clock, sink = Stepped(), Recorder()
        pipeline = Pipeline(PLAN, [sink], clock, live=live)
        clock.wall_ns = 86_400 * 10**9  # set while the device had said nothing yet: the log begins with the right time
        pipeline.step([INFO, vibration(0, 500)])
        for step in (0.0, 0.4, 3600.25, 0.0, -1.5):
            clock.wall_ns += round(step * 1e9)
            clock.t_ns += 10**9
            pipeline.tick(LinkStats(), {})
        pipeline.finish(LinkStats(), {})
        notices = [r for r in sink.delivered if isinstance(r, Notice) and r.code == "wall_clock_set"]
        return [n.text.partition(" (")[0] for n in notices]

    assert steps(live=True) == [f"this computer's clock moved by {s} s" for s in ("+3600.650", "-1.500")]
    assert steps(live=False) == []


@pytest.mark.parametrize(
    ("true", "link", "count"),
    [(0.93, "serial", 1), (0.5, "serial", 1), (1.1, "serial", 1), (1 + 2e-4, "serial", 0), (0.5, "virtual", 0)],
)
def test_a_device_whose_rate_is_not_what_it_says_is_reported_once(true: float, link: str, count: int) -> None:
    """Stiffness goes with the square of it."""
    clock, sink = FakeClock(), Recorder()
    pipeline = Pipeline(replace(PLAN, metadata={"link_kind": link}), [sink], clock)
    begin, rows = clock.t_ns, 2048
    for k in range(400):  # 32 s
        block = vibration(rows * k, rows)
        clock.t_ns = begin + round(rows * (k + 1) / (INFO.rate_hz * true) * 1e9)
        pipeline.step([INFO, replace(block, t_host_ns=clock.t_ns)])
        pipeline.tick(LinkStats(), {})
    said = [r.text for r in sink.delivered if isinstance(r, Notice) and r.code == "rate_untrue"]
    assert len(said) == count
    assert all(f"come at {INFO.rate_hz * true:.6g} Hz by this computer's clock" in text for text in said)


def test_a_rate_that_the_link_has_reported_is_not_reported_again() -> None:
    slow, warning = replace(INFO, rate_hz=6400.0), Notice(1, "error", "rate_untrue", "the device says 6400 Hz")
    data = vibration(0, 3000)
    for batches in ([[slow, data, warning]], [[warning, slow, data]], [[warning], [slow, data]]):
        _, sink = run(batches)
        assert [r for r in sink.delivered if isinstance(r, Notice)] == [warning]


def test_a_device_without_the_rigs_channels_is_all_that_is_said() -> None:
    """Not that the clock moved, by as much as it is since 1970."""
    notices: list[Notice] = []
    pipeline = Pipeline(PLAN, [], FakeClock(), notify=notices.append)
    with pytest.raises(ConfigError, match="not the rig's channel b2y"):
        pipeline.step([replace(INFO, signals=INFO.signals[:3])])
    pipeline.finish(LinkStats(), {})
    assert notices == []


def test_a_standstill_and_what_no_driver_says_of_its_losses_are_reported_at_once() -> None:
    clock, notices = FakeClock(), list[Notice]()
    pipeline = Pipeline(PLAN, [], clock, notify=notices.append)

    def after(seconds: float, *readings: Reading) -> list[str]:
        notices.clear()
        clock.t_ns += round(seconds * 1e9)
        pipeline.step(readings)
        pipeline.tick(LinkStats(), {})
        return [n.text.partition(";")[0] for n in notices]

    assert after(60.0) == []  # the link was being opened
    assert after(0.1, INFO, vibration(0, 256)) == []
    assert after(0.1, Gap(256, 64, "crc"), vibration(320, 64)) == []  # which its driver says
    lost = "samples lost: 7 by the device itself (device_lost), 57 on the way (sequence)"
    assert after(0.1, Gap(384, 7, "device_lost"), Gap(391, 57, "sequence"), vibration(448, 64)) == [lost]
    for k in range(8, 107):
        assert after(0.1, Gap(64 * k, 1, "sequence"), vibration(64 * k + 1, 63)) == []
    assert after(0.1, vibration(64 * 107, 64)) == ["samples lost: 99 on the way (sequence)"]
    assert after(10.1, Gap(64 * 108, 64, "source"), vibration(64 * 109, 64))[-1].startswith("samples lost: 64 that the")
    still = "this program did not run for 30.0 s (it was stopped, or the computer was busy)"
    assert after(30.0, vibration(64 * 110, 64))[0].startswith(still)


def test_the_last_losses_of_a_session_are_reported_in_its_log() -> None:
    sink = Recorder()
    pipeline = Pipeline(PLAN, [sink], FakeClock())
    for k in range(2):
        pipeline.step([INFO, vibration(512 * k, 256), Gap(512 * k + 256, 256, "sequence")])
        pipeline.tick(LinkStats(), {})
    pipeline.finish(LinkStats(), {})
    said = [r.text for r in sink.delivered if isinstance(r, Notice) and r.code == "samples_lost"]
    assert [text.partition(" on")[0] for text in said] == ["samples lost: 256"] * 2
