"""The terminal view of a run: one line of status and the estimates, redrawn twice a second."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from daq.base.console.tables import parameters_table
from daq.base.contract.sink import Session
from drivers.contract import Notice, Reading
from estimator.results import BACKGROUND_KEY, MISSING_FORCE_KEY, SPIKES_KEY, certain_missing_effects

from .live_state import LiveState

NAMING_CODES = ("missing_force", "effect_named", "effect_unknown", "model_complete")  # notices of naming.py


def missing_text(extra: Mapping[str, float]) -> str:
    """The rolling missing force in a line: its size and the most similar effect; "" before there is one."""
    total = extra.get(MISSING_FORCE_KEY)
    if total is None:
        return ""
    like = ", ".join(f"{name} {extra[f'{MISSING_FORCE_KEY}_{name}']:.2f} %" for name in certain_missing_effects(extra))
    return f"missing force {total:.2f} % of the bearing force" + (f"   most like {like}" if like else "")


def spikes_text(extra: Mapping[str, float]) -> str:
    """The number of samples that the rolling estimate leaves out as spikes, in a line; "" without one."""
    count = extra.get(SPIKES_KEY, 0.0)
    return f"{count:.0f} spikes left out of the estimate: check the link and the cables" if count else ""


def background_text(extra: Mapping[str, float]) -> str:
    """That the rolling estimate has structural modes and the spectrum of the force, in a line; "" before it has."""
    at = extra.get(BACKGROUND_KEY)
    return "" if at is None else f"structural modes and the spectrum of the force are those found at {at:.0f} s"


class LiveTable(LiveState):
    """A sink. Draws at most twice a second, in a thread of rich's."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._named = ""
        self._started = False
        # last: it draws at once
        self._live = Live(console=console, refresh_per_second=2, transient=True, get_renderable=self._draw)

    def start(self, session: Session) -> None:
        super().start(session)
        self._live.start()
        self._started = True

    def readings(self, batch: Sequence[Reading]) -> None:
        super().readings(batch)
        for reading in batch:
            if isinstance(reading, Notice) and reading.code in NAMING_CODES:
                self._named = reading.text

    def close(self) -> None:
        if self._started:
            self._live.stop()

    def _draw(self) -> Group:
        text = f"{self.samples / (self.rate_hz or 1.0):8.1f} s   lost {self.lost}"
        if self.last_status is not None:
            text += f"   {self.last_status.rate_hz:.0f} samples/s"
        parts: list[object] = [Text(text)]
        if self.last_estimate is not None:
            shown = self.last_estimate.parameters
            extra = self.last_estimate.extra or {}
            for text in (missing_text(extra), spikes_text(extra), background_text(extra)):
                if text:
                    parts.append(Text(text))
            if self._named:
                parts.append(Text(self._named, style="bold"))
            parts.append(parameters_table(shown) if shown else Text(self.last_estimate.status))
        return Group(*parts)  # type: ignore[arg-type]
