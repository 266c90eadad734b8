"""Metrics over a real loopback socket, read with the Prometheus text parser."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
import urllib.request
from collections.abc import Callable

import numpy as np
import psutil
import pytest
from prometheus_client.parser import text_string_to_metric_families
from promises import PATIENCE_S, within

from daq.base.contract.errors import ConfigError
from daq.base.contract.sink import ClockState, Session, Status
from daq.report.metrics import MetricsServer, MetricsSink
from daq.report.metrics_http import MAX_CONNECTIONS
from drivers.contract.reading import Block, Gap, Info, LinkStats, Notice, Signal
from estimator.model.rig import Channel, Model
from estimator.results import Estimate, Parameter


def session(device: str = "") -> Session:
    info = Info((Signal("b1x", "m/s^2", 0.01),), 25600.0, "SN7")
    return Session(
        model=Model((Channel("b1x", "bearing1", "x"),), (150.0, 8000.0)),
        info=info,
        device=device,
        attachments={},
        metadata={},
    )


def read(server: MetricsServer) -> dict[tuple[str, ...], float]:
    text = urllib.request.urlopen(server.url, timeout=PATIENCE_S).read().decode()
    found = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            device = sample.labels.pop("device")
            labels = [sample.labels[name] for name in sorted(sample.labels)]
            found[(sample.name.removeprefix("rotorscope_"), device, *labels)] = sample.value
    return found


def fill(sink: MetricsSink) -> None:
    sink.readings([Block(0, np.zeros((256, 1), np.int32), 1), Gap(256, 7, "crc"), Gap(300, 3, "crc")])
    sink.readings([Notice(1, "warning", "crc", "bad frame"), Block(303, np.zeros((10, 1), np.int32), 2)])
    known = {
        "bearing1.x.kL": Parameter(1e7, 1e5, "N/m"),
        "bearing1.x.c": Parameter(value=None, sd=None, unit="N s/m", identifiable=False, reason="no"),
    }
    sink.estimate(Estimate(300, known, 10.0, extra={"missing_force_percent": 4.0, "missing_force_percent_low": 3.0}))
    link = LinkStats(frames=12, crc_errors=2, other={"bus_off": 1})
    sink.status(
        Status(
            t_host_ns=1,
            index=300,
            rate_hz=25599.0,
            link=link,
            clock=ClockState(0, 25599.0, -39.0, 20_000),
            lag_s={"log": 0.2},
            dropped={"rerun": 5},
        )
    )


def test_every_number_is_served() -> None:
    server = MetricsServer(0)
    sink = server.sink()
    sink.start(session())
    fill(sink)
    got = read(server)
    sink.close()
    for key, value in {
        ("samples_total", "SN7"): 266,
        ("lost_samples_total", "SN7", "crc"): 10,
        ("gaps_total", "SN7", "crc"): 2,
        ("notices_total", "SN7", "crc", "warning"): 1,
        ("link_total", "SN7", "frames"): 12,
        ("link_total", "SN7", "crc_errors"): 2,
        ("link_total", "SN7", "bus_off"): 1,
        ("rate_hz", "SN7"): 25599,
        ("lag_seconds", "SN7", "log"): 0.2,
        ("dropped_total", "SN7", "rerun"): 5,
        ("clock_drift_ppm", "SN7"): -39,
        ("estimate", "SN7", "bearing1.x.kL", "N/m"): 1e7,
        ("estimate_sd", "SN7", "bearing1.x.kL", "N/m"): 1e5,
        ("missing_force_percent", "SN7", "value"): 4,
        ("missing_force_percent", "SN7", "low"): 3,
    }.items():
        assert got[key] == value, key
    assert got[("clock_bound_seconds", "SN7")] == pytest.approx(2e-5)
    assert not any("bearing1.x.c" in key for key in got), "what the data cannot tell is absent, not zero"


def test_the_warm_up_is_shown_until_it_is_over() -> None:
    server = MetricsServer(0)
    sink = server.sink()
    sink.start(session())
    sink.estimate(Estimate(256, {}, 0.0, status="warming up", extra={"warm_up_s": 1.0, "warm_up_needed_s": 4.0}))
    now = read(server)
    assert (now["warm_up_seconds", "SN7", "seen"], now["warm_up_seconds", "SN7", "needed"]) == (1.0, 4.0)
    sink.estimate(Estimate(1024, {}, 0.0))
    assert not any(key[0] == "warm_up_seconds" for key in read(server))
    sink.close()


def test_a_parameter_that_is_lost_disappears() -> None:
    server = MetricsServer(0)
    sink = server.sink()
    sink.start(session())
    fill(sink)
    sink.estimate(
        Estimate(
            900,
            {"bearing1.x.kL": Parameter(value=None, sd=None, unit="N/m", identifiable=False, reason="no data")},
            1.0,
        )
    )
    assert not any(key[0] == "estimate" for key in read(server))
    sink.close()


def test_listens_on_loopback_only_and_ends_with_the_last_device() -> None:
    server = MetricsServer(0)
    port = int(server.url.split(":")[2].split("/")[0])
    mine = [c.laddr.ip for c in psutil.Process().net_connections() if c.status == "LISTEN" and c.laddr.port == port]
    assert mine == ["127.0.0.1"]
    first, second = server.sink(), server.sink()
    first.start(session("press"))
    second.start(session("fan"))
    fill(first)
    fill(second)
    first.close()
    assert {key[1] for key in read(server)} == {"press", "fan"}
    second.close()
    second.close()
    with pytest.raises(OSError, match="refused"):
        read(server)


def test_neither_the_server_nor_a_client_that_says_nothing_holds_the_stop() -> None:
    """Half of the quarter second that the server alone would take on average."""
    took = []
    for _ in range(5):
        server = MetricsServer(0)
        port = int(server.url.split(":")[2].split("/")[0])
        with socket.create_connection(("127.0.0.1", port)) as client:
            client.sendall(b"GET /metr")
            sink = server.sink()
            sink.start(session())
            begin = time.monotonic()
            sink.close()
            took.append(time.monotonic() - begin)
    within(float(np.mean(took)), 0.12)


@pytest.mark.slow
def test_many_clients_that_say_nothing_take_few_files_and_hold_nobody(
    capfd: pytest.CaptureFixture[str], record_property: Callable[[str, object], None]
) -> None:
    """A service that a thousand of them left without an open file could not complete its log."""
    server = MetricsServer(0)
    address = "127.0.0.1", int(server.url.split(":")[2].split("/")[0])
    sink = server.sink()
    sink.start(session())
    fill(sink)
    before = threading.active_count()
    clients = []
    for _ in range(200):
        clients.append(socket.create_connection(address, PATIENCE_S))
        clients[-1].sendall(b"GET /metr")
    assert threading.active_count() - before <= MAX_CONNECTIONS
    assert read(server)[("samples_total", "SN7")] == 266
    for hostile in (b"\0" * 100_000, b"GET " + b"/" * 70_000, b"GET /metrics HTTP/9\r\n\r\n", b"A\r\nB: c\r\n" * 500):
        with socket.create_connection(address, PATIENCE_S) as client, contextlib.suppress(ConnectionError):
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # its end is a reset
            client.sendall(hostile)
    assert read(server)[("samples_total", "SN7")] == 266
    begin = time.monotonic()
    sink.close()
    took = time.monotonic() - begin
    ended = sum(client.recv(1) == b"" for client in clients[:150])
    for client in clients:
        client.close()
    row = "metrics: clients that say nothing | 200 at once, and hostile requests | at most 16 files, a scrape goes on"
    record_property("reliability", f"{row} | held; {ended} of the first 150 ended, closed in {took:.2f} s")
    assert ended == 150
    assert capfd.readouterr().err == ""
    within(took, 0.5)


def test_port_in_use_is_one_line() -> None:
    server = MetricsServer(0)
    port = int(server.url.split(":")[2].split("/")[0])
    with pytest.raises(ConfigError, match="choose another port"):
        MetricsServer(port)
    sink = server.sink()
    sink.start(session())
    sink.close()
