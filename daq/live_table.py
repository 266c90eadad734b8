"""What a run shows on a terminal while it goes on: one line of status and the estimates, redrawn twice a second."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from drivers.reading import Block, Gap, Notice, Reading
from estimator.estimate import MISSING, Estimate, certain

from .sink import Session, Status
from .tables import parameters_table

NAMED = ("missing_force", "effect_named", "effect_unknown", "model_complete")  # notices of naming.py


def missing_text(extra: Mapping[str, float]) -> str:
    """The rolling missing force in a line: how much, and what it is most like; "" before there is one."""
    total = extra.get(MISSING)
    if total is None:
        return ""
    like = ", ".join(f"{name} {extra[f'{MISSING}_{name}']:.2f} %" for name in certain(extra))
    return f"missing force {total:.2f} % of the bearing force" + (f"   most like {like}" if like else "")


class LiveTable:
    """A sink. Draws at most twice a second, in a thread of rich's."""

    def __init__(self, console: Console) -> None:
        self._estimate: Estimate | None = None
        self._status: Status | None = None
        self._named = ""
        self._samples = self._lost = 0
        self._rate_hz = 1.0
        self._started = False
        # last: it draws at once
        self._live = Live(console=console, refresh_per_second=2, transient=True, get_renderable=self._draw)

    def start(self, session: Session) -> None:
        self._rate_hz = session.info.rate_hz
        self._live.start()
        self._started = True

    def readings(self, batch: Sequence[Reading]) -> None:
        for reading in batch:
            if isinstance(reading, Notice) and reading.code in NAMED:
                self._named = reading.text
            if isinstance(reading, Block):
                self._samples += len(reading.counts)
            elif isinstance(reading, Gap):
                self._lost += reading.count

    def estimate(self, estimate: Estimate) -> None:
        self._estimate = estimate

    def status(self, status: Status) -> None:
        self._status = status

    def close(self) -> None:
        if self._started:
            self._live.stop()

    def _draw(self) -> Group:
        text = f"{self._samples / self._rate_hz:8.1f} s   lost {self._lost}"
        if self._status is not None:
            text += f"   {self._status.rate_hz:.0f} samples/s"
        parts: list[object] = [Text(text)]
        if self._estimate is not None:
            shown = self._estimate.parameters
            if text := missing_text(self._estimate.extra or {}):
                parts.append(Text(text))
            if self._named:
                parts.append(Text(self._named, style="bold"))
            parts.append(parameters_table(shown) if shown else Text(self._estimate.status))
        return Group(*parts)  # type: ignore[arg-type]
