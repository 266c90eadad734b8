"""The bodies of run, simulate and replay."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from drivers.errors import LinkError
from drivers.reading import Notice

from .acquire import RunSummary, acquire
from .errors import CheckFailed, ConfigError, LogError
from .links import open_driver
from .output import Output
from .rig import Rig, load_rig
from .sink import Sink
from .stop import Stop
from .tables import gap_lines, gap_reasons, parameters_table

LOG_LOST = ("log_incomplete", "log_failed")


class Operator:
    """Says notices as they come; remembers what makes the log worthless."""

    def __init__(self, output: Output) -> None:
        self._output = output
        self.lost_log = ""

    def __call__(self, notice: Notice) -> None:
        if notice.code in LOG_LOST:
            self.lost_log = notice.text
        if notice.level == "info":
            self._output.detail(notice.text)
        else:
            self._output.note(f"{notice.level}: {notice.text}")


def run(
    output: Output, rig_path: Path, link: str | None, seconds: float | None, out: Path | None, rerun: str | None,
    strict: bool, metrics: int | None = None,
) -> None:  # fmt: skip
    run_rig(output, load_rig(rig_path), link, out, seconds=seconds, rerun=rerun, strict=strict, metrics=metrics)


def run_rig(
    output: Output, rig: Rig, link: str | None, out: Path | None, *, seconds: float | None = None,
    rerun: str | None = None, strict: bool = False, metrics: int | None = None, command: str = "run",
) -> None:  # fmt: skip
    """Acquire from a link into a log and a viewer, and say what came of it."""
    driver = open_driver(link, rig)
    existed = out is not None and out.exists()
    operator = Operator(output)
    with Stop() as stop:
        sinks = _sinks(output, out, rerun, live=driver.kind not in ("capture", "replay"))
        if metrics is not None:
            sinks.append(_metrics(output, metrics))
        metadata = {"command": command, "link": link or rig.link.url or ""}
        try:
            summary = acquire(rig, driver, sinks, seconds, stop.event, metadata=metadata, notify=operator)
        except (LinkError, ConfigError):
            if out is not None and not existed:
                out.unlink(missing_ok=True)  # nothing was acquired: an empty log would only be in the way
            raise
    _report(output, summary, out, {"rig": rig.model.name})
    if operator.lost_log:
        raise LogError(operator.lost_log)
    if stop.interrupted:
        raise KeyboardInterrupt
    if strict and summary.lost_samples:
        raise CheckFailed(f"{summary.lost_samples} samples were lost; --strict asks for none")
    if not summary.samples:
        raise _nothing(summary, link or rig.link.url or "")


def _nothing(summary: RunSummary, link: str) -> Exception:
    from drivers.errors import LinkOpenError

    what = "frames came, but none of the rig's channels" if summary.stats.frames else "nothing came"
    return LinkOpenError(f"{link}: {what}; check the device, its bit rate, and [link] of the rig file")


def simulate(
    output: Output, rig_path: Path, out: Path | None, serve: str | None, seconds: float | None, seed: int,
    truth_path: Path | None, speed: str | None, device: Mapping[str, object], faults: Sequence[str],
) -> None:  # fmt: skip
    from .simulation import FrameSource, fault_rates, machine

    if (out is None) == (serve is None):
        raise ConfigError("say --out LOG.mcap to simulate into a log, or --serve LINK to be a device; one of the two")
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
        output.note(f"{len(simulated.assumed)} values are left open, and plain ones taken: {names}")
    if truth_path is not None and truth is None:
        _write_truth(rig, simulated.assumed, truth_path)
    value: dict[str, Any] = {"schema": 1, "seed": seed}
    if serve is not None:
        from drivers.serve import serve as run_device

        with Stop() as stop:
            run_device(serve, simulated.device, pace, stop.event, lambda url: _serving(output, url))
        made = simulated.device.samples_made
        value |= {"samples": made, "seconds": made / simulated.device.config.rate_hz}
        output.result(value, f"sent {value['seconds']:.3f} s")
        if stop.interrupted:
            raise KeyboardInterrupt
        return
    from drivers.can_decoder import CanDecoder
    from drivers.link import Link
    from drivers.reading import LinkStats

    with Stop() as stop:
        if pace is None:
            decoder = CanDecoder(LinkStats(), simulated.device.config.base_id)
            driver = Link("simulated", "simulated device", FrameSource(simulated.device), decoder)
        else:
            from drivers.links import VirtualConfig, make_driver

            driver = make_driver(VirtualConfig(pace), device=simulated.device)  # type: ignore[assignment]
        sinks = _sinks(output, out, None, live=pace is not None)
        metadata = {"command": "simulate", "link": "virtual:", "seed": str(seed)}
        operator = Operator(output)
        summary = acquire(rig, driver, sinks, seconds, stop.event, metadata=metadata, notify=operator)
    _report(output, summary, out, value)
    if operator.lost_log:
        raise LogError(operator.lost_log)
    if stop.interrupted:
        raise KeyboardInterrupt


def replay(
    output: Output, log: Path, speed: str, rig_path: Path | None, check: bool, out: Path | None, rerun: str | None
) -> None:
    from .log_reader import read_log
    from .replay import replay as replay_log

    if out is not None and out.exists() and log.exists() and out.samefile(log):
        raise ConfigError(f"{out}: is the log to be replayed; choose another --out")
    if check and rig_path is not None:
        raise ConfigError("--check compares with the logged estimates, which were made with the log's own rig file: "
                          "leave --rig out")  # fmt: skip
    pace = _speed(speed)
    recording = read_log(log)
    rig = Rig.parse(recording.rig_text, where=f"{log}: rig.toml") if rig_path is None else load_rig(rig_path)
    operator = Operator(output)
    with Stop() as stop:
        sinks = _sinks(output, out, rerun, live=False, wall_offset_ns=recording.head.wall_offset_ns)
        summary = replay_log(recording, rig, sinks, speed=pace, check=check, stop=stop.event, notify=operator)
    _report(output, summary, out, {})
    if operator.lost_log:
        raise LogError(operator.lost_log)
    if stop.interrupted:
        raise KeyboardInterrupt
    if check and not summary.identical:
        raise CheckFailed(
            f"{log}: the estimates of the replay are not the logged ones ({summary.compared} compared); "
            "the log was made by another version or on another kind of machine"
        )
    if check:
        output.say(f"{log}: all {summary.compared} estimates are the logged ones, bit for bit")


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


def _sinks(
    output: Output, out: Path | None, rerun: str | None, live: bool, wall_offset_ns: int | None = None
) -> list[Sink]:
    """wall_offset_ns : Unix time minus the monotonic time of the readings, where they are not of now."""
    sinks: list[Sink] = []
    if out is not None:
        from .log_writer import LogWriter

        sinks.append(LogWriter(out, live=live))
    if rerun is not None:
        from .rerun_sink import RerunSink

        sinks.append(RerunSink(rerun, live=live, wall_offset_ns=wall_offset_ns))
    if sys.stderr.isatty() and not output.quiet:
        from .live_table import LiveTable

        sinks.append(LiveTable(output.to_stderr))
    return sinks


def _metrics(output: Output, port: int) -> Sink:
    from .metrics import MetricsServer

    server = MetricsServer(port)
    output.note(f"metrics at {server.url}")
    return server.sink()


def _serving(output: Output, url: str) -> None:
    """Where the device is: on standard output at once, for whoever waits for it."""
    if not output.quiet and output.json != "-":
        print(f"serving {url}", flush=True)  # noqa: T201
    else:
        print(f"serving {url}", file=sys.stderr, flush=True)  # noqa: T201


def _write_truth(rig: Rig, assumed: Any, path: Path) -> None:
    from .edit import with_values
    from .output import write_whole

    write_whole(path, with_values(rig, assumed, digits=17))


def _report(output: Output, summary: RunSummary, out: Path | None, more: dict[str, Any]) -> None:
    people: list[Any] = []
    estimate = summary.last_estimate
    if estimate is not None and estimate.parameters:
        people += [parameters_table(estimate.parameters), ""]
    elif estimate is not None:
        people.append(f"no estimate: {estimate.status}")
    people += gap_lines(summary.gaps)
    lost = f", {summary.lost_samples} lost in {gap_reasons(summary.gaps)}" if summary.lost_samples else ", none lost"
    people.append(f"{summary.seconds:.3f} s, {summary.samples} samples of each channel{lost}")
    if out is not None:
        people.append(f"log: {out}")
    output.result(summary.to_json() | more | ({"log": str(out)} if out else {}), *people)
