"""A device that goes on describing itself while its samples stay away."""

from __future__ import annotations

import pytest
from ramp_device import Record, Served, ramp_device, read_until

from drivers.contract.link import Link
from drivers.links.links import make_driver, parse_link
from drivers.protocol.faults import Fault


@pytest.mark.slow
@pytest.mark.parametrize(("link", "layout"), [("serial:pty", "serial16"), ("slcan:pty", "fd16")])
def test_info_without_samples_is_reported_and_its_gap_is_silent(link: str, layout: str) -> None:
    device = ramp_device(layout, 2000.0, None)
    rows = device.config.frame_rows
    device = ramp_device(layout, 2000.0, None, faults=(Fault("silent", 5000 // rows, 4500 // rows),))
    make_driver(parse_link(link))  # compiles, before the device begins
    with Served(link, device, speed=1.0) as served:
        driver = served.driver()
        assert isinstance(driver, Link)
        driver.mute_s = 0.5
        record = read_until(driver, Record(), lambda r: bool(r.gaps) and r.samples > 1000)
        driver.close()
    assert "no_samples" in record.codes()
    assert [(gap.count, gap.reason) for gap in record.gaps] == [(4500 // rows * rows, "silent")]
