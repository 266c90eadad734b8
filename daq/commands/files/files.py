"""`rotorscope info` and `rotorscope recover`: what is in a log, and mending one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from daq.base.console.output import Output
from daq.base.console.tables import gap_lines, gap_reasons
from daq.base.contract.dates import utc_text
from daq.base.contract.errors import ConfigError, LogError
from daq.base.contract.part import WHOLE_RECORD, Part
from daq.log.reader import Recording, read_log
from daq.report.first_numbers import void_lines
from daq.report.layers import lines
from daq.rig.edit import of_channels
from daq.rig.rig import Rig
from drivers.contract import Notice

MOST_LINES = 10
SURVEYED_VALUES = 4_000_000  # samples of all channels in a log that is looked at: 3 s of computing


def info(output: Output, log: Path, part: Part = WHOLE_RECORD) -> None:
    from .facts import info as facts

    recording = read_log(log, part=part)
    found, levels = _looked_at(recording)
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for heading, text in _rows(recording) + [
        ("channels' faults" if not k else "", t) for k, (_, t) in enumerate(found)
    ]:
        table.add_row(heading, Text(text))
    if levels:
        units = {name: own["unit"] for name, own in levels.items()}
        said = [line for _, line in lines({"record": {"channels": levels, "findings": ()}}, units)]
        said += void_lines({n: own | {"void": {k: t for k, t in own["void"].items() if k not in ("bands", "zone")}}
                            for n, own in levels.items()})  # fmt: skip
        for k, line in enumerate(said):
            table.add_row("levels" if not k else "", Text(line))
    value = (
        facts(recording) | {"severity": levels} | {"findings": [{"code": code, "text": text} for code, text in found]}
    )
    output.result(value, table)


def _looked_at(log: Recording) -> tuple[list[tuple[str, str]], dict[str, Any]]:
    """Findings that make the record unfit to be judged, beyond its notices; and severity by channel.

    They use the rig file of the log. A long log gives none.
    """
    from daq.log.rig_samples import rig_samples
    from estimator.identification.record import severity, survey_record

    if log.n_samples * len(log.channels) > SURVEYED_VALUES or log.lost_samples > 10 * log.n_samples:
        return [], {}
    try:
        whole = Rig.parse(log.rig_text, attached=log.attachments)
        rig = of_channels(whole, log.channels if log.info is not log.device_info else ())
        y, full_scale = rig_samples(log, rig, lambda text: None)
    except (ConfigError, LogError):  # no rig file, or one of another record
        return [], {}
    survey = survey_record(rig.model, y, log.rate_hz)
    levels = severity(rig.model, y, log.rate_hz, survey, full_scale)
    said = {notice.code for notice in log.notices}
    found = [(f.code, f.text) for f in survey.findings if f.code not in said]
    return found, {name: own.to_json() for name, own in levels.items()}


def _rows(log: Recording) -> list[tuple[str, str]]:
    rows = [
        ("started", "not known: its source says no date" if log.started_ns is None else utc_text(log.started_ns)),
        ("length", f"{log.seconds:.6g} s, {log.n_samples} samples of each channel at {log.rate_hz:g} Hz"),
        ("channels", ", ".join(f"{s.name} [{s.unit}]" for s in log.info.signals)),
    ]
    if log.from_s is not None:
        rows.insert(2, ("part", f"from {log.from_s:.6g} s on; the rest of the log is not read, and not checked"))
    if log.lost_samples:
        rows.append(("lost", f"{log.lost_samples} samples in {gap_reasons(log.gaps)}"))
        rows += [("", line) for line in gap_lines(log.gaps, log.first, log.rate_hz)]
    else:
        rows.append(("lost", "nothing"))
    rows += [("changed", f"{other}, no continuation of the rest") for other in log.others[:MOST_LINES]]
    if log.growing:
        rows.append(("complete", "not yet: it is being written"))
    else:
        rows.append(("complete", "yes" if log.complete else "no: `rotorscope recover LOG --out LOG2` saves the rest"))
        rows += [("damage", text) for text in log.damage[:MOST_LINES]]
    if log.clock is not None:
        drift, bound_ms = log.clock.drift_ppm, log.clock.bound_ns * 1e-6
        rows.append(("clock", f"{drift:+.2f} ppm; a sample's time on the host's clock is known to {bound_ms:.3g} ms"))
    if log.estimates:
        last = log.estimates[-1].estimate
        rows.append(("estimates", f"{len(log.estimates)}, the last of {len(last.parameters)} parameters"))
    rows += _notices(log.notices)
    rows.append(("attachments", ", ".join(log.attachments) or "none"))
    rows.append(("made by", ", ".join(f"{k} {v}" for k, v in log.metadata.items())))
    return rows


def _notices(notices: Sequence[Notice]) -> list[tuple[str, str]]:
    """Count and last text of each kind of notice; warnings and errors first."""
    last = {n.code: n for n in notices}
    often = Counter(n.code for n in notices)
    kinds = sorted(last.values(), key=lambda n: n.level == "info")
    times = {code: f" ({count} times)" if count > 1 else "" for code, count in often.items()}
    lines = [f"{n.level}: {(n.text.splitlines() or [''])[0]}{times[n.code]}" for n in kinds[:MOST_LINES]]
    if len(kinds) > MOST_LINES:
        lines.append(f"and {len(kinds) - MOST_LINES} other kinds: --json has them")
    return list(zip(["notices"] + [""] * len(lines), lines, strict=False))


def recover(output: Output, log: Path, out: Path) -> None:
    from daq.log.recover import recover as mend

    with output.progress(f"recovering {log.name}") as progress:
        saved = mend(log, out, progress, output.note)
    text = f"{out}: {saved.samples} samples ({saved.seconds:.3f} s) recovered; lost: {saved.lost}"
    output.result(saved.to_json(), text)
