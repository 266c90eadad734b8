"""Reports during a session what the layers of a diagnosis find: record, machine and structure.

Faults that make a channel unfit to be judged, and impact trains, are reported as they come. Windows of ten seconds are
analysed one after the other, so an impact train is reported within 20 s of its start. At high rates only the end of
each window is analysed: 131072 samples a channel, and not less than 5 s.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.sink import Session, SinkHealth, Status
from daq.report.first_numbers import with_severity
from daq.report.layers import lines, strike_text, tone_name, tone_text
from drivers.contract import Block, Info, Notice, Reading
from estimator import Model
from estimator.results import Estimate

from .ring import KeptSamples

if TYPE_CHECKING:
    from estimator.identification.structure import StructureSurvey

WINDOW_S = 10.0  # that is analysed, one after the other
COSTLY_ROWS = 131_072  # of a window, beyond which its beginning is left out: 5.1 s at 25.6 kHz, at half the cost;
LEAST_LOOK_S = 5.0  # but no more than half: a strike train then has to be 1.2 times as strong to be found
STRUCTURE_EVERY = 3  # windows: modes change slowly
FORGET_WINDOWS = 3  # without a train or a tone, before it is reported again
SAID_ELSEWHERE = frozenset({"gaps", "missing_samples", "empty_channel"})  # by the ledger and the watch of the link
RECORD_FINDING, STRIKES_FOUND = "record_finding", "strikes_found"  # codes of warnings
TONES_FOUND, LAYERS_SEEN = "tones_found", "layers"  # codes of remarks; the last one has all layers, a line each
LAYER_CODES = frozenset({RECORD_FINDING, STRIKES_FOUND, TONES_FOUND, LAYERS_SEEN})

LayersListener = Callable[[int, Mapping[str, Any]], None]  # index behind a window, its layers as JSON; any thread


class LayerWatch:
    """A sink. live : a window is left out while the analysis of the one before it runs; a replay waits instead.

    A thread analyses the windows. They lie at multiples of the absolute index, so a replay reports the same.
    """

    def __init__(
        self, model: Model, live: bool, units: Sequence[str], listeners: Sequence[LayersListener] = ()
    ) -> None:
        """units : SI unit of each channel. listeners : called with the layers of each window."""
        self._model, self._live = model, live
        self._units = dict(zip((c.name for c in model.channels), units, strict=True))
        self._listeners = listeners
        self._kept = KeptSamples(model, 2.0 * WINDOW_S)
        self._info: Info | None = None
        self._next: int | None = None  # first sample of the next window
        self._standing: dict[tuple[str, ...], int] = {}  # what has been reported -> the last window that shows it
        self._structure: StructureSurvey | None = None
        self._notices: deque[Notice] = deque()
        self._thread: threading.Thread | None = None

    def start(self, session: Session) -> None:
        self._begin(session.info)

    def readings(self, batch: Sequence[Reading]) -> None:
        for reading in batch:
            if isinstance(reading, Info) and reading != self._info:
                self._begin(reading)
            elif isinstance(reading, Block):
                self._kept.append(reading)
                self._look(reading.index)

    def estimate(self, estimate: Estimate) -> None: ...

    def status(self, status: Status) -> None: ...

    def close(self) -> None: ...

    def health(self) -> SinkHealth:
        pending = self._thread is not None and self._thread.is_alive()  # asked first: it speaks before it ends
        return SinkHealth.of_notices(self._notices, pending)

    def _begin(self, info: Info) -> None:
        self._info, self._next = info, None
        self._kept.begin(info)

    def _look(self, index: int) -> None:
        """Analyse the window that is complete, if there is one. index : of the block."""
        rows = max(1, round(WINDOW_S * self._kept.rate_hz))
        if self._next is None:
            self._next = -(-index // rows) * rows
        if self._kept.stop < self._next + rows:
            return
        window = self._kept.stop // rows - 1
        self._next = (window + 1) * rows
        if self._thread is not None and self._thread.is_alive():
            if self._live:
                return
            self._thread.join()
        stop, looked_at = (window + 1) * rows, max(COSTLY_ROWS, round(LEAST_LOOK_S * self._kept.rate_hz))
        first = max(window * rows, stop - looked_at)
        y = self._kept.samples(first, stop)
        self._thread = threading.Thread(
            target=self._survey,
            args=(y, self._kept.rate_hz, window, first, self._kept.full_scale),
            name="layer watch",
            daemon=True,
        )
        self._thread.start()

    def _survey(
        self, y: NDArray[np.float64], rate_hz: float, window: int, first: int, full_scale: Mapping[str, int]
    ) -> None:
        """Report what is new in a window. window : its number. first : absolute index of its first sample that is
        analysed. full_scale : channel -> its samples that are left out."""
        from estimator.identification.machine import survey_machine
        from estimator.identification.record import severity, survey_record, without_spikes
        from estimator.identification.structure import survey_structure

        record = survey_record(self._model, y, rate_hz)
        first_s = first / rate_hz
        of_window = f" (times from {first_s:.4g} s on)" if first else ""
        for finding in record.findings:
            if finding.code not in SAID_ELSEWHERE and self._is_new((finding.code, *finding.channels), window):
                self._say("warning", RECORD_FINDING, finding.text + of_window)
        y = without_spikes(self._model, y, record)
        machine = survey_machine(self._model, y, rate_hz, record, live=True)
        when = f"{first_s:.4g} to {first_s + len(y) / rate_hz:.4g} s"
        found = machine.to_json()
        for train in found["strikes"]:
            if self._is_new((STRIKES_FOUND, train["name"]), window):
                self._say("warning", STRIKES_FOUND, f"{strike_text(train)}, seen from {when}")
        tones = [tone for tone in found["tones"] if self._is_new((TONES_FOUND, _rounded(tone_name(tone))), window)]
        if tones:
            self._say("info", TONES_FOUND, f"tones from {when}: " + "; ".join(map(tone_text, tones)))
        if self._structure is None or window % STRUCTURE_EVERY == 0:
            self._structure = survey_structure(self._model, y, rate_hz, record, machine)
        levels = severity(self._model, y, rate_hz, record, full_scale)
        seen = {
            "record": with_severity(record.to_json(), levels),
            "machine": found,
            "structure": self._structure.to_json(),
        }
        for listener in self._listeners:
            listener((window + 1) * len(y), seen)
        text = [f"{name}: {line}" if name else f"  {line}" for name, line in lines(seen, self._units)]
        self._say("info", LAYERS_SEEN, "\n".join([f"layers from {when}", *text]))

    def _is_new(self, key: tuple[str, ...], window: int) -> bool:
        """Whether something was not found in the last windows."""
        before = self._standing.get(key)
        self._standing[key] = window
        return before is None or window - before > FORGET_WINDOWS

    def _say(self, level: str, code: str, text: str) -> None:
        self._notices.append(Notice(time.monotonic_ns(), level, code, text))


def _rounded(name: str) -> str:
    """Name of a tone with its frequency rounded, so that a drift of a few per cent does not change it."""
    words = [f"{float(word):.2g}" if word.replace(".", "", 1).isdigit() else word for word in name.split()]
    return " ".join(words)
