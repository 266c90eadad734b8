"""The body of severity: the first numbers of a record, channel by channel, and pictures of its spectra."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from daq.analysis.answers import about, measured, origin, severity_document
from daq.base.console.fitting import FittingTable
from daq.base.console.output import Output
from daq.base.contract.part import WHOLE_RECORD, Part
from daq.exchange.measurement import Measurement
from daq.report.first_numbers import band_rows, severity_rows, void_lines, with_severity, zone_line
from daq.rig.rig import Rig

from .analyse import Pages, given


def severity(
    output: Output, log: Path, rig_path: Path, html: Path | None, rerun: str | None, part: Part = WHOLE_RECORD
) -> None:
    pages = Pages(html, rerun)
    rig, data = given(output, log, rig_path, ("estimator.identification.record",), part)
    with output.progress("measuring"), about(log, data):
        survey, levels = measured(rig, data)
    value = severity_document(rig, survey, levels)
    channels, machine, findings = (value[key] for key in ("channels", "iso20816", "findings"))
    said = [line for line in (zone_line(channels, machine),) if line]
    voids = void_lines(channels)
    if pages:
        record = with_severity(survey.to_json(), levels)
        _write_pages(pages, rig, data, record, [line[0].upper() + line[1:] for line in (*said, *voids)])
    people: list[Any] = [cells_table(*severity_rows(channels)), ""]
    if (rows := band_rows(channels))[1]:
        people += [cells_table(*rows), ""]
    people += [f"note: {f['text']}" for f in findings if not any(f["text"] in line for line in voids)]
    people += [*voids, *said]
    output.result(value | origin(log, rig_path, rig, data), *people, *pages.said())


def cells_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> FittingTable:
    """A table of numbers: the first column is a name, the last ones give way first."""
    numbers = range(1, len(headings))
    return FittingTable(headings=headings, rows=rows, order=list(numbers), right=frozenset(numbers))


def _write_pages(pages: Pages, rig: Rig, data: Measurement, record: dict[str, Any], said: Sequence[str]) -> None:
    """Spectra with the tones and strike trains of the record, by order of the shaft where its speed is known."""
    from daq.report.signal_spectra import signal_spectra
    from estimator.identification.machine import survey_machine

    machine = survey_machine(rig.model, data.y, data.rate_hz).to_json()
    seen = {"record": record, "machine": machine, "said": said}
    pages.write(rig, data, signal=signal_spectra(rig.model, data.y, data.rate_hz, seen), seen=seen)
