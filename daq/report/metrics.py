"""Prometheus metrics on request, on 127.0.0.1: what the status, the gaps and the estimates say, as numbers to watch.

The server's threads only read values that the core loop has put there; nothing is computed per sample.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import fields

from prometheus_client import CollectorRegistry
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from daq.base.contract.errors import ConfigError
from daq.base.contract.sink import Session, Status
from drivers.contract import Block, Gap, LinkStats, Notice, Reading
from estimator.results import WARM_UP_NEEDED_S_KEY, WARM_UP_S_KEY, Estimate

from .metrics_http import serve

METRICS_PORT = 9464
POKE_S = 0.02
LINK_TOTALS = tuple(f.name for f in fields(LinkStats) if f.name not in ("other", "lost_samples"))
# name -> (help, labels after the device)
TOTAL_METRICS: dict[str, tuple[str, tuple[str, ...]]] = {
    "samples": ("Samples received, of each channel.", ()),
    "lost_samples": ("Samples lost, by reason; each has a gap record in the log.", ("reason",)),
    "gaps": ("Gap records, by reason.", ("reason",)),
    "notices": ("Messages to the operator.", ("level", "code")),
    "dropped": ("Items that a full queue gave up.", ("queue",)),
    "link": ("Running totals of the link.", ("what",)),
}
VALUE_METRICS: dict[str, tuple[str, tuple[str, ...]]] = {
    "rate_hz": ("Sample rate on the host clock.", ()),
    "lag_seconds": ("How far a stage is behind the last byte.", ("stage",)),
    "clock_drift_ppm": ("Device clock against host clock.", ()),
    "clock_bound_seconds": ("Bound of the device-to-host time error.", ()),
    "last_index": ("Device sample index of the last status.", ()),
    "estimate": ("Rolling estimate; absent where the data cannot tell.", ("parameter", "unit")),
    "estimate_sd": ("Its standard deviation.", ("parameter", "unit")),
    "alarm": ("1 while an alarm of the rig file is raised, else 0.", ("what",)),
    "alarm_learning": ("1 while what is usual is learned, else 0.", ("what",)),
    "missing_force_percent": ("Still predictable part of the bearing force.", ("which",)),
    "warm_up_seconds": ("Data before the first rolling estimate; absent afterwards.", ("which",)),
}


class MetricsServer(Collector):
    """Serves http://HOST:PORT/metrics for one or several devices until the last of its sinks is closed.

    port 0 picks a free one; `url` says where it listens. Raises ConfigError if the port cannot be had.
    """

    def __init__(self, port: int = METRICS_PORT, host: str = "127.0.0.1") -> None:
        registry = CollectorRegistry()
        try:
            self._server, self._thread = serve(registry, port, host)
        except (OSError, OverflowError) as problem:
            text = str(getattr(problem, "strerror", None) or problem).rstrip(".")
            raise ConfigError(f"metrics on {host}:{port}: {text}; choose another port") from problem
        self._host = host
        self.url = f"http://{host}:{self._server.server_port}/metrics"
        self._sinks: list[MetricsSink] = []
        registry.register(self)

    def sink(self) -> MetricsSink:
        """The sink of one device."""
        sink = MetricsSink(self)
        self._sinks.append(sink)
        return sink

    def collect(self) -> Iterator[Metric]:
        for kind, described in ((CounterMetricFamily, TOTAL_METRICS), (GaugeMetricFamily, VALUE_METRICS)):
            for name, (text, labels) in described.items():
                family = kind(f"rotorscope_{name}", text, labels=("device", *labels))
                for sink in list(self._sinks):
                    for key, value in list(sink.numbers.items()):
                        if key[0] == name:
                            family.add_metric([sink.device, *key[1:]], value)
                yield family

    def closed(self, sink: MetricsSink) -> None:
        if sink in self._sinks and all(s.ended for s in self._sinks):
            self._sinks.clear()
            self._shut_down()
            self._server.server_close()
            self._thread.join()

    def _shut_down(self) -> None:
        """End the server. It checks for its end twice a second, and at each connection."""
        waiting = threading.Thread(target=self._server.shutdown, daemon=True)
        waiting.start()
        while waiting.is_alive():
            with contextlib.suppress(OSError):
                socket.create_connection((self._host, self._server.server_port), POKE_S).close()
            waiting.join(POKE_S)


class MetricsSink:
    """Keeps the latest numbers. numbers : (metric, label, ...) -> value, replaced whole values only."""

    def __init__(self, server: MetricsServer) -> None:
        self._server = server
        self.device = ""
        self.ended = False
        self.numbers: dict[tuple[str, ...], float] = {}
        self._counts: Counter[tuple[str, ...]] = Counter()

    def start(self, session: Session) -> None:
        self.device = session.device or session.info.serial_number
        self.numbers[("samples",)] = 0

    def readings(self, batch: Sequence[Reading]) -> None:
        seen = self._counts
        for reading in batch:
            if isinstance(reading, Block):
                seen[("samples",)] += len(reading.counts)
            elif isinstance(reading, Gap):
                seen[("gaps", reading.reason)] += 1
                seen[("lost_samples", reading.reason)] += reading.count
            elif isinstance(reading, Notice):
                seen[("notices", reading.level, reading.code)] += 1
        self.numbers.update(seen)

    def estimate(self, estimate: Estimate) -> None:
        for name, p in estimate.parameters.items():
            for metric, value in (("estimate", p.value), ("estimate_sd", p.sd)):
                key = (metric, name, p.unit)
                if value is None:
                    self.numbers.pop(key, None)
                else:
                    self.numbers[key] = value
        extra = estimate.extra or {}
        for which, name in (("seen", WARM_UP_S_KEY), ("needed", WARM_UP_NEEDED_S_KEY)):
            if name in extra:
                self.numbers["warm_up_seconds", which] = extra[name]
            else:
                self.numbers.pop(("warm_up_seconds", which), None)
        for name, value in extra.items():
            if name.startswith("missing_force"):
                which = name.removeprefix("missing_force_percent").strip("_") or "value"
                self.numbers[("missing_force_percent", which)] = value

    def status(self, status: Status) -> None:
        now: dict[tuple[str, ...], float] = {("rate_hz",): status.rate_hz, ("last_index",): status.index}
        now |= {("link", name): getattr(status.link, name) for name in LINK_TOTALS}
        now |= {("link", name): count for name, count in status.link.other.items()}
        now |= {("lag_seconds", stage): lag for stage, lag in status.lag_s.items()}
        now |= {("dropped", queue): count for queue, count in status.dropped.items()}
        if status.clock is not None:
            now[("clock_drift_ppm",)] = status.clock.drift_ppm
            now[("clock_bound_seconds",)] = status.clock.bound_ns * 1e-9
        self.numbers.update(now)

    def alarm(self, what: str, state: str) -> None:
        """The state of an alarm: "ok", "alarm" or "learning"."""
        self.numbers[("alarm", what)] = float(state == "alarm")
        self.numbers[("alarm_learning", what)] = float(state == "learning")

    def close(self) -> None:
        """Stop serving, once the other devices have ended too."""
        self.ended = True
        self._server.closed(self)
