"""Every sample is in one block or one gap, at its true index, whatever the device and the link do to it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from ramp_device import PERIOD, Ramp, Record, ramp_device

from drivers.can.can_decoder import CanDecoder
from drivers.can.can_frames import CanFrames
from drivers.contract.notices import Notices
from drivers.contract.reading import Block, Gap, Info, LinkStats, Reading
from drivers.protocol.continuity import Continuity
from drivers.protocol.faults import Fault
from drivers.protocol.protocol import (
    BASE_ID,
    ID_FD16,
    ID_INFO,
    ID_SYNC_FD,
    NO_MODULUS,
    SampleFrames,
    pack_info,
    unpack_info,
)
from drivers.serial import cobs
from drivers.serial.serial_decoder import SerialDecoder
from drivers.simulated.simulated import SimulatedDevice, WireFrame

LAYOUTS = ("fd16", "fd24", "classic", "serial16", "serial24")
SLICE_S = 0.01
INFO = BASE_ID + ID_INFO


class Wire:
    """Feeds a device's frames to a decoder in batches, at the times they leave the device."""

    def __init__(self, device: SimulatedDevice, batch: int = 40) -> None:
        self.stats = LinkStats()
        self.serial = device.config.serial
        self.decoder = SerialDecoder(self.stats) if self.serial else CanDecoder(self.stats)
        self.record = Record()
        self.readings: list[Reading] = []
        self.device = device
        self._batch = batch

    def feed(self, frames: Iterable[WireFrame]) -> None:
        held: list[WireFrame] = []
        for frame in [*frames, None]:
            if frame is not None:
                held.append(frame)
            if held and (frame is None or len(held) >= self._batch):
                t_ns = round(held[-1].due_s * 1e9)
                if isinstance(self.decoder, SerialDecoder):
                    out = self.decoder.feed(b"".join(_damage(cobs.encode(f.data), f.damaged) for f in held), t_ns)
                else:
                    arrived = [f for f in held if f.damaged != "flip"]
                    cut = [(f.identifier, f.data[:-1] if f.damaged else f.data, t_ns) for f in arrived]
                    out = self.decoder.feed(CanFrames.build(cut), t_ns)
                self.readings += out
                self.record.take(out)
                held = []

    def run(self, frames: int) -> Record:
        self.feed(self.device.next(frames))
        return self.record


def _damage(wire: bytes, how: str) -> bytes:
    if how == "flip":
        return wire[:3] + bytes((wire[3] ^ 16,)) + wire[4:]
    return wire[:3] + wire[4:] if how == "short" else wire


def device_of(layout: str, *faults: Fault, **config: object) -> SimulatedDevice:
    rate_hz = 8000.0 if layout == "classic" else 25_600.0
    return ramp_device(layout, rate_hz, None, faults=faults, rows=16, **config)


def frames_of(layout: str) -> int:
    return 2400 if layout == "classic" else 300


def whole(layout: str, samples: int) -> int:
    return samples - samples % 800 if layout == "classic" else samples  # up to the last sync frame


@pytest.mark.parametrize("layout", LAYOUTS)
def test_undisturbed(layout: str) -> None:
    wire = Wire(device_of(layout))
    record = wire.run(frames_of(layout))
    assert not record.gaps
    assert not record.notices
    assert record.offset == 0
    assert record.samples >= whole(layout, wire.device.samples_made) - 800 * (layout == "classic")


@pytest.mark.parametrize("layout", ["fd16", "fd24", "serial16", "serial24"])
@pytest.mark.parametrize(
    ("kind", "count", "reason", "code"),
    [
        ("drop", 1, "sequence", ""), ("drop", 9, "sequence", ""), ("device_lost", 5, "device_lost", ""),
        ("version", 4, "version", "other_version"), ("stuck", 6, "stuck", "stuck_counter"),
        ("silent", 80, "sequence", ""), ("duplicate", 3, "", "duplicate"), ("reorder", 1, "sequence", "reordered"),
        ("restart", 50, "restart", "device_restart"),
    ],
)  # fmt: skip
def test_each_fault_is_named_and_costs_what_it_must(layout: str, kind: str, count: int, reason: str, code: str) -> None:
    wire = Wire(device_of(layout, Fault(kind, 100, count)))
    record = wire.run(300)
    rows = wire.device.config.frame_rows
    assert {gap.reason for gap in record.gaps} == ({reason} if reason else set())
    lost = record.lost(reason) if reason else 0
    if kind == "restart":
        assert lost >= 1
        assert wire.stats.restarts == 1
    else:
        assert lost == (0 if kind == "duplicate" else count * rows)
        assert record.offset == 0
        assert record.next_index == wire.device.samples_made
    assert record.codes() == ({code} if code else set())
    assert wire.stats.lost_samples == lost


