"""Device to readings over every kind of live link, for real: virtual bus, pty, TCP."""

from __future__ import annotations

import pytest
from promises import within
from ramp_device import Record, Served, ramp_device, read_all, read_until

from drivers.contract.link_config import VirtualConfig
from drivers.links.links import make_driver


@pytest.mark.parametrize(("layout", "rate_hz"), [("fd16", 25_600.0), ("fd24", 25_600.0), ("classic", 8_000.0)])
def test_virtual(layout: str, rate_hz: float) -> None:
    device = ramp_device(layout, rate_hz)
    driver = make_driver(VirtualConfig(speed=None), device=device)
    driver.open()
    record = read_all(driver)
    driver.close()
    assert record.infos[0].rate_hz == rate_hz
    assert [signal.name for signal in record.infos[0].signals] == ["b1x", "b1y", "b2x", "b2y"]
    assert not record.gaps
    assert record.offset == 0
    window = round(rate_hz / 10) if layout == "classic" else 0  # the last window has no sync frame behind it
    assert record.samples == device.samples_made - window


@pytest.mark.parametrize(
    ("link", "layout", "rate_hz"),
    [
        ("serial:pty", "serial16", 25_600.0),
        ("serial:socket://127.0.0.1:0", "serial24", 25_600.0),
        ("slcan:pty", "fd16", 25_600.0),
        ("slcan:pty", "fd24", 25_600.0),
        ("slcan:socket://127.0.0.1:0", "classic", 8_000.0),
    ],
)
def test_served(link: str, layout: str, rate_hz: float) -> None:
    device = ramp_device(layout, rate_hz)
    with Served(link, device) as served:
        driver = served.driver()
        whole = round(rate_hz * (0.9 if layout == "classic" else 1.0))
        record = read_until(driver, Record(), lambda r: r.samples >= whole)
        driver.close()
    assert not record.gaps
    assert record.offset == 0


def test_real_time_device_keeps_its_own_pace() -> None:
    device = ramp_device("serial16", seconds=None)
    with Served("serial:pty", device, speed=1.0) as served:
        driver = served.driver()
        record = read_until(driver, Record(), lambda r: r.samples >= 12_800)
        driver.close()
    first, last = record.blocks[0], record.blocks[-1]
    assert first.t_device_ns is not None
    assert last.t_device_ns is not None
    device_s = (last.t_device_ns - first.t_device_ns) / 1e9
    assert device_s == pytest.approx((last.index - first.index) / 25_600, abs=2e-6)
    within(abs((last.t_host_ns - first.t_host_ns) / 1e9 - device_s), 0.1)
