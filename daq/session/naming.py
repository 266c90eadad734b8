"""Names an effect that the model begins to lack during a session: it diagnoses the last seconds when needed.

The rolling estimator marks in every estimate the candidate effects that are certain (estimator/watch.py). This sink
keeps the last samples. It reports a new certain effect or a jump of the parameters at once. When enough data of the
new state are there, it tries the whole catalogue on them, in a separate process if live. Time and samples of a
diagnosis depend on the estimates and their indices alone, so a replay reports the same.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.base.contract.errors import RotorscopeError
from daq.base.contract.sink import Session, SinkHealth, Status
from daq.rig.rig import Rig
from drivers.contract import Block, Gap, Info, Notice, Reading
from estimator.results import BACKGROUND_KEY, MISSING_FORCE_KEY, Estimate, certain_missing_effects

from .ring import KeptSamples

KEPT_S = 30.0  # of samples
ENOUGH_S = 7.0  # of the new state, to try the catalogue on
EVERY_S = 60.0  # at most so often
SETTLING_S = 20.0  # after a change, in which the estimator settles
NEW_FORCE_RATIO = 1.5  # times the missing force of the last time: something else has come
MIN_MEMORY_SHARE = 0.6  # of its length: an estimator with less memory has dropped the samples before a change
CHILD_S = 120.0
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """A request to diagnose these samples. known : effects found before, with their places."""

    text: str
    base: Path
    path: Path | None
    known: tuple[tuple[str, tuple[str, ...]], ...]
    y: Floats
    rate_hz: float
    since_s: float


def answer(question: Question) -> dict[str, Any]:
    """The diagnosis as JSON, or {"error": one line}."""
    from daq.rig.edit import with_effect
    from estimator.diagnosis.verdict import diagnose
    from estimator.errors import DataError, ModelError

    try:
        base, path = question.base, question.path
        rig = Rig.parse(question.text, base, path)
        for effect, at in question.known:
            rig = Rig.parse(with_effect(rig, effect, at), base, path)
        found = diagnose(rig.model, question.y, question.rate_hz)
        return found.to_json() if found.bearing.judged or found.ranking else {"error": found.bearing.reason}
    except (DataError, ModelError, RotorscopeError) as problem:
        return {"error": str(problem).splitlines()[0]}


class Naming:
    """A sink. live : the catalogue is tried in a separate process, and close() does not wait for it."""

    def __init__(
        self, rig: Rig, live: bool, ask: Callable[[Question], dict[str, Any]] = answer, enough_s: float = ENOUGH_S
    ) -> None:
        self._rig, self._live, self._ask, self._enough_s = rig, live, ask, enough_s
        self._kept = KeptSamples(rig.model, KEPT_S)
        self._notices: deque[Notice] = deque()
        self._rate_hz = 1.0
        self._info: Info | None = None
        self._level: float | None = None  # per cent missing when it was last said
        self._changed: int | None = None  # index of the last change said
        self._before: Estimate | None = None
        self._since: int | None = None  # first sample of the state to be named
        self._asked: int | None = None  # index at the last question
        self._gap = False
        self._known: dict[str, tuple[str, ...]] = {}
        self._child: subprocess.Popen[bytes] | None = None
        self._thread: threading.Thread | None = None

    # -- the sink ---------------------------------------------------------------------------------------------------

    def start(self, session: Session) -> None:
        self._begin(session.info)

    def readings(self, batch: Sequence[Reading]) -> None:
        for reading in batch:
            if isinstance(reading, Info) and reading != self._info:
                self._begin(reading)
            elif isinstance(reading, Gap) and reading.count:
                self._gap = True
            elif isinstance(reading, Block):
                self._kept.append(reading)

    def estimate(self, estimate: Estimate) -> None:
        extra = estimate.extra or {}
        self._look_for_a_jump(estimate)
        if MISSING_FORCE_KEY in extra:
            self._look_for_a_force(estimate, extra)
        second, at = self._rate_hz, estimate.index
        waited = self._asked is None or at - self._asked >= EVERY_S * second
        if waited and self._since is not None and at - self._since >= self._enough_s * second:
            self._name(at)

    def status(self, status: Status) -> None: ...

    def close(self) -> None:
        if self._child is not None:
            self._child.kill()

    def health(self) -> SinkHealth:
        pending = self._thread is not None and self._thread.is_alive()  # asked first: it speaks before it ends
        return SinkHealth.of_notices(self._notices, pending)

    # -- the rest is private ----------------------------------------------------------------------------------------

    def _begin(self, info: Info) -> None:
        self._info, self._rate_hz = info, info.rate_hz
        self._kept.begin(info)
        self._before, self._since = None, None

    def _look_for_a_jump(self, now: Estimate) -> None:
        """Detect a jump of the parameters by the memory that the estimator drops."""
        before, gap = self._before, self._gap
        if not now.parameters:
            return
        self._before, self._gap = now, False
        if before is None or gap or _background(before) != _background(now):  # which are no change of the machine
            return
        if now.samples > MIN_MEMORY_SHARE * before.samples:
            return
        if self._since is None or before.index - before.samples >= self._since:  # it had dropped the old state
            self._since = now.index
        settling = self._changed is not None and now.index - self._changed < SETTLING_S * self._rate_hz
        self._changed = now.index if not settling else self._changed
        moved = []
        for name, p in now.parameters.items():
            q = before.parameters.get(name)
            if q is not None and p.value is not None and q.value is not None and p.sd and q.sd:
                moved.append((abs(p.value - q.value) / (p.sd + q.sd), name, q.value, p.value, p.unit))
        if moved and not settling:
            _, name, was, is_now, unit = max(moved)
            text = f"the parameters have changed before {self._s(now.index)}: {name} {was:.4g} -> {is_now:.4g} {unit}"
            self._say("warning", "parameters_changed", text)

    def _look_for_a_force(self, now: Estimate, extra: Mapping[str, float]) -> None:
        sure = certain_missing_effects(extra)
        if not sure:
            self._level = None
            return
        if self._level is not None and (
            extra[MISSING_FORCE_KEY] <= NEW_FORCE_RATIO * self._level or self._since is not None
        ):
            if self._since is not None:  # still settling
                self._level = max(self._level, extra[MISSING_FORCE_KEY])
            return
        self._level = extra[MISSING_FORCE_KEY]
        if self._asked is not None and now.index - self._asked < SETTLING_S * self._rate_hz:
            return  # the diagnosis after a jump has just reported it
        if self._since is None:
            self._since = now.index  # earlier samples may be of a state in which nothing was missing
        best, *others = sure
        percent = extra[MISSING_FORCE_KEY]
        text = f"a force is missing from the model at {self._s(now.index)}: {percent:.2f} % of the bearing force"
        text += f", most like {best}" + (f" (or {', '.join(others)})" if others else "")
        self._say("warning", "missing_force", text)

    def _name(self, index: int) -> None:
        """Diagnose the samples of the new state."""
        if self._thread is not None and self._thread.is_alive():
            return
        first = max(self._since or 0, index - round(KEPT_S * self._rate_hz))
        self._since, self._asked = None, index
        y = self._kept.samples(first, index)
        rig, known = self._rig, tuple(self._known.items())
        question = Question(
            text=rig.text,
            base=rig.base,
            path=rig.path,
            known=known,
            y=y,
            rate_hz=self._rate_hz,
            since_s=first / self._rate_hz,
        )
        if not self._live:
            self._report(self._ask(question), question)
            return
        self._thread = threading.Thread(target=self._in_a_child, args=(question,), name="naming", daemon=True)
        self._thread.start()

    def _in_a_child(self, question: Question) -> None:
        try:
            command = [sys.executable, "-m", "daq.session.naming"]
            self._child = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True,  # Ctrl-C is ours
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            )  # fmt: skip
            reply, _ = self._child.communicate(pickle.dumps(question), CHILD_S)
            found = pickle.loads(reply) if self._child.returncode == 0 else {"error": "the diagnosis was ended"}
        except (OSError, ValueError, subprocess.SubprocessError) as problem:
            if self._child is not None:
                self._child.kill()
            found = {"error": f"the diagnosis did not finish: {problem}"}
        self._report(found, question)

    def _report(self, found: Mapping[str, Any], question: Question) -> None:
        level, code, text = said(found, question)
        if code == "effect_named":
            row = found["ranking"][0]
            places = dict.fromkeys(n.split(f".{row['effect']}.")[0] for n in row["parameters"])
            self._known[row["effect"]] = tuple(places) or tuple(row["at"])
        self._say(level, code, text)

    def _say(self, level: str, code: str, text: str) -> None:
        self._notices.append(Notice(time.monotonic_ns(), level, code, text))

    def _s(self, index: int) -> str:
        return f"{index / self._rate_hz:.0f} s"


def _background(estimate: Estimate) -> float | None:
    """When the background of an estimate was found, s; None where it has none."""
    return (estimate.extra or {}).get(BACKGROUND_KEY)


def said(found: Mapping[str, Any], question: Question) -> tuple[str, str, str]:
    """Level, code and text of a diagnosis, for an operator."""
    seconds = len(question.y) / question.rate_hz
    over = f"{question.since_s:.0f} to {question.since_s + seconds:.0f} s"
    if "error" in found:
        return "info", "effect_unknown", f"what is missing from {over} cannot be named: {found['error']}"
    verdict, rows = found["verdict"], found["ranking"]
    if verdict == "complete":
        return "info", "model_complete", f"the model is complete over {over}: nothing of the catalogue is missing"
    if verdict == "unknown":
        near = ", ".join(r["effect"] for r in rows[:3])
        return "warning", "effect_unknown", f"what is missing from {over} is none of the catalogue; nearest: {near}"
    row = rows[0]
    from daq.report.numbers import odds, percent

    text = f"{verdict} at {' and '.join(row['at'])} is missing from the model over {over} (p {odds(row['p_value'])}"
    before, after = row["missing_force_before_percent"], row["missing_force_after_percent"]
    text += f", missing force {percent(before)} -> {percent(after)})" if before else ", its force not yet seen)"
    if second := next((r["effect"] for r in rows if r["effect"] != verdict), ""):
        text += f"; runner-up {second}"
    return "warning", "effect_named", f"{text}; rotorscope effects {verdict} says what to look at"


if __name__ == "__main__":
    with contextlib.suppress(OSError):
        os.nice(10)
    from . import naming  # pickles name the module by its own name

    sys.stdout.buffer.write(pickle.dumps(naming.answer(pickle.load(sys.stdin.buffer))))
