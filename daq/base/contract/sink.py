"""Where a session goes: the log, the viewer, the metrics (the sink seam)."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Protocol, runtime_checkable

from drivers.contract import Info, LinkStats, Notice, Reading
from estimator.model import Model
from estimator.results import Estimate


@dataclass(frozen=True, slots=True)
class Session:
    """Facts of a session that a sink gets before the first sample.

    model : of the rig, SI.
    info : first description of the device.
    device : name of the device in a service with several; "" if alone.
    attachments : file name -> bytes (rig file, DBC).
    metadata : versions, link, command.
    """

    model: Model
    info: Info
    device: str
    attachments: Mapping[str, bytes]
    _: KW_ONLY
    metadata: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class ClockState:
    """Host time of device index i is offset_ns + i / rate_hz; true within +- bound_ns."""

    offset_ns: int
    rate_hz: float  # the device's true rate on the host clock
    drift_ppm: float
    bound_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """The state of a session, once a second.

    t_host_ns : host monotonic time, ns.
    index : absolute sample index that follows the last sample.
    rate_hz : samples that came in the last second, on the host clock.
    link : counters of the link.
    clock : mapping of device to host clock; None in the first seconds.
    lag_s : stage name -> seconds behind.
    dropped : queue name -> items dropped so far.
    """

    t_host_ns: int
    index: int
    rate_hz: float
    link: LinkStats
    clock: ClockState | None
    lag_s: Mapping[str, float] = field(default_factory=dict)
    dropped: Mapping[str, int] = field(default_factory=dict)


class Sink(Protocol):
    """Called from the core loop only, in the order of the data. An OSError is reported by the loop and survived."""

    def start(self, session: Session) -> None: ...
    def readings(self, batch: Sequence[Reading]) -> None: ...
    def estimate(self, estimate: Estimate) -> None: ...
    def status(self, status: Status) -> None: ...
    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class SinkHealth:
    """State of a sink with a separate thread. dropped : samples not taken so far; notices : new ones; pending : an
    answer of the sink is under way, for which the end of a session waits."""

    lag_s: float
    dropped: int
    notices: tuple[Notice, ...] = ()
    pending: bool = False

    @classmethod
    def of_notices(cls, waiting: deque[Notice], pending: bool = False) -> SinkHealth:
        """The health of a sink that holds no samples back. waiting : its notices, taken out; threads may add more."""
        out = []
        while waiting:
            out.append(waiting.popleft())
        return cls(0.0, 0, tuple(out), pending)


@runtime_checkable
class Reporting(Protocol):
    """Further methods of a sink with a separate thread; called often from the core loop."""

    def health(self) -> SinkHealth: ...
