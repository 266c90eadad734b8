"""What every session has, of one device or of several: its sinks, what the operator is told, what came of it."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daq.base.console.output import Output
from daq.base.console.tables import gap_lines, gap_reasons, parameters_table
from daq.base.contract.errors import CheckFailed, LogError
from daq.base.contract.sink import Sink
from daq.rig.rig import Rig
from daq.session.acquire import RunSummary
from drivers.contract import Notice

if TYPE_CHECKING:
    from daq.report.metrics import MetricsServer

OVER = ("link_back", "bus_restarted", "error_active", "log_recovered", "viewer_back")  # the end of what was told
LOG_LOST = ("log_incomplete", "log_failed", "log_cut")


class Operator:
    """Says notices as they come, behind the name of one of several devices; remembers what makes the log worthless."""

    def __init__(self, output: Output, device: str = "") -> None:
        self._output = output
        self._device = f"{device}: " if device else ""
        self.lost_log = ""

    def __call__(self, notice: Notice) -> None:
        if notice.code in LOG_LOST:
            self.lost_log = notice.text
        if notice.level == "info" and notice.code not in OVER:
            self._output.detail(f"{self._device}{notice.text}")
        else:
            level = "note" if notice.level == "info" else notice.level
            self._output.note(f"{self._device}{level}: {notice.text}")


def make_sinks(
    output: Output, out: Path | None, rerun: str | None, live: bool, wall_offset_ns: int | None = None,
    table: bool = True, wanted: Callable[[], bool] | None = None,
) -> list[Sink]:  # fmt: skip
    """wall_offset_ns : Unix time minus the monotonic time of the readings, where they are not of now.

    wanted : asked when the log is complete whether it is to be kept.
    """
    sinks: list[Sink] = []
    if out is not None:
        from daq.log.writer import LogWriter

        sinks.append(LogWriter(out, live=live, wanted=wanted or (lambda: True)))
    if rerun is not None:
        from daq.report.rerun.sink import RerunSink

        sinks.append(RerunSink(rerun, live=live, wall_offset_ns=wall_offset_ns))
    if table and sys.stderr.isatty() and not output.quiet:
        from daq.report.live_table import LiveTable

        sinks.append(LiveTable(output.to_stderr))
    return sinks


def log_of(sinks: Sequence[Sink], out: Path | None) -> Path | None:
    """Where the log is by now: elsewhere than asked for if it was removed and could not be put back there."""
    if out is None:
        return None
    from daq.log.writer import LogWriter

    path = next((sink.path for sink in sinks if isinstance(sink, LogWriter)), out)
    with contextlib.suppress(OSError):  # the folder that we were started in is gone
        return out if os.path.realpath(path) == os.path.realpath(out) else path
    return path


def naming(rig: Rig, live: bool) -> list[Sink]:
    """What names a force that begins to be missing, if the rolling estimate looks for one."""
    from daq.session.naming import Naming

    return [Naming(rig, live)] if rig.estimator.method == "spectral" else []


def serve_metrics(output: Output, port: int) -> MetricsServer:
    from daq.report.metrics import MetricsServer

    server = MetricsServer(port)
    output.note(f"metrics at {server.url}")
    return server


def what_is_wrong(summary: RunSummary, operator: Operator, strict: bool, link: str) -> Exception | None:
    """Why a session that came to its end failed nevertheless."""
    if operator.lost_log:
        return LogError(operator.lost_log)
    if strict and summary.lost_samples:
        return CheckFailed(f"{summary.lost_samples} samples were lost; --strict asks for none")
    return None if summary.samples else _nothing(summary, link)


def _nothing(summary: RunSummary, link: str) -> Exception:
    from drivers.contract import LinkOpenError

    if summary.stats.frames:
        what = "frames came, but none of the rig's channels; check the device, and [link] of the rig file"
    elif summary.stats.bytes:
        came = f"{summary.stats.bytes} bytes came, but no samples"
        what = f"{came}; check the kind of link (slcan: or serial:), the bit rate, and the device"
    else:
        what = "nothing came; check the device, its bit rate, and [link] of the rig file"
    return LinkOpenError(f"{link}: {what}")


def in_words(summary: RunSummary, out: Path | None) -> list[Any]:
    """What came of a session, for people."""
    people: list[Any] = []
    estimate = summary.last_estimate
    if estimate is not None and estimate.parameters:
        people += [parameters_table(estimate.parameters), ""]
    elif estimate is not None:
        people.append(f"no estimate: {estimate.status}")
    people += gap_lines(summary.gaps)
    lost = f", {summary.lost_samples} lost in {gap_reasons(summary.gaps)}" if summary.lost_samples else ", none lost"
    unlogged = f"; up to {summary.not_logged} of them are not in the log" if summary.not_logged else ""
    people.append(f"{summary.seconds:.3f} s, {summary.samples} samples of each channel{lost}{unlogged}")
    if out is not None:
        people.append(f"log: {out}")
    return people
