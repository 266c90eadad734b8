"""A device, an estimator, a clock and a sink that do exactly what a test says."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.sink import Session, Status
from daq.rig.rig import Rig, load_rig
from drivers.contract.reading import Block, Info, LinkStats, Reading
from estimator.model.rig import Model
from estimator.results import Estimate, Parameter

CONFIGS = Path(__file__).parents[1] / "configs"


def paper_rig() -> Rig:
    return load_rig(CONFIGS / "tiwari_vyas_1997.toml")


@dataclass
class FakeClock:
    """Time stands still unless moved."""

    t_ns: int = 5_000_000_000

    def now_ns(self) -> int:
        return self.t_ns

    def wall_offset_ns(self) -> int:
        return 1_700_000_000 * 10**9


class ScriptedDriver:
    """Delivers batches of readings, at once or `pause_s` apart; then it is silent, or exhausted if `ends`."""

    def __init__(
        self, batches: Iterable[list[Reading] | BaseException], kind: str = "scripted",
        pause_s: float = 0.0, ends: bool = True,
    ) -> None:  # fmt: skip
        self.kind = kind
        self.stats = LinkStats()
        self._batches = iter(batches)
        self._pause_s = pause_s
        self._ends = ends
        self._closed = threading.Event()
        self.exhausted = False
        self.opened = 0

    def open(self) -> None:
        self.opened += 1

    def close(self) -> None:
        self._closed.set()

    def read(self, timeout_s: float) -> list[Reading]:
        if self._pause_s:
            self._closed.wait(self._pause_s)
        batch = next(self._batches, None)
        if isinstance(batch, BaseException):
            raise batch
        if batch is None:
            self.exhausted = self._ends
            self._closed.wait(0.0 if self._ends else timeout_s)
            return []
        self.stats.frames += 1
        return batch


class MomentEstimator:
    """Running moments: cheap, deterministic, and sensitive to every bit and to the cutting of the blocks."""

    def __init__(self, model: Model, rate_hz: float) -> None:
        self.blocks: list[tuple[int, bool]] = []
        self._sum = np.zeros(len(model.channels))
        self._fine = 0.0
        self._n = 0

    def update(self, block: NDArray[np.float64]) -> None:
        assert block.shape[1] == len(self._sum)
        self.blocks.append((len(block), bool(np.isnan(block).any())))
        good = block[~np.isnan(block).any(axis=1)]
        self._sum = 0.97 * self._sum + np.sin(good).sum(axis=0)
        self._fine += float(np.sqrt(np.abs(good)).mean()) if len(good) else 0.0
        self._n += len(block)

    def snapshot(self) -> Estimate:
        values = {f"bearing1.x.p{i}": Parameter(float(v), 1.0, "N/m") for i, v in enumerate(self._sum)}
        nan = Parameter(value=float("nan"), sd=self._fine, unit="1", identifiable=False, reason="never")
        return Estimate(
            index=self._n,
            parameters=values | {"bearing1.y.kL": nan},
            samples=float(self._n),
            log_likelihood=None,
            status="ok",
        )


@dataclass
class Recorder:
    """A sink that keeps everything, or raises a given error."""

    calls: list[tuple[str, object]] = field(default_factory=list)
    fail: dict[str, BaseException] = field(default_factory=dict)
    slow_s: float = 0.0

    def _call(self, name: str, value: object) -> None:
        time.sleep(self.slow_s)
        self.calls.append((name, value))
        if name in self.fail:
            raise self.fail[name]

    def start(self, session: Session) -> None:
        self._call("start", session)

    def readings(self, batch: Sequence[Reading]) -> None:
        self._call("readings", list(batch))

    def estimate(self, estimate: Estimate) -> None:
        self._call("estimate", estimate)

    def status(self, status: Status) -> None:
        self._call("status", status)

    def close(self) -> None:
        self._call("close", None)

    def of(self, name: str) -> list[object]:
        return [value for what, value in self.calls if what == name]

    @property
    def delivered(self) -> list[Reading]:
        return [r for batch in self.of("readings") for r in batch]  # type: ignore[attr-defined]


def info_of(rig: Rig, bits: int = 16) -> Info:
    from drivers.contract.reading import Signal

    signals = tuple(Signal(c.name, "m/s^2", 490.5 / 2 ** (bits - 1)) for c in rig.model.channels)
    return Info(signals, 25600.0, "SN 1", bits)


def vibration(index: int, n: int, amplitude: int = 4000) -> Block:
    """Counts of four noisy tones that depend on the absolute index alone."""
    i = np.arange(index, index + n)[:, None]
    tone = np.sin(i * (0.27 + 0.01 * np.arange(4))) + np.sin(i * i * 1e-3 % 7.0)
    counts = np.round(amplitude * tone / 2).astype(np.int32)
    return Block(index, counts, 10**12 + round((index + n) * 1e9 / 25600.0), None)
