"""The terminal view of a run of several devices: a row for each, redrawn twice a second."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from daq.report.live_state import LiveState
from daq.report.live_table import NAMING_CODES, missing_text
from drivers.contract import Notice

COLUMN_TITLES = ("device", "seconds", "samples/s", "gaps", "lost", "CRC errors", "lag", "estimate")
_DOWN_WORDS = {"link_missing": "waits for its link", "link_lost": "its link is lost", "device_failed": "failed"}


class DeviceRow(LiveState):
    """A sink: the numbers of one device, in cells."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self._name = name
        self._down = self._named = ""
        self._ended = False

    def close(self) -> None:
        self._ended = True

    def notice(self, notice: Notice) -> None:
        """Show a notice to the operator, also of a link that was never open."""
        if notice.code in NAMING_CODES:
            self._named = notice.text
        elif notice.code in _DOWN_WORDS:
            self._down = _DOWN_WORDS[notice.code]
        elif notice.code == "link_back":
            self._down = ""

    def cells(self) -> list[Text]:
        """As COLUMNS."""
        status = self.last_status
        seconds = "-" if self.rate_hz is None else f"{self.samples / self.rate_hz:.1f}"
        numbers = [self._name, seconds, "-", str(self.gaps), str(self.lost), "-", "-"]
        if status is not None:
            stage, lag_s = max(status.lag_s.items(), key=lambda item: item[1], default=("", 0.0))
            rate = "0" if self._down else f"{status.rate_hz:.0f}"
            numbers[2], numbers[5], numbers[6] = rate, str(status.link.crc_errors), f"{1e3 * lag_s:.0f} ms {stage}"
        return [*map(Text, numbers), self._state()]

    def _state(self) -> Text:
        if self._down:
            return Text(self._down, style="bold red")
        if self._ended:
            return Text("ended")
        if self._named:
            return Text(self._named, style="bold")
        if self.last_estimate is None:
            return Text("waits for samples" if not self.samples else "none yet")
        return Text(missing_text(self.last_estimate.extra or {}) or self.last_estimate.status)


class DevicesTable:
    """The rows of all devices; a context manager that draws them, in a thread of rich's."""

    def __init__(self, console: Console, names: Sequence[str]) -> None:
        self.rows = {name: DeviceRow(name) for name in names}
        self._live = Live(console=console, refresh_per_second=2, transient=True, get_renderable=self.draw)

    def __enter__(self) -> DevicesTable:
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def draw(self) -> Table:
        table = Table(box=None, header_style="bold", pad_edge=False)
        for k, title in enumerate(COLUMN_TITLES):
            last = k == len(COLUMN_TITLES) - 1
            table.add_column(title, justify="right" if 0 < k < 6 else "left", no_wrap=not last, overflow="fold")
        for row in self.rows.values():
            table.add_row(*row.cells())
        return table
