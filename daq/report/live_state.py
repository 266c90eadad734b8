"""State of a run for the terminal: amount of data, last status and estimate. A sink that draws nothing."""

from __future__ import annotations

from collections.abc import Sequence

from daq.base.contract.sink import Session, Status
from drivers.contract import Block, Gap, Reading
from estimator.results import Estimate


class LiveState:
    """rate_hz : None before a session. gaps : those that cost samples; lost : how many."""

    def __init__(self) -> None:
        self.rate_hz: float | None = None
        self.samples = self.gaps = self.lost = 0
        self.last_status: Status | None = None
        self.last_estimate: Estimate | None = None

    def start(self, session: Session) -> None:
        self.rate_hz = session.info.rate_hz

    def readings(self, batch: Sequence[Reading]) -> None:
        for reading in batch:
            if isinstance(reading, Block):
                self.samples += len(reading.counts)
            elif isinstance(reading, Gap) and reading.count:
                self.gaps += 1
                self.lost += reading.count

    def estimate(self, estimate: Estimate) -> None:
        self.last_estimate = estimate

    def status(self, status: Status) -> None:
        self.last_status = status
