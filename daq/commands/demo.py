"""`rotorscope demo`: the whole story on one machine, with no hardware, in under a minute.

A simulated rig has an effect that its model lacks. Its device streams over an in-process CAN bus into the real driver,
ring, rolling estimator, MCAP and Rerun log; then replay, compare, diagnose, add, compare. Nothing in the second part
knows the first part's truth, which is printed beside the results.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.rule import Rule

from daq.base.console.extras import installed, missing_library
from daq.base.console.output import Output, write_whole
from daq.base.console.tables import ladder_table, parameters_table
from daq.base.contract.errors import CheckFailed, ConfigError
from daq.base.contract.sink import Session, Sink, Status
from daq.exchange.measurement import Measurement
from daq.report.live_table import missing_text
from daq.rig.edit import with_effect, with_values
from daq.rig.rig import Rig, load_rig
from drivers.contract import Reading
from estimator.results import Estimate, Parameter

if TYPE_CHECKING:
    from estimator.diagnosis.comparison import Comparison

DEMO_SECONDS = 20.0
DEMO_SEED = 7
TOLD_AT_S = (1.0, 2.0, 5.0, 10.0, 15.0, 19.5)
TRUE_LINEAR = {  # kL N/m, c N s/m, S N^2/Hz
    "bearing1.x": (10.0e6, 60.0, 9.0e-5),
    "bearing1.y": (9.2e6, 55.0, 9.0e-5),
    "bearing2.x": (11.0e6, 65.0, 8.0e-5),
    "bearing2.y": (10.4e6, 58.0, 8.0e-5),
}
TRUE_KNL = 1.3e18  # N/m^3
HIDDEN_EFFECT, HIDDEN_AT = "clearance", "bearing1"
HIDDEN_VALUES = {"k": 1.5e6, "gap": 0.19e-6}  # N/m, m


def demo(output: Output, out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{out}: cannot be made: {error.strerror}; choose another --out") from error
    rig_path, truth_path = out / "rig.toml", out / "truth.toml"
    write_whole(rig_path, Path(__file__).with_name("demo_rig.toml").read_text("utf-8"))
    rig = load_rig(rig_path)
    write_whole(truth_path, truth_text(rig))
    truth = load_rig(truth_path)
    files = [rig_path, truth_path]

    values = ", ".join(f"{k} = {v:g}" for k, v in HIDDEN_VALUES.items())
    output.say(
        Rule("1  acquire"),
        f"A simulated rig has a {HIDDEN_EFFECT} at {HIDDEN_AT} ({values}), which the model in {rig_path} lacks.",
        f"{DEMO_SECONDS:g} s of four channels at 25.6 kHz go over a virtual CAN FD bus into driver, ring, estimator, "
        "MCAP and Rerun log, faster than real time. The stiffness of the sound bearing, and the force that the model "
        "lacks, meanwhile:",
    )
    log, recording = out / "measurement.mcap", out / "measurement.rrd"
    acquire_demo(output, rig, truth, log, recording)
    files += [log, recording]

    output.say(Rule("2  replay"))
    replay_demo(output, log)

    steps, report = _improve(output, rig, truth, log, out)
    files += report
    output.say(Rule("files"), *(f"  {path}" for path in files))
    output.say(f"Look at it: rerun {recording}")
    output.result({"schema": 1, "ladder": steps, "files": [str(path) for path in files]})


def truth_text(rig: Rig) -> str:
    """The rig file with the true values and the hidden effect."""
    known = {
        f"{place}.{key}": Parameter(value, 0.0, "")
        for place, values in TRUE_LINEAR.items()
        for key, value in zip(("kL", "c", "S"), values, strict=True)
    }
    known |= {f"{place}.cubic.kNL": Parameter(TRUE_KNL, 0.0, "N/m^3") for place in TRUE_LINEAR}
    with_known = Rig.parse(with_values(rig, known), rig.base, rig.path)
    hidden = {place: HIDDEN_VALUES for place in TRUE_LINEAR if place.startswith(HIDDEN_AT)}
    return with_effect(with_known, HIDDEN_EFFECT, [HIDDEN_AT], hidden)


def acquire_demo(
    output: Output, rig: Rig, truth: Rig, log: Path, recording: Path, seconds: float = DEMO_SECONDS
) -> None:  # fmt: skip
    """Acquire the true machine over the virtual bus into a log and a recording for the viewer."""
    from daq.commands.live.parts import Operator
    from daq.log.writer import LogWriter
    from daq.session.acquire import acquire_from
    from daq.session.simulation import machine
    from drivers.contract import VirtualConfig
    from drivers.links import make_driver

    device = machine(rig, truth=truth, seed=DEMO_SEED, seconds=seconds).device
    driver = make_driver(VirtualConfig(None), device=device)
    sinks: list[Sink] = [LogWriter(log), Watch(output, known_values(truth))]
    if installed("rerun"):
        from daq.report.rerun.sink import RerunSink

        sinks.insert(1, RerunSink(str(recording)))
    else:
        output.note(missing_library("rerun", "", f"no {recording.name}"))
    metadata = {"command": "demo", "link": "virtual:"}
    summary = acquire_from(rig, driver, sinks, seconds, metadata=metadata, notify=Operator(output))
    lost = f"{summary.lost_samples} samples lost" if summary.lost_samples else "no sample lost"
    output.say(f"{summary.samples} samples of each channel, {lost}")


def known_values(rig: Rig) -> dict[str, float]:
    """Every value of a rig file by its full name."""
    out = {f"{p}.{k}": s.value for p, t in rig.model.linear.items() for k, s in t.items() if s.value is not None}
    for use in rig.model.effects:
        named = {f"{p}.{use.name}.{k}": s.value for p, t in use.parameters.items() for k, s in t.items()}
        out |= {name: value for name, value in named.items() if value is not None}
    return out


class Watch:
    """A sink that says now and then how far the rolling estimate is from the truth, and what force is missing."""

    def __init__(self, output: Output, truth: Mapping[str, float]) -> None:
        self._output, self._truth = output, truth
        self._rate_hz = 1.0
        self._due_s = list(TOLD_AT_S)
        self._places = ("bearing2.x", "bearing2.y")  # nothing is hidden there

    def start(self, session: Session) -> None:
        self._rate_hz = session.info.rate_hz

    def estimate(self, estimate: Estimate) -> None:
        seconds = estimate.index / self._rate_hz
        if not self._due_s or seconds < self._due_s[0] - 0.3:
            return
        self._due_s.pop(0)
        said = []
        for place in self._places:
            p, truth = estimate.parameters.get(f"{place}.kL"), self._truth[f"{place}.kL"]
            if p is not None and p.value is not None and p.sd is not None:
                off = 100 * (p.value / truth - 1)
                said.append(f"{place}.kL {p.value:.4g} +- {p.sd:.1g} N/m ({off:+.2f} % from the truth)")
        said.append(missing_text(estimate.extra or {}))
        self._output.say(f"  {seconds:4.1f} s   " + ("   ".join(filter(None, said)) or estimate.status))

    def readings(self, batch: Sequence[Reading]) -> None: ...
    def status(self, status: Status) -> None: ...
    def close(self) -> None: ...


def replay_demo(output: Output, log: Path) -> None:
    """Replay the log; CheckFailed if the estimates are others."""
    from daq.log.reader import read_log
    from daq.session.replay import replay_into

    summary = replay_into(read_log(log), check=True)
    if not summary.identical:
        raise CheckFailed(f"{log}: the replay does not give the logged estimates; please report this")
    output.say(f"replayed: all {summary.compared} logged estimates come again, bit for bit")


def _improve(output: Output, rig: Rig, truth: Rig, log: Path, out: Path) -> tuple[list[dict[str, Any]], list[Path]]:
    """Compare, diagnose, add, compare: the ladder of errors and the files written."""
    from daq.exchange.measurement import measure
    from estimator.diagnosis.comparison import compare
    from estimator.diagnosis.verdict import diagnose

    from .analyse import comparison_text, step
    from .diagnosis import diagnosis_text, layers_text, si_units

    data = measure(log, rig, output.note)
    output.say(Rule("3  compare"))
    before = _compared(output, compare, rig, data).to_json()
    output.say(*comparison_text(before))
    output.say(Rule("4  diagnose"))
    with output.progress("diagnosing") as progress:
        diagnosis = diagnose(rig.model, data.y, data.rate_hz, progress=progress).to_json()
    output.say(*layers_text(diagnosis, si_units(rig)), *diagnosis_text(diagnosis, most=3))
    steps = [step(rig, before)]
    verdict = diagnosis["verdict"]
    if verdict in ("complete", "unknown"):
        return steps, []
    output.say(Rule(f"5  add {verdict}"))
    top = diagnosis["ranking"][0]
    better = Rig.parse(with_effect(rig, verdict, top["at"]), rig.base, rig.path)
    found = _compared(output, compare, better, data)
    after = found.to_json()
    improved = out / "improved.toml"
    write_whole(improved, with_values(better, found.parameters))
    better = load_rig(improved)
    output.say(parameters_table(found.parameters, known_values(truth)), *comparison_text(after))
    steps.append(step(better, after))
    output.say(Rule("the error falls"), ladder_table(steps))
    facts = {"rig": rig.model.name} | data.facts
    shown = {"comparison": after, "before": before, "diagnoses": [diagnosis], "ladder": steps}
    return steps, [improved, *_pages(output, out, facts, shown, better.text, rig, data)]


def _pages(
    output: Output, out: Path, facts: Mapping[str, str], shown: Mapping[str, Any], rig_text: str, rig: Rig,
    data: Measurement,
) -> list[Path]:  # fmt: skip
    """The report and the recording for Rerun, as far as their libraries are there."""
    files = []
    if installed("matplotlib", "jinja2"):
        from daq.report.page import write_report
        from daq.report.signal_spectra import signal_spectra

        files.append(out / "report.html")
        signal = signal_spectra(rig.model, data.y, data.rate_hz, shown["diagnoses"][0])
        write_report(files[-1], "Rotorscope demo", facts=facts, rig_text=rig_text, signal=signal, **shown)
    else:
        output.note(missing_library("matplotlib", "report", "no report.html"))
    if installed("rerun"):
        from daq.report.rerun.comparison import log_comparison

        files.append(out / "comparison.rrd")
        log_comparison(str(files[-1]), title="Rotorscope demo", **shown)
    return files


def _compared(output: Output, compare: Any, rig: Rig, data: Measurement) -> Comparison:
    with output.progress("comparing") as progress:
        value: Comparison = compare(rig.model, data.y, data.rate_hz, progress=progress)
    return value
