"""`run` for years: segments, what is kept of them, the trend beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from daq.base.console.extras import check_installed
from daq.base.contract.dates import Recorded
from daq.base.contract.errors import ConfigError
from daq.base.contract.sink import Sink
from daq.rig.rig import Rig
from daq.session.estimation import block_rows
from daq.session.layer_watch import Heard
from daq.trend.names import TREND_FOLDER
from daq.trend.segments import SegmentedLog
from daq.trend.sizes import Cut, Keep, asked_cut, asked_keep
from daq.trend.store import TrendStore


@dataclass(frozen=True, slots=True, kw_only=True)
class Watching:
    """What a run for years was asked for. cut : None for one log."""

    cut: Cut | None = None
    keep: Keep = field(default_factory=Keep)

    @classmethod
    def asked(
        cls, out: Path | None, segment: str | None, keep: Sequence[str] = (), keep_free: str | None = None,
        every: str | None = None, length: str | None = None, remove_alarms: bool = False,
    ) -> Watching:  # fmt: skip
        """By the options of the command. Raises ConfigError for what makes no sense."""
        cut = asked_cut(segment, every, length)
        if cut is None:
            if keep or keep_free is not None or remove_alarms:
                raise ConfigError("--keep is for segments: add --segment, such as --segment 10min")
            return cls()
        if out is None:
            raise ConfigError("--segment and --every need --out DIR, the folder of the segments")
        if out.suffix == ".mcap" or out.is_file():
            raise ConfigError(f"--out {out}: segments go into a folder; give --out DIR")
        check_installed(("pyarrow",), "formats", "--segment")
        return cls(cut=cut, keep=asked_keep(list(keep), keep_free, remove_alarms))


def watching_sinks(
    watching: Watching, rig: Rig, folder: Path, name: str, *, live: bool, recorded: Recorded | None = None
) -> tuple[list[Sink], list[Heard]]:
    """The sinks of segments and trend, and who is to be given the layers. name : of the segments."""
    if watching.cut is None:
        return [], []
    log = SegmentedLog(
        folder, name, watching.cut, watching.keep, block_rows=block_rows, live=live, recorded=recorded
    )  # fmt: skip
    offset_ns = None if recorded is None else recorded.wall_offset_ns
    store = TrendStore(folder / TREND_FOLDER, live=live, wall_offset_ns=offset_ns)
    return [log, store], [store.layers]
