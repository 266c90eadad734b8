"""Parts of every session, of one device or several: its sinks, the notices to the operator, its result."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daq.base.console.extras import check_installed
from daq.base.console.output import Output
from daq.base.console.tables import gap_lines, gap_reasons, parameters_table
from daq.base.contract.errors import CheckFailed
from daq.base.contract.sink import Sink
from daq.session.acquire import RunSummary
from daq.session.service import failure
from daq.trend.names import ALARM_CODE, ALARM_LEARNED_CODE, ALARM_OVER_CODE
from drivers.contract import Notice

if TYPE_CHECKING:
    from daq.report.metrics import MetricsServer

# codes of notices that end a fault
RECOVERY_CODES = (
    *("link_back", "bus_restarted", "error_active", "log_recovered", "viewer_back"),
    *(ALARM_OVER_CODE, ALARM_LEARNED_CODE),
)


class Operator:
    """Prints notices as they come, behind the name of the device where there are several."""

    def __init__(self, output: Output, device: str = "") -> None:
        self._output = output
        self._device = f"{device}: " if device else ""

    def __call__(self, notice: Notice) -> None:
        if notice.code == ALARM_CODE:  # on standard output: it is what was asked for
            self._output.say(f"{self._device}{notice.text}")
        elif notice.level == "info" and notice.code not in RECOVERY_CODES:
            self._output.detail(f"{self._device}{notice.text}")
        else:
            level = "note" if notice.level == "info" else notice.level
            self._output.note(f"{self._device}{level}: {notice.text}")


def make_sinks(
    output: Output, out: Path | None, rerun: str | None, live: bool, wall_offset_ns: int | None = None,
    table: bool = True, wanted: Callable[[], bool] | None = None, recorded: bool = False,
) -> list[Sink]:  # fmt: skip
    """wall_offset_ns : Unix time minus the monotonic time of the readings, where they are not of now.

    recorded : the samples are of a recording, and their log is dated by them.

    wanted : asked when the log is complete whether it is to be kept.
    """
    sinks: list[Sink] = []
    if out is not None:
        from daq.base.contract.dates import Recorded
        from daq.log.writer import LogWriter

        of = Recorded(wall_offset_ns) if recorded else None
        sinks.append(LogWriter(out, live=live, wanted=wanted or (lambda: True), recorded=of))
    if rerun is not None:
        check_installed(("rerun",), "", "--rerun")
        from daq.report.rerun.sink import RerunSink

        sinks.append(RerunSink(rerun, live=live, wall_offset_ns=wall_offset_ns))
    if table and sys.stderr.isatty() and not output.quiet:
        from daq.report.live_table import LiveTable

        sinks.append(LiveTable(output.to_stderr))
    return sinks


def serve_metrics(output: Output, port: int) -> MetricsServer:
    check_installed(("prometheus_client",), "monitor", "--metrics")
    from daq.report.metrics import MetricsServer

    server = MetricsServer(port)
    output.note(f"metrics at {server.url}")
    return server


def run_failure(
    summary: RunSummary, strict: bool, link: str, stopped: bool = False, alarms: Sequence[str] = ()
) -> Exception | None:
    """Why a finished run counts as failed; with `strict` also for a lost sample or an alarm.

    stopped : by a signal, also before the first sample. alarms : what each that was raised says.
    """
    if strict and alarms and not summary.lost_log:
        many = f" (and {len(alarms) - 1} more)" if len(alarms) > 1 else ""
        return CheckFailed(f"alarm: {alarms[0]}{many}; --strict asks for none")
    if strict and summary.lost_samples and not summary.lost_log:
        return CheckFailed(f"{summary.lost_samples} samples were lost; --strict asks for none")
    return failure(summary, link, stopped)


def in_words(summary: RunSummary, out: Path | None) -> list[Any]:
    """The result of a session, for people."""
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
