"""The index of samples that carry no counter, from when they came."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from drivers.protocol.period import estimate_period, round_rate
from drivers.protocol.time_axis import TimeAxis

MS = 1_000_000


def place(times_ms: object, rate_hz: float | None, batch: int = 7, hints: dict[int, int] | None = None) -> list[int]:
    axis = TimeAxis(rate_hz)
    t_ns = np.rint(np.asarray(times_ms) * 1e6).astype(np.int64)
    damaged = np.zeros(len(t_ns), np.int64)
    for k, number in (hints or {}).items():
        damaged[k] = number
    out = [axis.place(t_ns[k : k + batch], hints=damaged[k : k + batch]).index for k in range(0, len(t_ns), batch)]
    return [*np.concatenate([*out, axis.place(np.empty(0, np.int64), final=True).index]).tolist()]


@pytest.mark.parametrize("batch", [1, 7, 4096])
@pytest.mark.parametrize("hz", [97.66, 99.4, 100.0, 100.02, 102.4, 200.0])
def test_another_rate_is_no_loss(hz: float, batch: int) -> None:
    """A device 0.6 % off had a false loss every 160 samples, and one at 102.4 Hz was stretched."""
    assert place(np.arange(1000) * 1e3 / hz, 100.0, batch) == list(range(1000))


@pytest.mark.parametrize("hz", [994.0, 1000.0, 1006.0])
def test_another_rate_in_bursts_is_no_loss(hz: float) -> None:
    assert place(np.ceil(np.arange(6000) / hz / 0.016) * 16.0, 1000.0, 4096) == list(range(6000))


def test_late_and_bunched_samples_are_not_missing() -> None:
    """50 ms late, then all at once: nothing is lost."""
    times = [10.0 * k + (50 - 10 * (k - 60) if 60 <= k < 65 else 0) for k in range(200)]
    assert place(times, 100.0) == list(range(200))


def test_missing_samples_are_missing() -> None:
    kept = [k for k in range(400) if not 100 <= k < 107 and k != 250]
    assert place([10.0 * k for k in kept], 100.0) == kept
    assert place([10.0 * k for k in kept], None) == kept


def test_missing_amid_bursts() -> None:
    kept = [k for k in range(900) if not 300 <= k < 340]
    assert place([np.ceil(k / 16) * 16 for k in kept], 1000.0, 16) == kept


@pytest.mark.promise(
    "this computer stands still, a device without a counter",
    "30 times for 0.1 to 10 s, at 100.03 Hz, read at once then",
    "no loss is invented, none forgotten, and what follows is in its place",
)
@pytest.mark.parametrize("longest_s", [1.5, 10.0])
@pytest.mark.parametrize("batch_s", [0.2, 20.0])
def test_what_a_host_that_stood_still_reads_at_once_shifts_nothing(longest_s: float, batch_s: float) -> None:
    """After a pause longer than a second, what came late was counted as lost: 1700 samples in ten minutes."""
    rng, n, hz = np.random.default_rng(4), 60_000, 100.03
    begins_s, lengths_s = np.sort(rng.uniform(20.0, 580.0, 30)), rng.uniform(0.1, longest_s, 30)
    read_s = np.arange(n) / hz + rng.exponential(3e-4, n)
    for begin_s, length_s in zip(begins_s, lengths_s, strict=True):
        meanwhile = (read_s >= begin_s) & (read_s < begin_s + length_s)
        read_s[meanwhile] = begin_s + length_s + 2e-5 * np.arange(meanwhile.sum())
    kept = np.flatnonzero(rng.random(n) > 5e-4)
    t_ns = np.rint(np.maximum.accumulate(read_s)[kept] * 1e9).astype(np.int64)
    axis = TimeAxis(100.0)
    batches = np.split(t_ns, np.flatnonzero(np.diff(t_ns // round(batch_s * 1e9))) + 1)
    parts = [axis.place(part).index for part in batches]
    index = np.concatenate([*parts, axis.place(np.empty(0, np.int64), final=True).index])
    prompt = t_ns / 1e9 - kept / hz < 0.005
    off = (index - kept)[prompt]
    assert (off != 0).mean() < 1e-3  # of two losses close together, the first may be placed at the second
    assert off[-1] == 0
    assert axis.drifted() is None


def placed_by_reads(axis: TimeAxis, t_ns: np.ndarray, every_ns: int = 1) -> np.ndarray:
    """(n,) indices of samples that arrive at `t_ns`, placed read by read, of `every_ns` each."""
    parts = [axis.place(part).index for part in np.split(t_ns, np.flatnonzero(np.diff(t_ns // every_ns)) + 1)]
    return np.concatenate([*parts, axis.place(np.empty(0, np.int64), final=True).index])


def held_up(sent_s: np.ndarray, begins_s: np.ndarray, stall_s: float) -> np.ndarray:
    """(n,) s at which samples come where nothing comes for `stall_s` from each of `begins_s` on."""
    come_s = sent_s.copy()
    for begin_s in begins_s.tolist():
        come_s[(come_s > begin_s) & (come_s < begin_s + stall_s)] = begin_s + stall_s
    return np.maximum.accumulate(come_s)


def starved(sent_s: np.ndarray, rng: np.random.Generator, from_s: float, off_s: float, on_s: float) -> np.ndarray:
    """When frames are read by a host that has for some seconds, again and again, only moments for it."""
    read_s, now_s = sent_s.copy(), from_s
    while now_s < sent_s[-1]:
        end_s = now_s + rng.uniform(0.5, 8.0)
        while now_s < end_s:
            until_s = now_s + rng.exponential(off_s)
            part = slice(*np.searchsorted(sent_s, [now_s, until_s]))
            read_s[part] = np.maximum(read_s[part], until_s)
            now_s = until_s + rng.exponential(on_s)
        now_s += rng.uniform(3.0, 8.0)
    return np.ceil(np.maximum.accumulate(read_s) / 0.004) * 0.004


@pytest.mark.promise(
    "this computer has no time for the link, a device without a counter",
    "half of the time only moments of 3 to 30 ms, 0.1 to 3 s apart, also from the first frame on",
    "no loss is invented, none forgotten: the index at the end is right",
)
@pytest.mark.parametrize("from_s", [0.0, 15.0])
@pytest.mark.parametrize("lost_share", [0.0, 5e-4])
@pytest.mark.parametrize(("hz", "off_s", "on_s"), [(100.0, 0.1, 0.003), (100.0, 3.0, 0.01), (400.0, 0.4, 0.01)])
def test_a_starved_host_shifts_nothing(hz: float, off_s: float, on_s: float, lost_share: float, from_s: float) -> None:
    """The axis counted up to 2000 samples too many in 200 s, and took 100 Hz for 5 kHz when starved from the start."""
    rng, n = np.random.default_rng(0), round(120 * hz)
    sent_s = np.maximum.accumulate(np.arange(n) / (hz * 1.0001) + rng.exponential(3e-4, n))
    kept = np.flatnonzero(rng.random(n) >= lost_share)
    kept = kept[: np.searchsorted(sent_s[kept], 110.0)]
    read_s = starved(sent_s[kept], rng, from_s, off_s, on_s)
    even_s = np.append(read_s, read_s[-1] + np.arange(1, 400) / hz)  # until it has time again
    kept = np.append(kept, round((read_s[-1] - sent_s[kept[-1]]) * hz) + kept[-1] + np.arange(1, 400))
    axis, t_ns = TimeAxis(hz), np.rint(even_s * 1e9).astype(np.int64)
    index = placed_by_reads(axis, t_ns, every_ns=200_000_000)
    off = index - kept - (index[0] - kept[0])
    assert axis.rate_hz == hz
    assert abs(off[-1]) <= 1  # of a loss before it first had time, nothing tells
    assert from_s == 0.0 or (off != 0).mean() < (0.2 if lost_share else 0.01)


def read_every(sent_s: np.ndarray, read_s: float, jitter_s: float) -> np.ndarray:
    """(n,) ns at which an adapter that is read every `read_s`, give or take `jitter_s`, hands over what was sent."""
    late_s = np.random.default_rng(1).exponential(jitter_s, len(sent_s))
    times_s = np.maximum.accumulate(np.ceil(sent_s / read_s) * read_s + late_s)
    return np.asarray(np.rint(times_s * 1e9), np.int64)


@pytest.mark.parametrize("rig_file", [True, False])
@pytest.mark.parametrize(("hz", "read_s"), [(25.0, 0.032), (200.0, 0.004), (400.0, 0.032)])
def test_reads_of_an_adapter_are_no_faster_device(hz: float, read_s: float, rig_file: bool) -> None:
    """25 Hz read every 32 ms passed for 31.25 Hz with a fifth lost; and a last frame alone in its read for a loss."""
    sent_s = np.arange(round(40 * hz)) / hz
    axis = TimeAxis(hz if rig_file else None, learn=2000)
    index = placed_by_reads(axis, read_every(sent_s, read_s, 1e-4))
    assert axis.rate_hz == pytest.approx(hz, rel=2e-3)
    np.testing.assert_array_equal(index, np.arange(len(sent_s)))


def test_a_device_at_twice_its_rate_is_seen_whatever_was_lost_or_held_up() -> None:
    """The device was counted at the rate of the rig file, silently: a record of twice the length."""
    rng, sent_s = np.random.default_rng(0), np.arange(60_000) / 2000.0
    sent_s = sent_s[rng.random(len(sent_s)) > 0.01]
    come_s = held_up(sent_s, np.cumsum(rng.exponential(2.0, 30)), 0.2)
    axis = TimeAxis(1000.0)
    placed_by_reads(axis, read_every(come_s, 0.001, 1e-4))
    assert axis.rate_hz == pytest.approx(2000.0, rel=0.02)


@pytest.mark.parametrize(("hz", "seconds"), [(25.0, 60.0), (1000.0, 30.0)])
def test_a_rate_that_could_not_be_measured_at_first_is_reported_later(hz: float, seconds: float) -> None:
    sent_s = np.arange(round(seconds * hz)) / (1.024 * hz)
    come_s = held_up(sent_s, np.cumsum(np.random.default_rng(0).exponential(0.5, 20)), 0.3)
    axis = TimeAxis(hz)
    placed_by_reads(axis, read_every(come_s, 0.016, 2e-3))
    found = axis.rate_hz if axis.rate_hz != hz else axis.drifted()
    assert found == pytest.approx(1.024 * hz, rel=5e-3)


@pytest.mark.parametrize("hz", [400.0, 1000.0])
def test_losses_at_random_among_uneven_stamps_are_no_slower_device(hz: float) -> None:
    """With 2 % lost and reads every 4 ms the rate was taken 2 % too low, and no loss was reported."""
    rng, n = np.random.default_rng(0), round(30 * hz)
    read_s = np.ceil(np.maximum.accumulate(np.arange(n) / hz + rng.exponential(3e-4, n)) / 0.004) * 0.004
    kept = np.flatnonzero(rng.random(n) >= 0.02)
    axis, t_ns = TimeAxis(hz), np.rint(read_s[kept] * 1e9).astype(np.int64)
    parts = [axis.place(t_ns[k : k + 100]).index for k in range(0, len(t_ns), 100)]
    index = np.concatenate([*parts, axis.place(np.empty(0, np.int64), final=True).index])
    assert axis.rate_hz == hz
    assert abs(int(index[-1] - kept[-1])) <= 0.03 * (n - len(kept))


@pytest.mark.parametrize("batch", [4, 4096])
def test_losses_in_bursts_are_counted_and_said_to_be_unsure(batch: int) -> None:
    """Bursts of 4 ms at 1 kHz, one frame of 97 lost: none closed up, each misplaced by a burst at most."""
    kept = np.delete(np.arange(4000), np.arange(50, 4000, 97))
    axis, t_ns = TimeAxis(1000.0), (np.ceil((kept + 1) / 4) * 4 * MS).astype(np.int64) + 1000 * (kept % 17)
    parts = [axis.place(t_ns[k : k + batch]) for k in range(0, len(t_ns), batch)]
    parts.append(axis.place(np.empty(0, np.int64), final=True))
    off = np.concatenate([part.index for part in parts]) - kept
    assert off[-1] == off[0] == 0
    assert np.abs(off).max() < 4
    assert sum(part.unsure for part in parts) > 30
    assert 1 <= max(part.within for part in parts) < 4


def test_a_loss_in_a_burst_is_placed_where_a_frame_was_damaged() -> None:
    kept = np.delete(np.arange(2000), np.random.default_rng(3).permutation(np.arange(50, 1900, 23))[:20])
    at = dict.fromkeys(np.flatnonzero(np.diff(kept, prepend=-1) > 1).tolist(), 1)
    assert place(np.ceil((kept + 1) / 4) * 4.0, 1000.0, 4, at) == kept.tolist()


@pytest.mark.parametrize("ppm", [300, -300])
@pytest.mark.parametrize("batch", [50, 4096])
def test_a_clock_300_ppm_off_is_followed(ppm: int, batch: int) -> None:
    assert place(np.arange(20_000) * 10.0 * (1 + ppm * 1e-6), 100.0, batch) == list(range(20_000))


def test_a_rate_that_drifts_away_is_followed_and_reported() -> None:
    axis = TimeAxis(100.0)
    t_ns = (np.cumsum(np.linspace(10.0, 10.04, 20_000)) * MS).astype(np.int64)
    index = np.concatenate([axis.place(t_ns[k : k + 1000]).index for k in range(0, 20_000, 1000)])
    assert index.tolist() == list(range(20_000))
    assert axis.drifted() == pytest.approx(99.65, abs=0.1)


def test_certain_samples_are_not_held() -> None:
    axis = TimeAxis(100.0)
    t_ns = np.arange(300) * 10 * MS
    axis.place(t_ns[:102])
    for k in range(102, 300):
        assert len(axis.place(t_ns[k : k + 1]).index) == 1
    assert axis.held == 0


def test_a_leap_over_days_is_a_gap_of_a_second_and_reported() -> None:
    axis = TimeAxis(100.0)
    t_ns = np.arange(400) * 10 * MS
    t_ns[200:] += 3 * 86_400_000 * MS
    index = axis.place(t_ns, final=True).index
    assert axis.leapt == 1
    assert index[-1] == pytest.approx(498, abs=1)


@given(st.lists(st.integers(-(2**62), 2**62), max_size=40), st.integers(1, 9), st.sampled_from([None, 100.0, 1e6]))
@example([1, 0, -1, 3, 0, 0, 0, 1], 1, None)  # a mean period of zero
def test_indices_always_rise(times: list[int], batch: int, rate_hz: float | None) -> None:
    axis, t_ns = TimeAxis(rate_hz), np.array(times, np.int64)
    parts = [axis.place(t_ns[k : k + batch]).index for k in range(0, len(t_ns), batch)]
    got = np.concatenate([*parts, axis.place(np.empty(0, np.int64), final=True).index])
    assert len(got) in (0, len(times))
    assert (np.diff(got) > 0).all()


@pytest.mark.parametrize(
    ("name", "hz", "times_s"),
    [
        ("exact", 102.4, np.arange(600) / 102.4), ("stamps of 1 ms", 333.0, np.floor(np.arange(600) / 0.333) / 1e3),
        ("finer than stamps of 1 ms", 700.0, np.floor(np.arange(600) / 0.7) / 1e3),
        ("several to a stamp", 2000.0, np.floor(np.arange(600) / 2.0) / 1e3),
        ("polls of 16 ms", 100.0, np.ceil(np.arange(600) / 1.6) * 0.016),
        ("polls of 16 ms", 1006.0, np.ceil(np.arange(4000) / 1006 / 0.016) * 0.016),
        ("a hole", 100.0, np.delete(np.arange(300), np.arange(120, 170)) / 100.0),
    ],
)  # fmt: skip
def test_the_period_is_what_most_distances_agree_on(name: str, hz: float, times_s: np.ndarray) -> None:
    found = estimate_period(np.rint(times_s * 1e9).astype(np.int64))
    assert found is not None
    assert found.rate_hz == pytest.approx(hz, rel=max(2 * found.error_rel, 1e-5)), name
    assert found.error_rel < 0.01


def test_the_period_with_losses_at_random() -> None:
    rng = np.random.default_rng(1)
    for share in (0.05, 0.3):
        t_ns = np.flatnonzero(rng.random(600) > share) * 10 * MS + rng.integers(0, MS // 10, 600)[0]
        found = estimate_period(t_ns)
        assert found is not None
        assert found.rate_hz == pytest.approx(100.0, rel=1e-6)


def test_a_rate_is_a_short_number() -> None:
    assert [round_rate(hz, 1e-6) for hz in (100.02, 97.66, 333.001, 102.4)] == [100.0, 97.66, 333.0, 102.4]
