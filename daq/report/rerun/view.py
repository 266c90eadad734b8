"""A session drawn in a Rerun recording: readings, estimates and status in, entities on two time lines out.

It knows nothing of queues, files or viewers. The recording stream may be anything, and may block the caller.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.scaling import full_scale_count
from daq.base.contract.sink import ClockState, Status
from daq.report.numbers import unit_text
from drivers.contract import Block, Gap, Info, Notice, Reading, Signal
from estimator.results import MISSING_FORCE_KEY, WARM_UP_S_KEY, Estimate, certain_missing_effects

from .layout import BAD_COLOUR, DEVICE_TIME, GOOD_COLOUR, HOST_TIME, IDLE_COLOUR, colour, layout, part
from .signal import envelope
from .tail import TAIL_S, Tail

if TYPE_CHECKING:
    import rerun as rr

LAST_S = 9e9  # times are int64 nanoseconds: a gap may claim more than that
PREVIEW_HZ = 500.0  # rows a second of a waveform, two of them a bin; slower signals are shown whole
CALL_ROWS = 64  # a call to the recording: 50 to 100 times cheaper than one row each
NOTHING_MISSING, A_FORCE = "no force missing", "a force is missing"
WORD_OF_LEVEL = {"info": "INFO", "warning": "WARN", "error": "ERROR"}


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewSession:
    """Facts for the view. places : channel -> ("bearing1.x", kind); wall_ns : wall minus monotonic clock."""

    name: str
    recording_id: str
    info: Info
    places: Mapping[str, tuple[str, str]]
    band: tuple[float, float]
    wall_ns: int
    rig: str = ""
    facts: Mapping[str, str] = field(default_factory=dict)


class RerunView:
    """Draws one session. `take` in the order of the data, `close` at its end."""

    def __init__(self, recording: rr.RecordingStream, session: ViewSession) -> None:
        import rerun as rr

        self._rr, self._to, self._session = rr, recording, session
        self._clock: ClockState | None = None
        self._anchor = (0, 0)  # index, host monotonic ns: until the clock is known
        self._index = 0  # the next sample expected
        self._drawn = 0.0  # device time of the last spectrum, s
        self._exponents: dict[str, int] = {}
        self._kinds: dict[str, str] = {}  # of parameters, for the layout
        self._missing_force = False
        self._force_colours: dict[str, int] = {}
        self._sure: set[str] = set()  # effects of which the estimator was certain at some time
        self._states: dict[str, str] = {}
        self._begin(session.info)
        self._to.send_recording_name(session.name)
        self._text("rig", session.rig, "\n".join(f"- {k}: {v}" for k, v in session.facts.items()))
        for lane, good in (
            ("link", "receiving"),
            ("sensors", "in range"),
            ("estimator", "ok"),
            ("model", NOTHING_MISSING),
        ):
            self._lane(lane, good)
        self._state("link", "waiting")

    def take(self, item: Reading | Estimate | Status) -> None:
        """Draw one item. Block and Gap come in the order of their indices."""
        match item:
            case Block():
                self._block(item)
            case Gap():
                self._gap(item)
            case Notice(code="layers"):
                self._at(self._index)
                self._layers(item.text)
            case Notice():
                self._at(self._index)
                self._say(WORD_OF_LEVEL.get(item.level, "INFO"), f"{item.code}: {item.text}")
                if item.code == "silent":
                    self._state("link", "silent")
            case Info():
                if item != self._info:
                    self._flush()
                    self._begin(item)
                    self._say("INFO", f"device {item.serial_number or 'without a number'}, {item.rate_hz:g} Hz")
            case Estimate():
                self._estimate(item)
            case Status():
                self._status(item)

    def close(self) -> None:
        self._flush()
        self._say("INFO", "end of the session")

    # ---- time

    def _host_ns(self, index: NDArray[np.int64] | int) -> NDArray[np.int64]:
        """Wall clock of a device index."""
        if self._clock is not None:
            t = self._clock.offset_ns + np.asarray(index) * (1e9 / self._clock.rate_hz)
        else:
            t = self._anchor[1] + (np.asarray(index) - self._anchor[0]) * (1e9 / self._info.rate_hz)
        return np.clip(np.asarray(t) + self._session.wall_ns, -LAST_S * 1e9, LAST_S * 1e9).astype(np.int64)

    def _device_s(self, index: NDArray[np.int64] | int) -> NDArray[np.float64]:
        """Device time of an index."""
        return np.minimum(np.asarray(index) / self._info.rate_hz, LAST_S)

    def _columns(self, index: NDArray[np.int64]) -> list[rr.TimeColumn]:
        host = self._host_ns(index).astype("datetime64[ns]")
        return [
            self._rr.TimeColumn(DEVICE_TIME, duration=self._device_s(index)),
            self._rr.TimeColumn(HOST_TIME, timestamp=host),
        ]

    def _at(self, index: int) -> None:
        """Set the time of what is logged next."""
        self._to.set_time(DEVICE_TIME, duration=float(self._device_s(index)))
        self._to.set_time(HOST_TIME, timestamp=np.datetime64(int(self._host_ns(index)), "ns"))

    # ---- signals

    def _begin(self, info: Info) -> None:
        """Take a (new) description of the device."""
        rr = self._rr
        self._info = info
        self._signals: tuple[Signal, ...] = info.signals
        self._scale = np.array([s.scale for s in info.signals])
        self._offset = np.array([s.offset for s in info.signals])
        self._units = list(dict.fromkeys(s.unit for s in info.signals))
        self._by_unit = {unit: [s.name for s in info.signals if s.unit == unit] for unit in self._units}
        self._full = full_scale_count(info.count_bits)
        self._width = max(1, round(2 * info.rate_hz / PREVIEW_HZ))
        self._enough = max(self._width * CALL_ROWS // 2, round(info.rate_hz / 4)) if self._width > 1 else CALL_ROWS
        self._pending: list[Block] = []
        self._held = 0
        self._tail = Tail(self._to, info, self._session.places, self._session.band)
        for k, signal in enumerate(info.signals):
            style = rr.SeriesLines(colors=[colour(k)], names=signal.name, widths=1.0, aggregation_policy="MinMax")
            self._to.log(self._path(k), style, static=True)
        self._lay_out()

    def _path(self, k: int) -> str:
        return f"waveform/{self._units.index(self._signals[k].unit)}/{part(self._signals[k].name)}"

    def _lay_out(self) -> None:
        kinds = {kind: self._kinds[kind] for kind in sorted(self._kinds)}
        self._to.send_blueprint(layout(self._by_unit, list(self._tail.pairs), kinds, self._missing_force))

    def _block(self, block: Block) -> None:
        n = len(block.counts)
        if not n or block.counts.shape[1] != len(self._signals):
            return
        if self._anchor == (0, 0):
            self._anchor = (block.index + n, block.t_host_ns)
        if block.index != self._index and self._held:
            self._flush()
        self._tail.skip(block.index - self._index)
        self._pending.append(block)
        self._held += n
        self._index = block.index + n
        self._state("link", "receiving", block.index)
        if self._held >= self._enough:
            self._flush()

    def _gap(self, gap: Gap) -> None:
        self._flush()
        nothing = np.full(1, np.nan)
        at = np.array([gap.index], np.int64)
        for k in range(len(self._signals)):
            self._send(self._path(k), at, self._rr.Scalars.columns(scalars=nothing))
        self._state("link", f"gap: {gap.reason}", gap.index)
        self._say("WARN", f"gap: {gap.count} samples lost from index {gap.index} ({gap.reason})")
        if gap.index + gap.count > self._index:
            self._tail.skip(gap.index + gap.count - self._index)
            self._index = gap.index + gap.count

    def _flush(self) -> None:
        if not self._pending:
            return
        blocks, self._pending, self._held = self._pending, [], 0
        counts = np.concatenate([b.counts for b in blocks])
        at, rows = envelope(blocks[0].index, counts, self._width)
        values = rows * self._scale + self._offset
        for k in range(len(self._signals)):
            self._send(self._path(k), at, self._rr.Scalars.columns(scalars=values[:, k]))
        hits = np.any(np.abs(rows) >= self._full, axis=0).tolist()
        clipped = [s.name for s, hit in zip(self._signals, hits, strict=True) if hit]
        self._state("sensors", "clipped: " + " ".join(clipped) if clipped else "in range", blocks[0].index)
        self._tail.push(counts * self._scale + self._offset)
        now = self._index / self._info.rate_hz
        if now - self._drawn >= TAIL_S:
            self._drawn = now
            self._at(self._index)
            self._tail.draw()

    def _send(self, path: str, at: NDArray[np.int64], columns: Any) -> None:
        self._rr.send_columns(path, self._columns(at), columns, recording=self._to)

    # ---- estimates

    def _estimate(self, estimate: Estimate) -> None:
        rr = self._rr
        self._at(estimate.index)
        new = False
        for name, p in estimate.parameters.items():
            place, kind = ".".join(name.split(".")[:2]), ".".join(name.split(".")[2:]) or name
            if p.value is None and kind not in self._exponents:
                continue  # nothing to choose a scale by
            exponent = self._exponents.setdefault(kind, engineering(p.value or 1.0))
            if kind not in self._kinds:
                new = True
                self._kinds[kind] = f"{kind}  [{'' if not exponent else f'1e{exponent} '}{unit_text(p.unit)}]  ± 1 sd"
            scale = 10.0**-exponent
            value = math.nan if p.value is None else p.value * scale
            sd = math.nan if p.sd is None else p.sd * scale
            band = rr.Measurements(values=[value], variances=[sd * sd], names=[place], colors=[self._tint(place)])
            self._to.log(f"estimate/{part(kind)}/{part(place)}", band)
        extra = estimate.extra or {}
        if MISSING_FORCE_KEY in extra:
            new |= not self._missing_force
            self._missing_force = True
            sure = certain_missing_effects(extra)
            for k, name in enumerate(dict.fromkeys(["all candidates", *sorted(self._sure), *sure])):
                value = extra.get(
                    MISSING_FORCE_KEY if not k else f"{MISSING_FORCE_KEY}_{name}", math.nan
                )  # NaN ends the line of what is over
                style = rr.SeriesLines(names=name, colors=[self._series_colour(name)])
                self._to.log(f"missing_force/{part(name)}", rr.Scalars(value), style)
            self._sure.update(sure)
            self._state("model", A_FORCE if sure else NOTHING_MISSING, estimate.index)
        self._state("estimator", "warming up" if WARM_UP_S_KEY in extra else estimate.status, estimate.index)
        if new:
            self._lay_out()

    def _series_colour(self, name: str) -> tuple[int, int, int]:
        """Colour of a line of the missing force; a name keeps its colour."""
        return colour(self._force_colours.setdefault(name, len(self._force_colours)))

    def _tint(self, place: str) -> tuple[int, int, int]:
        """The colour of the channel at that place."""
        for k, signal in enumerate(self._signals):
            if self._session.places.get(signal.name, ("", ""))[0] == place:
                return colour(k)
        return colour(len(self._signals))

    # ---- status, lanes, log

    def _status(self, status: Status) -> None:
        self._flush()
        if status.clock is not None:
            self._clock = status.clock
        self._at(status.index)
        link = status.link
        lost = {
            "lost samples": link.lost_samples,
            "CRC errors": link.crc_errors,
            "resynchronisations": link.resyncs,
            "duplicates": link.duplicates,
            "restarts": link.restarts,
            "reconnects": link.reconnects,
        } | {f"dropped by {name}": count for name, count in status.dropped.items()}
        self._scalars("health/lost", lost)
        self._scalars("health/lag", status.lag_s)
        if status.clock is not None:
            bound_us = status.clock.bound_ns / 1e3
            self._scalars("health/clock", {"drift, ppm": status.clock.drift_ppm, "bound, us": bound_us})

    def _scalars(self, path: str, values: Mapping[str, float]) -> None:
        for k, (name, value) in enumerate(values.items()):
            entity = f"{path}/{part(name)}"
            style = self._rr.SeriesLines(names=name, colors=[colour(k)])
            self._to.log(entity, self._rr.Scalars(float(value)), style)

    def _lane(self, lane: str, good: str) -> None:
        bad = [A_FORCE] + [f"gap: {r}" for r in ("sequence", "crc", "device_lost")]
        values = [good, "waiting", "warming up", "silent", *bad]
        colours = [GOOD_COLOUR, IDLE_COLOUR, IDLE_COLOUR, BAD_COLOUR, *[BAD_COLOUR] * len(bad)]
        style = self._rr.StateConfiguration(values=values, colors=colours)
        self._to.log(f"state/{lane}", style, static=True)

    def _state(self, lane: str, state: str, index: int | None = None) -> None:
        if self._states.get(lane) != state:
            self._states[lane] = state
            self._at(self._index if index is None else index)
            self._to.log(f"state/{lane}", self._rr.StateChange(state=state))

    def _say(self, level: str, text: str) -> None:
        self._to.log("log", self._rr.TextLog(text, level=level))

    def _layers(self, text: str) -> None:
        """The layers of the last seconds, a line each."""
        heading, *lines = text.splitlines() or [""]
        body = "\n".join([f"**{heading}**", "", *(f"- {line}" if line[:1] != " " else f"  {line}" for line in lines)])
        self._to.log("layers", self._rr.TextDocument(body, media_type=self._rr.MediaType.MARKDOWN))

    def _text(self, path: str, *parts: str) -> None:
        body = "\n\n".join(f"```\n{part}\n```" if k == 0 else part for k, part in enumerate(parts) if part)
        document = self._rr.TextDocument(body, media_type=self._rr.MediaType.MARKDOWN)
        self._to.log(path, document, static=True)


def engineering(value: float) -> int:
    """The power of ten, a multiple of 3, that leaves 1 to 1000 of `value`."""
    return 0 if not value else 3 * math.floor(math.log10(abs(value)) / 3)
