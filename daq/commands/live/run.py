"""The bodies of run, simulate and replay."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daq.base.console.output import Output
from daq.base.console.stop import Stop
from daq.base.contract.dates import Recorded, utc_text
from daq.base.contract.errors import CheckFailed, ConfigError, LogError
from daq.base.contract.part import WHOLE_RECORD, Part
from daq.rig.edit import of_channels
from daq.rig.rig import Rig, load_rig
from daq.session.acquire import FINITE_KINDS, RECORDED_KINDS, RunSummary, acquire_from
from daq.session.links import open_driver
from daq.session.service import log_path, naming_sinks, refuse_own_log, replay_failure
from daq.trend.names import SEGMENTS_KEY

from .part_of import PartOf
from .parts import Operator, in_words, make_sinks, run_failure, serve_metrics
from .watching import Watched, Watching, watched

if TYPE_CHECKING:
    from daq.log.reader import Recording


def run(
    output: Output, rigs: Sequence[str], link: str | None, seconds: float | None, out: Path | None, rerun: str | None,
    strict: bool, metrics: int | None = None, watching: Watching | None = None,
) -> None:  # fmt: skip
    """rigs : RIG or RIG=LINK, several for several devices."""
    asked = [rig_and_link(text) for text in rigs]
    if link is not None and (len(asked) > 1 or asked[0][1] is not None):
        raise ConfigError("--link is for a single rig; for several rigs give RIG=LINK for each")
    output.prepare()
    options = {"seconds": seconds, "rerun": rerun, "strict": strict, "metrics": metrics, "watching": watching}
    if len(asked) > 1:
        from .devices import run_devices

        run_devices(output, asked, out, **options)  # type: ignore[arg-type]
    else:
        run_rig(output, load_rig(asked[0][0]), asked[0][1] if link is None else link, out, **options)  # type: ignore[arg-type]


def rig_and_link(text: str) -> tuple[Path, str | None]:
    """RIG or RIG=LINK; a file of that name is a rig, whatever is in its name."""
    path, equals, link = text.partition("=")
    if not equals or Path(text).exists():
        return Path(text), None
    if not link:
        raise ConfigError(
            f"{text}: no link after the =; give {path}=LINK, or {path} alone for the link of the rig file"
        )
    return Path(path), link


def run_rig(
    output: Output, rig: Rig, link: str | None, out: Path | None, *, seconds: float | None = None,
    rerun: str | None = None, strict: bool = False, metrics: int | None = None, command: str = "run",
    part: Part = WHOLE_RECORD, watching: Watching | None = None,
) -> None:  # fmt: skip
    """Acquire from a link into a log and a viewer, and report the result."""
    driver = open_driver(link, rig)
    if part.of_time:
        driver = PartOf(driver, part, link or "")
    server = None if metrics is None else serve_metrics(output, metrics)
    importing = command == "import"  # all of it or none
    with Stop() as stop, ExitStack() as leaving:
        live = driver.kind not in FINITE_KINDS
        wanted = None if not importing else lambda: not stop.event.is_set()
        recorded, offset_ns = driver.kind in RECORDED_KINDS, getattr(driver, "wall_offset_ns", None)
        shown = None if server is None else server.sink()
        log, watch = out, Watched(sinks=[], layer_listeners=[])
        if watching is not None:
            of, log = Recorded(offset_ns) if recorded else None, out if watching.cut is None else None
            publisher = watching.publisher(output, [rig], leaving)
            watch = watched(
                watching, rig, out, rig.model.name, live=live, recorded=of, publisher=publisher, metrics=shown
            )  # fmt: skip
        own = make_sinks(output, log, rerun, live=live, wanted=wanted, recorded=recorded, wall_offset_ns=offset_ns)
        sinks = [*watch.sinks, *own, *naming_sinks(rig, live, watch.layer_listeners)]
        if shown is not None:
            sinks.append(shown)
        metadata = {"command": command, "link": link or rig.link.url or ""}
        summary = acquire_from(rig, driver, sinks, seconds, stop.event, metadata=metadata, notify=Operator(output))
    if importing and stop.event.is_set():
        raise KeyboardInterrupt
    about = {"rig": rig.model.name, "band": list(rig.model.band)}
    _report(output, summary, log_path(sinks, out), about | watch.to_json())
    if stop.interrupted and not summary.lost_log:
        raise KeyboardInterrupt
    problem = run_failure(summary, strict, link or rig.link.url or "", stop.event.is_set(), alarms=watch.raised())
    if problem is not None:
        raise problem


def simulate(
    output: Output, rig_path: Path, out: Path | None, serve: str | None, seconds: float | None, seed: int,
    truth_path: Path | None, speed: str | None, device: Mapping[str, object], faults: Sequence[str],
) -> None:  # fmt: skip
    from daq.session.simulation import at_full_speed, fault_rates, machine

    if (out is None) == (serve is None):
        raise ConfigError("give either --out LOG.mcap to simulate into a log, or --serve LINK to simulate a device")
    pace = _speed(speed) if speed is not None else None if out else 1.0
    rig = load_rig(rig_path)
    truth = load_rig(truth_path) if truth_path is not None and truth_path.exists() else None
    if out is not None and seconds is None:
        seconds = 60.0
    layout = "serial16" if serve is not None and serve.startswith("serial:") else None
    config = {**device, "fault_rates": fault_rates(faults)}
    simulated = machine(rig, truth=truth, seed=seed, seconds=seconds, layout=layout, config=config)
    if simulated.assumed:
        names = ", ".join(simulated.assumed)
        output.note(f"{len(simulated.assumed)} values are not in the rig file; default values are used: {names}")
    if truth_path is not None and truth is None:
        _write_truth(rig, simulated.assumed, truth_path)
    value: dict[str, Any] = {"schema": 1, "seed": seed}
    if serve is not None:
        from drivers.served import serve as run_device

        with Stop() as stop:
            run_device(serve, simulated.device, pace, stop.event, lambda url: _serving(output, url))
        made = simulated.device.samples_made
        value |= {"samples": made, "seconds": made / simulated.device.config.rate_hz}
        output.result(value, f"sent {value['seconds']:.3f} s")
        if stop.interrupted:
            raise KeyboardInterrupt
        return
    with Stop() as stop:
        if pace is None:
            driver = at_full_speed(simulated.device)
        else:
            from drivers.contract import VirtualConfig
            from drivers.links import make_driver

            driver = make_driver(VirtualConfig(pace), device=simulated.device)  # type: ignore[assignment]
        sinks = make_sinks(output, out, None, live=pace is not None)
        metadata = {"command": "simulate", "link": "virtual:", "seed": str(seed)}
        summary = acquire_from(rig, driver, sinks, seconds, stop.event, metadata=metadata, notify=Operator(output))
    _report(output, summary, log_path(sinks, out), value)
    if summary.lost_log:
        raise LogError(summary.lost_log)
    if stop.event.is_set():  # by whatever signal: it is shorter than was asked for
        raise KeyboardInterrupt
    if not summary.samples:
        raise ConfigError(f"--seconds {seconds:g}: shorter than one frame, so there is no log; give more seconds")


def replay(
    output: Output, log: Path, speed: str, rig_path: Path | None, check: bool, out: Path | None, rerun: str | None,
    part: Part = WHOLE_RECORD,
) -> None:  # fmt: skip
    from daq.log.reader import read_log
    from daq.session.replay import logged_rig, replay_into

    refuse_own_log(log, out)
    pace = _speed(speed)
    if log.is_dir():
        from .replay_folder import replay_folder

        replay_folder(output, log, pace, rig_path, check, out=out, rerun=rerun, part=part)
        return
    if check and part:
        raise ConfigError("--check compares the whole log: leave out --from, --to, --seconds and --channels")
    recording = read_log(log, part=part)
    if check and SEGMENTS_KEY in recording.metadata:
        raise ConfigError(f"{log}: is a segment, and its estimates go on from those before: check the folder")
    if check and rig_path is not None and load_rig(rig_path).text != recording.rig_text:
        raise ConfigError("--check compares with the logged estimates, which were made with the log's own rig file: "
                          "leave --rig out, or give that very file")  # fmt: skip
    rig = of_channels(logged_rig(recording) if rig_path is None else load_rig(rig_path), part.channels)
    with Stop() as stop:
        offset_ns = recording.head.wall_offset_ns if recording.started_ns is not None else None
        sinks = make_sinks(output, out, rerun, live=False, wall_offset_ns=offset_ns, recorded=True)
        sinks += naming_sinks(rig, live=False)
        summary = replay_into(recording, rig, sinks, speed=pace, check=check, stop=stop.event, notify=Operator(output))
    started = None if recording.started_ns is None else utc_text(recording.started_ns)
    about = {"log": str(log), "started": started, "rig": rig.model.name, "band": list(rig.model.band)}
    _report(output, summary, log_path(sinks, out), about | {"rate_hz": recording.rate_hz})
    problem = replay_failure(summary, log, out)
    if problem is not None and not (stop.event.is_set() and not summary.lost_log):
        raise problem
    if stop.event.is_set():
        raise KeyboardInterrupt
    if check and not summary.identical:
        text = (
            f"the estimates of the replay are not the logged ones ({summary.compared} compared); the log was made by "
            "another version or on another kind of machine"
        )
        raise CheckFailed(f"{log}: {_damage(recording)}{text}")
    if check:
        _checked(output, recording, summary.compared)


def _damage(recording: Recording) -> str:
    """That a log is damaged, as the beginning of a message; "" if it is not, or if it was cut."""
    findings = recording.findings
    return f"is damaged: {findings.damage[0]}; " if findings.closed and findings.damage else ""


def _checked(output: Output, recording: Recording, compared: int) -> None:
    """Report that the estimates are identical. Raises CheckFailed if the log is damaged: lost ones are not compared."""
    log = recording.path
    if damage := _damage(recording):
        text = f"its {compared} intact estimates are the logged ones; `rotorscope recover` says what was lost"
        raise CheckFailed(f"{log}: {damage}{text}")
    output.say(f"{log}: all {compared} estimates are the logged ones, bit for bit")
    if recording.growing:
        output.note(f"{log}: is being written; checked is what it held")
    elif not recording.complete:
        why = next(iter(recording.findings.damage), "it has no end")
        output.note(f"{log}: is not complete ({why})")


def _speed(text: str) -> float | None:
    """--speed: times real time, None for max."""
    if text == "max":
        return None
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < 1e9:
        raise ConfigError(f'--speed {text}: give "max", or how many times real time, such as 1 or 0.5')
    return value


def _serving(output: Output, url: str) -> None:
    """Print the link of the device at once, for programs that wait for it on standard output."""
    if not output.quiet and output.json != "-":
        print(f"serving {url}", flush=True)  # noqa: T201
    else:
        print(f"serving {url}", file=sys.stderr, flush=True)  # noqa: T201


def _write_truth(rig: Rig, assumed: Any, path: Path) -> None:
    from daq.base.console.output import write_whole
    from daq.rig.edit import with_values

    write_whole(path, with_values(rig, assumed, digits=17))


def _report(output: Output, summary: RunSummary, out: Path | None, more: dict[str, Any]) -> None:
    out = out if summary.samples or summary.lost_samples else None  # else the log was not left behind
    output.result(summary.to_json() | more | ({"log": str(out)} if out else {}), *in_words(summary, out))