@pytest.mark.parametrize("layout", ["serial16", "serial24", "fd16", "fd24"])
def test_damaged_frames_are_a_gap(layout: str) -> None:
    wire = Wire(device_of(layout, Fault("short", 100, 3)))
    record = wire.run(300)
    assert record.lost("crc") == 3 * wire.device.config.frame_rows
    assert record.offset == 0
    assert wire.stats.crc_errors == 3


def test_an_overflow_is_blamed_for_the_hole_behind_the_frames_still_queued() -> None:
    wire = Wire(device_of("fd16", Fault("drop", 200, 9), Fault("drop", 250, 2)))
    wire.run(100)
    wire.decoder.cause("overflow")
    record = wire.run(200)
    assert [(gap.count, gap.reason) for gap in record.gaps] == [(63, "overflow"), (14, "sequence")]


def test_device_lost_and_link_loss_are_distinguished() -> None:
    wire = Wire(device_of("fd16", Fault("device_lost", 100, 2), Fault("drop", 102, 3)))
    record = wire.run(300)
    assert (record.lost("device_lost"), record.lost("sequence")) == (14, 21)


def test_restart_is_as_long_as_the_hosts_clock_says() -> None:
    for layout in ("fd16", "fd24", "serial16"):
        wire = Wire(device_of(layout, Fault("restart", 200, 1000)), batch=1)
        record = wire.run(600)
        away = 1000 * wire.device.config.frame_rows
        assert record.lost("restart") == pytest.approx(away, rel=0.01)


@pytest.mark.parametrize("layout", ["fd16", "serial16"])
def test_another_description_begins_anew(layout: str) -> None:
    """Another rate on the same line, counter and epoch alike: reported, and never joined as if nothing had happened."""
    wire = Wire(device_of(layout))
    wire.run(100)
    slow = ramp_device(layout, 12_800.0, None, rows=16)
    wire.feed(slow.next(100))
    assert [info.rate_hz for info in wire.record.infos] == [25_600.0, 12_800.0]
    assert [gap.reason for gap in wire.record.gaps] == ["restart"]
    assert wire.record.codes() == {"info_changed", "device_restart"}


@pytest.mark.parametrize("epoch", [1, 2])
@pytest.mark.parametrize("layout", ["fd16", "fd24", "serial16", "classic"])
def test_a_device_with_another_range_is_not_read_before_it_says_so(
    layout: str, epoch: int, record_property: Callable[[str, object], None]
) -> None:
    """It takes the place of the first, and is joined 0.3 s after its records: the next come 0.7 s later. Until then
    its samples were read by the first one's, ten times too large. epoch : 1 is the first one's, too."""
    how = f"another range, joined between two of its records, {'another' if epoch == 2 else 'the same'} start number"
    _another_in_its_place(layout, epoch, 0.3, how, record_property)


