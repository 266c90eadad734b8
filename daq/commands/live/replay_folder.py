"""The body of replay for a folder of segments: each session as one log."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from daq.base.console.output import Output
from daq.base.console.stop import Stop
from daq.base.contract.errors import CheckFailed, ConfigError
from daq.base.contract.part import Part
from daq.rig.rig import load_rig
from daq.session.acquire import RunSummary
from daq.session.replay import logged_rig, replay_into
from daq.session.service import naming_sinks
from daq.trend.folder import LoggedSession, sessions

from .parts import Operator, in_words, make_sinks


def replay_folder(
    output: Output, folder: Path, pace: float | None, rig_path: Path | None, check: bool, *, out: Path | None,
    rerun: str | None, part: Part,
) -> None:  # fmt: skip
    """Replay the sessions one after the other. With `check`, those that are there from their first segment on."""
    if part:
        raise ConfigError("--from, --to, --seconds and --channels are for one log: give a segment")
    if check and rig_path is not None:
        text = "--check compares with the logged estimates, which were made with the rig file in the segments"
        raise ConfigError(f"{text}: leave --rig out")
    found = sessions(folder)
    for session in found:
        if session.lost_end:
            output.note(f"{session.lost_end}: nothing in it can be read; the session ends with the segment before it")
    if len(found) > 1 and (out is not None or rerun is not None):
        raise ConfigError(f"{folder}: holds {len(found)} sessions; --out and --rerun are for one: give a segment")
    if check:
        for session in found:
            if session.unlike:
                output.note(f"not checked, {session.parts[0].path.name}: the folder {session.unlike}")
        found = [session for session in found if not session.unlike]
        if not found:
            raise CheckFailed(f"{folder}: no session can be checked: each is only in part in the folder")
    values, people, differ = list[dict[str, Any]](), list[Any](), list[str]()
    with Stop() as stop:
        for session in found:
            summary = _replayed(output, session, pace, rig_path, check, stop=stop, out=out, rerun=rerun)
            values.append(
                summary.to_json() | {"segments": len(session.parts), "first_segment": session.parts[0].path.name}
            )
            name = session.parts[0].path.name
            people += ["", f"{name} and {len(session.parts) - 1} that follow", *in_words(summary, out)]
            if stop.event.is_set():
                break
            if check and not (summary.identical and not session.damage):
                differ.append(name)
    value: dict[str, Any] = {"schema": 1, "sessions": values}
    compared = sum(one.get("estimates_compared", 0) for one in values)
    if check:
        value |= {"identical": not differ, "estimates_compared": compared}
    output.result(value, *people[1:])
    if stop.event.is_set():
        raise KeyboardInterrupt
    if differ:
        text = "the estimates of the replay are not the logged ones, or a segment is damaged"
        raise CheckFailed(f"{folder}: {text}: session of {', '.join(differ)} ({compared} compared)")
    if check:
        output.say(f"{folder}: all {compared} estimates are the logged ones, bit for bit")


def _replayed(
    output: Output, session: LoggedSession, pace: float | None, rig_path: Path | None, check: bool, *, stop: Stop,
    out: Path | None, rerun: str | None,
) -> RunSummary:  # fmt: skip
    rig = logged_rig(session) if rig_path is None else load_rig(rig_path)
    offset_ns = session.head.wall_offset_ns if session.started_ns is not None else None
    sinks = make_sinks(output, out, rerun, live=False, wall_offset_ns=offset_ns, recorded=True)
    sinks += naming_sinks(rig, live=False)
    return replay_into(session, rig, sinks, speed=pace, check=check, stop=stop.event, notify=Operator(output))
