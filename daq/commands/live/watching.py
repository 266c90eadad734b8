"""`run` for years: segments, their retention, and the trend."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daq.base.console.extras import check_installed
from daq.base.console.output import Output
from daq.base.contract.dates import Recorded
from daq.base.contract.errors import ConfigError
from daq.base.contract.sink import Sink
from daq.rig.rig import Rig
from daq.session.estimation import block_rows
from daq.session.layer_watch import LayersListener
from daq.trend.alarms.watch import AlarmWatch, Listener
from daq.trend.names import ALARM_MEMORY, TREND_FOLDER
from daq.trend.segments import SegmentedLog
from daq.trend.sizes import Cut, Keep, asked_cut, asked_keep
from daq.trend.store import TrendStore

if TYPE_CHECKING:
    from daq.report.metrics import MetricsSink
    from daq.trend.alarms.mqtt import MqttAlarms


@dataclass(frozen=True, slots=True, kw_only=True)
class Watching:
    """Request of a run for years. cut : None for one log."""

    cut: Cut | None = None
    keep: Keep = field(default_factory=Keep)
    mqtt: str | None = None

    @classmethod
    def asked(
        cls, out: Path | None, segment: str | None, keep: Sequence[str] = (), keep_free: str | None = None,
        every: str | None = None, length: str | None = None, remove_alarms: bool = False, mqtt: str | None = None,
    ) -> Watching:  # fmt: skip
        """The settings from the options of the command. Raises ConfigError for a contradiction."""
        cut = asked_cut(segment, every, length)
        if cut is None:
            if keep or keep_free is not None or remove_alarms:
                raise ConfigError("--keep is for segments: add --segment, such as --segment 10min")
            return cls(mqtt=mqtt)
        if out is None:
            raise ConfigError("--segment and --every need --out DIR, the folder of the segments")
        if out.suffix == ".mcap" or out.is_file():
            raise ConfigError(f"--out {out}: segments go into a folder; give --out DIR")
        check_installed(("pyarrow",), "formats", "--segment")
        return cls(cut=cut, keep=asked_keep(list(keep), keep_free, remove_alarms), mqtt=mqtt)

    def publisher(self, output: Output, rigs: Sequence[Rig], leaving: ExitStack) -> MqttAlarms | None:
        """The connection to the broker that was asked for, closed by `leaving`. Raises ConfigError."""
        if self.mqtt is None:
            return None
        if not any(rig.alarms for rig in rigs):
            raise ConfigError("--mqtt publishes alarms, and the rig file has none: add an [[alarm]]")
        from daq.trend.alarms.mqtt import MqttAlarms

        publisher = MqttAlarms(self.mqtt, output.note)
        leaving.callback(publisher.close)
        return publisher


@dataclass(frozen=True, slots=True, kw_only=True)
class Watched:
    """Watchers of a session of one device. sinks : further sinks; layer_listeners : called with the layers."""

    sinks: list[Sink]
    layer_listeners: list[LayersListener]
    alarms: AlarmWatch | None = None

    def to_json(self) -> dict[str, Any]:
        """The key `alarms` of the result; nothing without any."""
        return {} if self.alarms is None else {"alarms": [s.to_json() for s in self.alarms.states.values()]}

    def raised(self) -> list[str]:
        """Texts of the alarms that started."""
        return [] if self.alarms is None else [state.text for state in self.alarms.raised]


def watched(
    watching: Watching, rig: Rig, folder: Path | None, name: str, *, live: bool, recorded: Recorded | None = None,
    publisher: MqttAlarms | None = None, metrics: MetricsSink | None = None,
) -> Watched:  # fmt: skip
    """Segments, trend and alarms of one device. name : of the segments and the topics."""
    sinks, layer_listeners, listeners, memory = list[Sink](), list[LayersListener](), list[Listener](), None
    offset_ns = None if recorded is None else recorded.wall_offset_ns
    if watching.cut is not None and folder is not None:
        log = SegmentedLog(
            folder, name, watching.cut, watching.keep, block_rows=block_rows, live=live, recorded=recorded
        )  # fmt: skip
        store = TrendStore(folder / TREND_FOLDER, live=live, wall_offset_ns=offset_ns)
        sinks, layer_listeners, listeners, memory = (
            [log, store],
            [store.layers],
            [store.alarm],
            folder / TREND_FOLDER / ALARM_MEMORY,
        )
    if not rig.alarms:
        return Watched(sinks=sinks, layer_listeners=layer_listeners)
    if metrics is not None:
        listeners.append(lambda state: metrics.alarm(state.what, state.state))
    if publisher is not None:
        listeners.append(publisher.listener(name))
    alarms = AlarmWatch(rig, listeners, memory, None if offset_ns is None else lambda: offset_ns)
    return Watched(sinks=[*sinks, alarms], layer_listeners=[*layer_listeners, alarms.layers], alarms=alarms)