@pytest.mark.parametrize("on_s", [30, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("layout", ["fd16", "fd24", "serial16", "classic"])
def test_nor_is_one_with_the_same_start_number_that_has_run_for_longer(
    layout: str, on_s: int, record_property: Callable[[str, object], None]
) -> None:
    """It went on from the first: by a gap of what it is ahead, and its samples were read by the first one's."""
    how = f"another range, the same start number, on for {on_s} s more, joined between two of its records"
    gaps = _another_in_its_place(layout, 1, on_s + 0.3, how, record_property)
    assert sum(gap.count for gap in gaps) < 5 * 2048, "the axis stays with our clock"


def _another_in_its_place(
    layout: str, epoch: int, on_s: float, how: str, record_property: Callable[[str, object], None]
) -> list[Gap]:
    """on_s : since its start, when it is plugged in, 0.8 s after the first was pulled."""
    rate_hz = 512.0 if layout == "classic" else 2048.0
    wire = Wire(ramp_device(layout, rate_hz, None))
    rows = wire.device.config.frame_rows
    n = 3 * round(rate_hz) // rows
    wire.run(n)
    other = ramp_device(layout, rate_hz, None, full_scale=49.05)
    other._epoch = epoch
    frames = other.next(n + int(on_s * rate_hz / rows))
    wire.feed([replace(f, due_s=f.due_s - on_s + 3.8) for f in frames if f.due_s > on_s])
    first = wire.record.infos[0]
    at = next(k for k, r in enumerate(wire.readings) if isinstance(r, Info) and r != first)
    by_the_first = sum(len(r.counts) for r in wire.readings[:at] if isinstance(r, Block))
    read = max(by_the_first - n * rows, 0)
    assert read == 0
    assert wire.record.codes() >= {"undescribed", "device_restart", "info_changed"}
    assert wire.record.gaps[-1].reason == "restart"
    assert wire.record.samples - by_the_first > 1.7 * rate_hz
    promised = "none of its samples read by the old description"
    value = f"{read} read by it, {wire.stats.other['undescribed_frames']} frames dropped"
    record_property("reliability", f"another device in its place, {layout} | {how} | {promised}, told | {value}")
    return wire.record.gaps


def test_a_device_that_never_describes_its_new_start_is_read_after_3_s() -> None:
    wire = Wire(ramp_device("fd16", 2048.0, None, faults=(Fault("restart", 300, 10),)))
    rows = wire.device.config.frame_rows
    frames = wire.device.next(300) + [f for f in wire.device.next(2000) if f.identifier != INFO]
    wire.feed(frames)
    assert wire.record.codes() == {"undescribed", "device_restart"}
    assert wire.record.lost("restart") == pytest.approx(3 * 2048, abs=80 * rows)
    assert wire.record.samples > 1400 * rows


@pytest.mark.parametrize("far_s", [100_000, 1e11])
def test_a_counter_and_a_clock_that_leap_by_days_are_a_restart(
    far_s: float, record_property: Callable[[str, object], None]
) -> None:
    """As a gap they would shift the axis by as much; by centuries, the log has no number for it, and stopped."""
    wire = Wire(device_of("serial16"))
    wire.run(300)
    wire.device._index += round(far_s * 25_600)
    before = wire.record.samples
    wire.run(4000)
    assert wire.record.codes() == {"device_restart", "undescribed"}
    assert {gap.reason for gap in wire.record.gaps} == {"restart"}
    assert sum(gap.count for gap in wire.record.gaps) < 1.1 * 25_600
    assert wire.record.samples - before > 1.3 * 25_600
    row = (
        f"device's counter and clock leap, serial16 | by {far_s:g} s at once | a restart, the axis stays with our clock"
    )
    record_property("reliability", f"{row} | gap of {sum(gap.count for gap in wire.record.gaps)} samples, told")


@pytest.mark.parametrize(("serial_number", "exact"), [(7, True), (0, False)])
@pytest.mark.parametrize("layout", ["fd16", "serial16"])
def test_what_was_read_late_before_a_reconnect_shifts_nothing(
    layout: str, serial_number: int, exact: bool, record_property: Callable[[str, object], None]
) -> None:
    """A busy host reads what was sent 70 s ago, then the link is lost: the same device, by its serial and start number,
    is 74 s on after 4 s. One without a serial number may be another."""
    wire = Wire(ramp_device(layout, 2048.0, None, serial_number=serial_number))
    rows = wire.device.config.frame_rows
    n = round(2 * 2048 / rows)
    wire.feed([replace(f, due_s=f.due_s + 70.0) for f in wire.device.next(n)])
    wire.device.next(round(72 * 2048 / rows))
    wire.decoder.cause("reconnect")
    wire.feed([replace(f, due_s=f.due_s + 2.0) for f in wire.device.next(3 * n)])
    lost = sum(gap.count for gap in wire.record.gaps)
    assert (wire.record.offset == 0) is exact
    assert {gap.reason for gap in wire.record.gaps} == ({"reconnect"} if exact else {"restart"})
    if exact:
        how = f"what was sent 70 s ago is read, the link is lost and comes back, {layout}"
        row = f"host far behind before a reconnect | {how} | no index shifts | gap of {lost} samples, the rest in place"
        record_property("reliability", row)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_two_devices_with_the_same_identifiers_are_told_and_not_mixed(
    layout: str, record_property: Callable[[str, object], None]
) -> None:
    """Started at once, their counters and clocks agree: half of each would look like a record without a loss."""
    rate_hz = 512.0 if layout == "classic" else 2048.0
    first, second = (ramp_device(layout, rate_hz, None, serial_number=k) for k in (0xA1, 0xB2))
    wire = Wire(first, batch=1)
    rows = first.config.frame_rows
    per_s = round(rate_hz / rows)
    apart = ramp_device(layout, rate_hz, None, serial_number=0xA1)
    wire.feed(frame for _ in range(4 * per_s) for frame in (*first.next(1), *second.next(1)))
    mixed = wire.record.samples
    assert wire.record.codes() >= {"two_devices"}
    assert wire.stats.other["mixed_frames"] > 4 * per_s
    assert mixed < 2.1 * rate_hz, "until both have described themselves twice"
    apart.next(4 * per_s)
    wire.feed(apart.next(8 * per_s))  # the other is gone
    alone = wire.record.samples - mixed
    assert alone > 3 * rate_hz
    assert max(n.t_host_ns for n in wire.record.notices if n.code == "two_devices") < 5.5e9
    texts = [n.text for n in wire.record.notices if n.code == "two_devices"]
    assert "000000A1 and 000000B2" in texts[0]
    row = f"two devices with the same identifiers, {layout} | frames of both in turn for 4 s, then of one | "
    row += "told, no sample of either taken for the other's while both are heard, data again 3 s after one is gone"
    record_property(
        "reliability", f"{row} | {mixed / rate_hz:.1f} s until known; then none, and {alone / rate_hz:.1f} s"
    )


def test_a_damaged_serial_number_makes_no_second_device() -> None:
    """Without a check sum a record may say anything, once."""
    wire = Wire(ramp_device("fd16", 2048.0, None))
    for k in range(6):
        frames = wire.device.next(293)
        wire.feed(frames)
        record = unpack_info(next(f.data for f in frames if f.identifier == INFO))
        assert record is not None
        wire.feed([WireFrame(frames[-1].due_s, INFO, pack_info(replace(record, serial_number=77 + k)))])
    assert wire.record.codes() == set()
    assert wire.record.samples == 6 * 293 * wire.device.config.frame_rows


@pytest.mark.parametrize("wrong", ["name", "scale", "unit"])
def test_a_damaged_record_on_a_link_without_check_sums_is_no_description(
    wrong: str, record_property: Callable[[str, object], None]
) -> None:
    """It had named a channel, and scaled it, for a second; and was a restart of the device."""
    wire = Wire(ramp_device("fd16", 2048.0, None))
    assert isinstance(wire.decoder, CanDecoder)
    wire.decoder = CanDecoder(wire.stats, unchecked=True)
    for _ in range(4):
        frames = wire.device.next(293)
        wire.feed(frames)
        record = unpack_info(next(f.data for f in frames if f.identifier == INFO))
        assert record is not None
        other = {"name": "b1z", "scale": 7.0, "unit": "V"}[wrong]
        signal = replace(record.signal, **{wrong: other})  # type: ignore[arg-type]
        wire.feed([WireFrame(frames[-1].due_s, INFO, pack_info(replace(record, signal=signal)))])
    assert len(wire.record.infos) == 1
    assert wire.record.codes() == set()
    row = f"info record damaged, slcan | another {wrong} of a channel, once a second | the description as it was"
    record_property("reliability", f"{row} | held, no gap")


@pytest.mark.parametrize("unchecked", [False, True])
def test_channels_in_another_order_are_never_half_the_old_half_the_new(unchecked: bool) -> None:
    """A device that keeps no number of its starts comes back with its cables swapped."""
    first = ramp_device("fd16", 2048.0, None)
    order = ("b2y", "b1x", "b1y", "b2x")
    settings = replace(first.config, channels=order)
    second = SimulatedDevice(Ramp(settings.signals()[0].scale), settings)
    wire = Wire(first, batch=1)
    wire.decoder = CanDecoder(wire.stats, unchecked=unchecked)
    wire.run(600)
    wire.feed(second.next(1000))
    assert [tuple(s.name for s in info.signals) for info in wire.record.infos] == [first.config.channels, order]


@pytest.mark.parametrize("lost", [80_000, 240_000, 400_000, 560_000, 1_040_000])
def test_a_program_that_stood_still_finds_every_sample_where_it_was(
    lost: int, record_property: Callable[[str, object], None]
) -> None:
    """What the link kept comes late and at once; then what came when it was full again had been lost. Most frames of
    fd24 have no time of their own, and their counter wraps within 12.8 s: the host's clock says a wrong one."""
    wire = Wire(device_of("fd24"))
    wire.run(5200)
    late = wire.device.next(1600)
    wire.feed([replace(f, due_s=f.due_s + lost / 25_600) for f in late])
    wire.device._index += lost
    wire.run(2000)
    assert sum(gap.count for gap in wire.record.gaps) == lost
    assert wire.record.next_index == wire.device._index
    assert wire.record.offset == -lost % PERIOD
    assert wire.record.codes() == set()
    how = f"for {lost / 25_600:.1f} s, 0.3 s of it kept by the link, the counter wraps in 12.8 s"
    promised = "every sample at its index, the loss exact"
    record_property("reliability", f"program stands still, fd24 | {how} | {promised} | {lost} lost, all in gaps")


@pytest.mark.parametrize("layout", ["fd16", "fd24"])
@pytest.mark.parametrize("pause_s", [0.3, 2.0, 8.0, 20.0])
def test_a_pause_of_the_sampling_is_no_jump_of_the_clock(
    layout: str, pause_s: float, record_property: Callable[[str, object], None]
) -> None:
    """The device's clock and ours go on, its counter does not. If only its clock moves, that has jumped."""
    for paused in (True, False):
        wire = Wire(device_of(layout))
        wire.run(2600)
        wire.feed([_clock_on(f, pause_s, pause_s if paused else 0.0) for f in wire.device.next(2000)])
        if not paused and pause_s > 1.0:
            assert (wire.record.codes(), wire.record.gaps) == ({"device_clock_jump"}, [])
            continue
        (gap,) = wire.record.gaps
        rows = wire.device.config.frame_rows
        assert gap.reason == "silent"
        assert gap.count == pytest.approx(pause_s * 25_600, abs=rows)
        late = gap.index - 2600 * rows
        assert 0 <= late < (2560 if layout == "fd24" else rows)
        assert wire.record.codes() == {"paused"}
    promised = "told, a gap `silent` within 0.1 s of its place, no jump of its clock"
    how, value = f"for {pause_s:g} s; its clock goes on", f"{gap.count} samples, {1e3 * late / 25_600:.0f} ms late"
    record_property("reliability", f"device stops sampling, {layout} | {how} | {promised} | {value}")


def _clock_on(frame: WireFrame, device_s: float, host_s: float) -> WireFrame:
    at = {BASE_ID + ID_FD16: 4, BASE_ID + ID_SYNC_FD: 8}.get(frame.identifier)
    data = frame.data
    if at is not None:
        time_us = int.from_bytes(data[at : at + 4], "little") + round(device_s * 1e6)
        data = data[:at] + (time_us % 2**32).to_bytes(4, "little") + data[at + 4 :]
    return replace(frame, due_s=frame.due_s + host_s, data=data)


def test_restart_without_epochs_is_seen_by_the_clock() -> None:
    device = device_of("fd16", Fault("restart", 200, 100))
    device._epoch = 0
    wire = Wire(device)
    frames = device.next(200)
    wire.feed(frames)
    restarted = device.next(100)
    for frame in restarted:
        if frame.identifier == 0x300:
            data = bytearray(frame.data)
            data[3] &= 0x0F
            object.__setattr__(frame, "data", bytes(data))
    wire.feed(restarted)
    assert wire.stats.restarts == 1
    assert wire.record.lost("restart") >= 1


@pytest.mark.parametrize("layout", ["fd16", "fd24", "serial16", "classic"])
def test_a_silence_longer_than_the_counters_wrap_is_exact(layout: str) -> None:
    """fd16 wraps after 17.9 s, classic after 16 samples; 40 s pass."""
    device = device_of(layout)
    wire = Wire(device)
    wire.run(frames_of(layout))
    made = device.samples_made
    silent = round(40 * device.config.rate_hz / device.config.frame_rows)
    while silent > 0:
        device.next(min(silent, 4000))
        silent -= 4000
    record = wire.run(frames_of(layout))
    assert record.offset == 0
    missing = device.samples_made - made - frames_of(layout) * device.config.frame_rows
    assert record.lost("sequence") == pytest.approx(missing, abs=2 * 800 * (layout == "classic"))


def test_the_device_clock_wraps_unnoticed() -> None:
    """u32 microseconds wrap after 71.6 min."""
    device = device_of("fd16")
    device._index = 4294 * 25_600 // 7 * 7  # 0.97 s before the wrap
    record = Wire(device).run(3700)
    assert record.next_index == 3700 * 7
    assert not record.gaps
    times = [block.t_device_ns for block in record.blocks]
    assert times == sorted(times, key=lambda t: t or 0)
    assert times[-1] - times[0] == pytest.approx((record.blocks[-1].index) / 25_600 * 1e9, abs=2e3)


def test_device_time_is_that_of_row_0() -> None:
    for layout in LAYOUTS:
        wire = Wire(device_of(layout), batch=33)
        record = wire.run(frames_of(layout))
        for block in record.blocks:
            assert block.t_device_ns is not None
            assert block.t_device_ns / 1e9 == pytest.approx(block.index / wire.device.config.rate_hz, abs=2e-6)


def test_a_lost_group_of_16_on_classic_can_is_never_a_shift() -> None:
    """16 frames lost in a row leave no trace in a 4-bit counter: the window must go."""
    for count in (16, 32, 5, 21):
        wire = Wire(device_of("classic", Fault("drop", 1000, count)))
        record = wire.run(2500)
        assert record.offset == 0
        assert sum(gap.count for gap in record.gaps) == (count if count == 5 else 800)


def test_a_frame_sent_twice_and_16_lost_do_not_cancel() -> None:
    wire = Wire(device_of("classic", Fault("drop", 1000, 16), Fault("duplicate", 1100)))
    record = wire.run(2500)
    assert record.offset == 0
    assert sum(gap.count for gap in record.gaps) == 800
    assert wire.stats.duplicates == 1


@pytest.mark.parametrize("layout", ["fd16", "serial16"])
def test_clock_jump_alone_is_no_gap(layout: str) -> None:
    device = device_of(layout)
    wire = Wire(device)
    wire.run(100)
    frames = device.next(100)
    at, size = (4, 4) if layout == "fd16" else (16, 8)
    for frame in frames:
        data = bytearray(frame.data)
        if frame.identifier == 0x300 or (layout == "serial16" and data[1] == 1):
            later = int.from_bytes(data[at : at + size], "little") + 7_000_000
            data[at : at + size] = later.to_bytes(size, "little")
            object.__setattr__(frame, "data", bytes(data))
    wire.feed(frames)
    assert not wire.record.gaps
    assert wire.record.codes() == {"device_clock_jump"}


def test_a_pause_in_sampling_is_a_silent_gap() -> None:
    """The counter goes on where it stopped, device and host clock say 3 s passed."""
    device = device_of("serial16")
    wire = Wire(device)
    wire.run(100)
    frames = device.next(100)
    for frame in frames:
        data = bytearray(frame.data)
        if data[1] == 1:
            later = int.from_bytes(data[16:24], "little") + 3_000_000
            data[16:24] = later.to_bytes(8, "little")
        object.__setattr__(frame, "data", bytes(data))
        object.__setattr__(frame, "due_s", frame.due_s + 3.0)
    wire.feed(frames)
    assert wire.record.lost("silent") == pytest.approx(3 * 25_600, abs=1)


FAULTS = st.lists(
    st.builds(
        Fault,
        st.sampled_from(["drop", "duplicate", "reorder", "short", "device_lost", "stuck", "silent", "version"]),
        st.integers(20, 280),
        st.integers(1, 30),
    ),
    max_size=6,
)


@pytest.mark.slow
@settings(max_examples=200)
@given(st.sampled_from(LAYOUTS), FAULTS, st.integers(1, 200))
def test_no_fault_ever_shifts_the_axis(layout: str, faults: list[Fault], batch: int) -> None:
    """The ramp at each index is the sample the device took then; losses add up."""
    scale = 8 if layout == "classic" else 1
    if layout == "classic":
        faults = [f for f in faults if f.kind != "reorder"]  # a 4-bit counter cannot see it, and no CAN bus does it
    if layout == "fd24" and any(f.kind == "stuck" for f in faults):
        faults = [f for f in faults if f.kind == "stuck"]  # no stamp in each frame: lost and stuck at once is hopeless
    wire = Wire(device_of(layout, *(Fault(f.kind, f.at * scale, f.count) for f in faults)), batch)
    wire.run(300 * scale)
    wire.run(100)  # a good end, so that the axis is complete
    record = wire.record
    for block in record.blocks:
        assert (int(block.counts[0, 0]) + PERIOD // 2 - block.index) % PERIOD == 0
    assert record.next_index - sum(gap.count for gap in record.gaps) == record.samples
    assert sum(gap.count for gap in record.gaps) == wire.stats.lost_samples


@settings(max_examples=40)
@example("fd16", [Fault("drop", 101), Fault("stuck", 102)], 1)  # a counter one behind, a clock that is right
@given(st.sampled_from(["fd16", "fd24", "serial16", "classic"]), FAULTS, st.integers(1, 60))
def test_any_batching_gives_the_same(layout: str, faults: list[Fault], batch: int) -> None:
    scale = 8 if layout == "classic" else 1
    scaled = [Fault(f.kind, f.at * scale, f.count) for f in faults if f.kind != "reorder" or scale == 1]
    seen = []
    for size in (batch, 100_000):
        wire = Wire(device_of(layout, *scaled), size)
        wire.run(300 * scale)
        blocks = [reading for reading in wire.readings if isinstance(reading, Block)]
        gaps = [reading for reading in wire.readings if isinstance(reading, Gap)]
        rows = {b.index + k: tuple(row) for b in blocks for k, row in enumerate(b.counts.tolist())}
        seen.append((rows, [(g.index, g.count) for g in gaps if g.reason != "restart"]))
    assert seen[0] == seen[1]


@given(st.lists(st.tuples(st.integers(0, 2**20), st.integers(0, 255), st.integers(0, 2), st.integers(0, 2**33)),
                max_size=30), st.integers(1, 8))  # fmt: skip
def test_any_frames_at_all_keep_the_axis_whole(frames: list[tuple[int, int, int, int]], rows: int) -> None:
    """No counter, clock or epoch a broken device could send breaks the promise or raises."""
    stats = LinkStats()
    axis = Continuity(stats, Notices())
    axis.rate_hz = 1000.0
    record = Record(ramp=False)
    record.infos.append(None)  # type: ignore[arg-type]
    for k, (position, lost, epoch, time_us) in enumerate(frames):
        one = SampleFrames(
            position=np.array([position]), modulus=NO_MODULUS, lost=np.array([lost], np.uint8),
            epoch=np.array([epoch], np.uint8),
            time_us=np.array([time_us]), time_modulus=NO_MODULUS, counts=np.zeros((1, rows, 1), np.int32),
        )  # fmt: skip
        for reading in axis.feed(one, k * 1_000_000):
            assert isinstance(reading, Block | Gap)
            assert reading.index == record.next_index
            record.next_index += len(reading.counts) if isinstance(reading, Block) else reading.count
    assert record.next_index == axis.index


@given(st.lists(st.tuples(st.integers(0x2FE, 0x308), st.binary(max_size=64)), max_size=40))
def test_any_can_frames_never_raise(frames: list[tuple[int, bytes]]) -> None:
    device = device_of("fd16")
    decoder = CanDecoder(LinkStats())
    good = [(f.identifier, f.data, 0) for f in device.next(3)]
    out = decoder.feed(CanFrames.build([*good, *((i, d, 0) for i, d in frames), *good]), 1_000_000)
    assert any(isinstance(reading, Block) for reading in out)


@given(st.binary(max_size=4000))
def test_any_serial_bytes_never_raise(garbage: bytes) -> None:
    decoder = SerialDecoder(LinkStats())
    device = device_of("serial16")
    good = b"".join(cobs.encode(f.data) for f in device.next(3))
    out = decoder.feed(good + garbage + b"\0" + cobs.encode(device.next(1)[0].data), 1_000_000)
    assert sum(len(reading.counts) for reading in out if isinstance(reading, Block)) == 64


@given(st.binary(min_size=2, max_size=200))
def test_valid_check_sum_with_senseless_content_never_raises(body: bytes) -> None:
    decoder = SerialDecoder(LinkStats())
    good = b"".join(cobs.encode(f.data) for f in device_of("serial16").next(3))
    decoder.feed(good + cobs.encode(body) + cobs.encode(b"\1\1" + body) + cobs.encode(b"\1\3" + body), 0)
