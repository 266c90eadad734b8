"""Severity against tones whose velocity is known, and against an integration in the time domain."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest

from estimator.arrays import Array
from estimator.errors import ModelError
from estimator.identification.record import ChannelSeverity, iso_zone, severity, zone_limits
from estimator.model import AntiAlias, MachineClass, Model
from estimator.model.rig import Channel

RATE_HZ = 6400.0
SMALL_RIGID = MachineClass(group=2, support="rigid")
KINDS = {"acceleration": 1, "velocity": 0}  # integrations to velocity


def one(y: Array, rate_hz: float = RATE_HZ, kind: str = "acceleration", **more: object) -> ChannelSeverity:
    model = Model((Channel("a", "bearing1", "x", kind),), band=(20.0, 0.4 * rate_hz), **more)  # type: ignore[arg-type]
    return severity(model, y[:, None], rate_hz)["a"]


def tones(*parts: tuple[float, float], kind: str = "acceleration", seconds: float = 10.0) -> Array:
    """Tones given by frequency in Hz and velocity in mm/s rms, over noise that no one sees."""
    t = np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    y = 1e-5 * np.random.default_rng(0).standard_normal(t.size)
    for f, mm_s in parts:
        y += np.sqrt(2.0) * 1e-3 * mm_s * (2 * np.pi * f) ** KINDS[kind] * np.sin(2 * np.pi * f * t + f)
    return y


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("f_hz", [11.3, 29.97, 160.0, 744.4, 985.0])
def test_velocity_of_a_tone(f_hz: float, kind: str) -> None:
    found = one(tones((f_hz, 3.0), kind=kind), kind=kind)
    assert found.velocity_rms_mm_s == pytest.approx(3.0, rel=5e-3)
    assert found.displacement_rms_um == pytest.approx(3e3 / (2 * np.pi * f_hz), rel=0.02)


def test_tones_outside_of_the_band_do_not_count() -> None:
    assert one(tones((3.0, 3.0), (40.0, 1.0), (1999.3, 3.0))).velocity_rms_mm_s == pytest.approx(1.0, rel=5e-3)


def test_velocity_of_noise_is_that_of_an_integration_in_time() -> None:
    """Of one whole record: transform, band, integrate, transform back, and take the rms of the samples."""
    y = np.random.default_rng(1).standard_normal(int(60 * RATE_HZ))
    f = np.fft.rfftfreq(y.size, 1.0 / RATE_HZ)
    inside = (f >= 10.0) & (f <= 1000.0)
    spectrum = np.where(inside, np.fft.rfft(y) / np.maximum(2j * np.pi * f, 1e-9j), 0.0)
    direct = 1e3 * np.fft.irfft(spectrum, y.size).std()
    assert one(y).velocity_rms_mm_s == pytest.approx(direct, rel=0.05)


def test_levels_of_bands_add_up_to_the_rms() -> None:
    found = one(np.random.default_rng(2).standard_normal(int(20 * 51200.0)), 51200.0)
    assert [(b.low_hz, b.high_hz) for b in found.bands] == [(10, 100), (100, 1e3), (1e3, 5e3), (5e3, 1e4), (1e4, 2e4)]
    for band in found.bands:
        assert band.rms == pytest.approx(np.sqrt((band.high_hz - band.low_hz) / 25600.0), rel=0.05)
    assert "bands" not in found.void


# ISO 10816-3:2009 table A.1 and A.2, as published by makers of vibration meters: boundaries A/B, B/C, C/D in mm/s rms
@pytest.mark.parametrize(
    ("group", "support", "limits"),
    [
        (1, "rigid", (2.3, 4.5, 7.1)),
        (1, "flexible", (3.5, 7.1, 11.0)),
        (2, "rigid", (1.4, 2.8, 4.5)),
        (2, "flexible", (2.3, 4.5, 7.1)),
    ],
)
def test_zones_change_at_the_published_values(group: int, support: str, limits: tuple[float, ...]) -> None:
    machine = MachineClass(group=group, support=support)  # type: ignore[arg-type]
    for below, above, limit in zip("ABC", "BCD", limits, strict=True):
        assert (iso_zone(machine, 0.999 * limit), iso_zone(machine, 1.001 * limit)) == (below, above)


# Part 7: public summary of DIN ISO 10816-7:2009, for pumps to 200 kW and above; part 1: the manual of a vibration meter
# after ISO 2372 (Voltcraft VBM-100, page 15)
@pytest.mark.parametrize(
    ("machine", "limits"),
    [
        (MachineClass(part=7, category=1, power_kw=200.0), (2.5, 4.0, 6.6)),
        (MachineClass(part=7, category=1, power_kw=201.0), (3.5, 5.0, 7.6)),
        (MachineClass(part=7, category=2, power_kw=15.0), (3.2, 5.1, 8.5)),
        (MachineClass(part=7, category=2, power_kw=900.0), (4.2, 6.1, 9.5)),
        (MachineClass(part=1, size="I"), (0.71, 1.8, 4.5)),
        (MachineClass(part=1, size="II"), (1.12, 2.8, 7.1)),
        (MachineClass(part=1, size="III"), (1.8, 4.5, 11.2)),
        (MachineClass(part=1, size="IV"), (2.8, 7.1, 18.0)),
    ],
)
def test_zones_of_pumps_and_of_the_old_classes(machine: MachineClass, limits: tuple[float, ...]) -> None:
    assert zone_limits(machine).velocity_mm_s == limits
    for below, above, limit in zip("ABC", "BCD", limits, strict=True):
        assert (iso_zone(machine, limit, 1e4), iso_zone(machine, 1.001 * limit, 1e4)) == (below, above)


def test_a_class_without_what_its_part_needs_is_refused() -> None:
    with pytest.raises(ModelError, match="part 7 needs power_kw"):
        MachineClass(part=7, category=1)


def test_the_worse_one_of_velocity_and_displacement_decides() -> None:
    found = one(tones((10.6, 4.0)), iso20816=SMALL_RIGID)  # 60 um
    assert (iso_zone(SMALL_RIGID, 1.0, 50.0), found.zone) == ("C", "C")
    assert one(tones((100.0, 1.0)), iso20816=SMALL_RIGID).zone == "A"


def clipped(share: float) -> Array:
    y = 5.0 * np.random.default_rng(3).standard_normal(int(10 * RATE_HZ))
    top = float(np.quantile(np.abs(y), 1 - share))
    return np.clip(y, -top, top)


NOISE = np.random.default_rng(4).standard_normal(int(10 * RATE_HZ))


@pytest.mark.parametrize(
    ("found", "void", "words"),
    [
        (lambda: one(NOISE, 2000.0), "velocity_rms_mm_s", "at 2000 Hz a recorder passes up to about 781 Hz"),
        (lambda: one(NOISE, 2000.0), "zone", "record at a higher rate"),
        (lambda: one(NOISE[:3000]), "velocity_rms_mm_s", "0.469 s: 10 Hz needs 1 s"),
        (lambda: one(NOISE[:3000]), "bands", "10 Hz needs 1 s"),
        (lambda: one(NOISE), "zone", "add [machine] iso20816"),
        (lambda: one(NOISE, iso20816=SMALL_RIGID, speed_rpm=300.0), "zone", "at 300 rpm"),
        (lambda: one(1e-8 * NOISE, kind="displacement"), "velocity_rms_mm_s", "a displacement channel"),
        (lambda: one(clipped(0.005)), "crest", "clipped"),
        (lambda: one(clipped(0.1)), "velocity_rms_mm_s", "clipped"),
        (lambda: one(np.ones(9000)), "rms", "constant"),
        (
            lambda: one(NOISE, anti_alias=AntiAlias(kind="butterworth", order=4, cutoff_hz=800.0)),
            "velocity_rms_mm_s",
            "filter of the rig file passes up to 7",
        ),
    ],
)
def test_what_a_record_does_not_allow_is_void_with_the_reason(
    found: Callable[[], ChannelSeverity], void: str, words: str
) -> None:
    one_channel = found()
    assert words in one_channel.void[void]
    assert getattr(one_channel, void) is None or any(b.rms is None for b in one_channel.bands) or not one_channel.bands
    json.dumps(one_channel.to_json(), allow_nan=False)


def test_a_known_filter_lets_a_slow_recorder_reach_1000_hz() -> None:
    fir = AntiAlias(kind="fir", order=128, cutoff_hz=1100.0)
    assert one(NOISE, 2400.0).velocity_rms_mm_s is None
    assert one(NOISE, 2400.0, anti_alias=fir).velocity_rms_mm_s is not None


def test_no_record_of_the_rig_has_no_severity() -> None:
    model = Model((Channel("a", "bearing1", "x"),), band=(20.0, 900.0))
    assert severity(model, np.zeros((100, 2)), RATE_HZ) == {}


@pytest.mark.parametrize("rate_hz", [2560.0, 12800.0, 51200.0])
@pytest.mark.parametrize("f_hz", [20.0, 80.0, 160.0, 640.0, 800.0])
def test_a_clean_tone_with_whole_numbers_of_samples_a_period_is_not_clipped(f_hz: float, rate_hz: float) -> None:
    found = one(np.sin(2 * np.pi * f_hz * np.arange(int(5 * rate_hz)) / rate_hz + 0.3), rate_hz)
    assert found.velocity_rms_mm_s == pytest.approx(1e3 / (2 * np.pi * f_hz) / np.sqrt(2.0), rel=2e-3)
    assert found.crest == pytest.approx(np.sqrt(2.0), rel=0.06)
