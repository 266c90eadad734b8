"""`run` with several rigs: one service, and in it for each device its own link, clock, ring, estimator and log."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daq.base.console.output import Output
from daq.base.console.stop import Stop
from daq.base.contract.errors import ConfigError, RotorscopeError, exit_status
from daq.log.codec import text as as_text
from daq.report.rerun.process import VIEWER_PORT
from daq.rig.rig import load_rig
from daq.session.acquire import FINITE_KINDS, Device, RunSummary, acquire_all
from daq.session.links import open_driver
from daq.session.service import log_path, naming_sinks
from drivers.contract import LinkOpenError, Notice, Patient

from .parts import Operator, in_words, make_sinks, run_failure, serve_metrics
from .watching import Watched, Watching, watched

if TYPE_CHECKING:
    from .devices_table import DevicesTable


class DevicesFailed(RotorscopeError):
    """One line for each device that failed; the status of the worst."""

    def __init__(self, failed: dict[str, Exception]) -> None:
        super().__init__("\n".join(f"{name}: {_one_line(error)}" for name, error in failed.items()))
        self.exit_status = max(exit_status(error) or 1 for error in failed.values())


@dataclass(frozen=True, slots=True, kw_only=True)
class _Asked:
    device: Device
    link: str
    log: Path | None
    watch: Watched


def run_devices(
    output: Output, asked: Sequence[tuple[Path, str | None]], out: Path | None, *, seconds: float | None,
    rerun: str | None, strict: bool, metrics: int | None, watching: Watching | None = None,
) -> None:  # fmt: skip
    """Acquire from several links at once; a mistake in what was asked for ends it before anything begins.

    A link that is not there is tried again until the end, as one that was lost is.
    """
    _folder(out, ".mcap", "--out")
    with Stop() as stop, ExitStack() as leaving, ExitStack() as undo:
        server = None if metrics is None else serve_metrics(output, metrics)
        devices: list[_Asked] = []
        names = _names([path for path, _ in asked])
        table = _table(output, names)
        rigs = [load_rig(path) for path, _ in asked]
        publisher = None if watching is None else watching.publisher(output, rigs, leaving)
        for name, rig, (_, link) in zip(names, rigs, asked, strict=True):
            driver = open_driver(link, rig)
            live = driver.kind not in FINITE_KINDS
            segmented = watching is not None and watching.cut is not None
            log = None if out is None else out / (name if segmented else f"{name}.mcap")
            shown, watch = None if server is None else server.sink(), Watched(sinks=[], layer_listeners=[])
            if watching is not None:
                watch = watched(watching, rig, log, name, live=live, publisher=publisher, metrics=shown)
            viewer = _viewer(rerun, name, first=not devices)
            sinks = [*watch.sinks, *make_sinks(output, None if segmented else log, viewer, live=live, table=False)]
            sinks += naming_sinks(rig, live, watch.layer_listeners)
            for sink in sinks:
                undo.callback(sink.close)
            if shown is not None:
                sinks.append(shown)
            if table is not None:
                sinks.append(table.rows[name])
            url = link or rig.link.url or ""
            device = Device(
                name=name,
                rig=rig,
                driver=Patient(driver) if live else driver,
                sinks=sinks,
                metadata={"command": "run", "link": url},
            )
            devices.append(_Asked(device=device, link=url, log=log, watch=watch))
        undo.pop_all()
        operators = {name: Operator(output, name) for name in names}

        def notify(name: str, notice: Notice) -> None:
            operators[name](notice)
            if table is not None:
                table.rows[name].notice(notice)

        with table or nullcontext():
            outcome = acquire_all([each.device for each in devices], seconds, stop.event, notify=notify)
    failed = _report(output, devices, outcome, strict, stop.event.is_set())
    if stop.interrupted and not any(isinstance(r, RunSummary) and r.lost_log for r in outcome.values()):
        raise KeyboardInterrupt
    if failed:
        raise DevicesFailed(failed)


def _table(output: Output, names: Sequence[str]) -> DevicesTable | None:
    if output.quiet or not sys.stderr.isatty():
        return None
    from .devices_table import DevicesTable

    return DevicesTable(output.to_stderr, names)


def _report(
    output: Output, devices: Sequence[_Asked], outcome: dict[str, RunSummary | Exception], strict: bool, stopped: bool
) -> dict[str, Exception]:
    """Report the result of each device; returns the failures. stopped : by a signal, also before the first sample."""
    people: list[Any] = []
    values: list[dict[str, Any]] = []
    failed: dict[str, Exception] = {}
    for each in devices:
        name, result = each.device.name, outcome[each.device.name]
        value: dict[str, Any] = {"schema": 1, "device": name, "rig": each.device.rig.model.name, "url": each.link}
        wrong: Exception | None
        if isinstance(result, RunSummary):
            missing = each.device.driver.missing if isinstance(each.device.driver, Patient) else ""
            wrong = run_failure(result, strict, each.link, stopped, alarms=each.watch.raised())
            wrong = LinkOpenError(missing) if missing else wrong
            value |= each.watch.to_json()
            log = log_path(each.device.sinks, each.log) if result.samples or result.lost_samples else None
            value = result.to_json() | value | ({"log": str(log)} if log else {})
            people += ["", f"{name} ({each.link})", *in_words(result, log)]
        else:
            wrong = result
        if wrong is not None:
            failed[name] = wrong
            value["error"] = _one_line(wrong)
        values.append(value | {"exit_status": 0 if wrong is None else exit_status(wrong) or 1})
    output.result({"schema": 1, "devices": values}, *people[1:])
    return failed


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if exit_status(error) is not None else f"unexpected {type(error).__name__}: {text}"


def _names(paths: Sequence[Path]) -> list[str]:
    """Of the rig files, with a number where two are alike."""
    names: list[str] = []
    for path in paths:
        stem = as_text(path.stem)  # metrics hold no more than a log does
        name, number = stem, 2
        while name in names:
            name, number = f"{stem}-{number}", number + 1
        names.append(name)
    return names


def _viewer(rerun: str | None, name: str, first: bool) -> str | None:
    """A viewer shows all of them; of files there is one each."""
    if rerun == "spawn":
        return rerun if first else f"rerun+http://127.0.0.1:{VIEWER_PORT}/proxy"
    if rerun is None or "://" in rerun:
        return rerun
    _folder(Path(rerun), ".rrd", "--rerun")
    return str(Path(rerun) / f"{name}.rrd")


def _folder(path: Path | None, suffix: str, option: str) -> None:
    if path is None:
        return
    if path.suffix == suffix or path.is_file():
        raise ConfigError(f"{option} {path}: several devices write a file each: give a folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{option} {path}: {error.strerror}; choose another folder") from error
