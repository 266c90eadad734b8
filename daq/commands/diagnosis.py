"""The bodies of diagnose and improve: what a record shows, and which effect a model lacks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

from estimator.effects import CATALOGUE
from estimator.errors import DataError
from estimator.results import NOT_CONCLUSIVE, NOT_JUDGED, RIG_FILE

if TYPE_CHECKING:
    from estimator.diagnosis.verdict import Improvement

from daq.analysis.answers import about, diagnosed, origin
from daq.base.console.fitting import FittingTable
from daq.base.console.output import Output, spare, write_whole
from daq.base.console.tables import ladder_table, number
from daq.base.contract.errors import ConfigError
from daq.base.contract.part import WHOLE_RECORD, Part
from daq.exchange.measurement import Measurement
from daq.report.layers import lines as layer_lines
from daq.report.signal_spectra import signal_spectra
from daq.report.words import is_of_the_model, message_text
from daq.rig.edit import of_channels, with_effect, with_values
from daq.rig.rig import Rig, load_rig

from .analyse import IN_USE, Pages, given, shown_compared, step

REASON_CODES = (NOT_JUDGED, "bearing_not_judged")  # said with the layers
_OUTSIDE_CATALOGUE = "the catalogue does not hold; type a law of your own into the rig file"
_NO_LAW = "is not a law of a bearing: see the notes, and correct what they name first"
RANKING_HEADINGS = (
    "effect", "at", "held-out gain", "p-value", "missing there [%]", "parameters", "detectable from",
)  # fmt: skip
BELOW_DETECTION = (
    'an effect weaker than "detectable from" cannot be seen in a record of this length and level; a record four times '
    "as long halves the limit"
)


def diagnose(
    output: Output, log: Path, rig_path: Path, html: Path | None, rerun: str | None, part: Part = WHOLE_RECORD
) -> None:
    pages = Pages(html, rerun)
    rig, data = given(output, log, rig_path, ("estimator.diagnosis.verdict", *IN_USE), part)
    with output.progress("diagnosing") as progress, about(log, data):
        value = diagnosed(rig, data, progress)
    if pages:
        _write_pages(output, pages, rig, data, value)
    people = [*layers_text(value, si_units(rig)), *diagnosis_text(value), *pages.said()]
    for row in value["ranking"]:
        for said in row.get("gates", ()):
            output.detail(f"{row['effect']}: {said}")
    output.result(value | origin(log, rig_path, rig, data), *people)


def _write_pages(output: Output, pages: Pages, rig: Rig, data: Measurement, value: Mapping[str, Any]) -> None:
    """The pictures of a diagnosis; of the model only where the bearings are judged."""
    parts: dict[str, Any] = {"diagnoses": [value], "signal": signal_spectra(rig.model, data.y, data.rate_hz, value)}
    if not value["bearing"]["judged"]:
        pages.write(rig, data, **parts)
        return
    now = shown_compared(output, rig, data)
    better = with_verdict(rig, value)
    try:
        after = None if better is None else shown_compared(output, better, data)
    except DataError:  # the verdict is of the signal, and no model of the bearings
        after = None
    if better is None or after is None:
        pages.write(rig, data, comparison=now, **parts)
    else:
        ladder = [step(rig, now), step(better, after)]
        pages.write(better, data, comparison=after, before=now, ladder=ladder, **parts)


def si_units(rig: Rig) -> dict[str, str]:
    """Channel -> SI unit."""
    return dict(zip((c.name for c in rig.model.channels), rig.si_units, strict=True))


def layers_text(value: Mapping[str, Any], units: Mapping[str, str]) -> list[Any]:
    """The layers of a diagnosis for people. units : channel -> SI unit."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, line in layer_lines(value, units):
        table.add_row(name, Text(line))
    return [table, ""]


def with_verdict(rig: Rig, diagnosis: Mapping[str, Any]) -> Rig | None:
    """The rig with the effect that a diagnosis names, as found; None if it names none."""
    row = next((r for r in diagnosis["ranking"] if r["effect"] == diagnosis["verdict"]), None)
    if row is None or diagnosis["verdict"] == RIG_FILE:
        return None
    values: dict[str, dict[str, dict[str, float]]] = {}  # by effect (of several lines each is one), by place
    for full, p in row["parameters"].items():
        if p["value"] is not None:
            place, effect, parameter = full.rsplit(".", 2)
            values.setdefault(effect, {}).setdefault(place, {})[parameter] = p["value"]
    try:
        for effect, own in (values or {row["effect"]: {}}).items():
            known = next((u.at for u in rig.model.effects if u.name == effect), ())
            new = [place for place in own if place not in known]
            text = with_effect(rig, effect, new or row["at"], {p: own[p] for p in new})
            rig = Rig.parse(text, rig.base, rig.path)
    except ConfigError:  # there already, and named again for another reason
        return None
    return rig


def diagnosis_text(value: Mapping[str, Any], most: int = 8) -> list[Any]:
    """A diagnosis for people."""
    from estimator.diagnosis.verdict import NO_LAW_CODES

    rows = []
    for row in value["ranking"][:most]:
        before, after = row["missing_force_before_percent"], row["missing_force_after_percent"]
        missing = f"{before:.2f} -> {after:.2f}" if before or after else ""  # of a tone or strikes it is unknown
        parameters = ", ".join(
            f"{k} {number(p['value'], p['sd'])} {p['unit'] if p['unit'] != '1' else ''}".rstrip()
            for k, p in row["parameters"].items()
            if p["identifiable"]
        )
        seen = row.get("detectable_from")
        limit = f"{number(seen['value'])} {seen['unit']}" if seen else ""
        cells = (row["effect"], ", ".join(row["at"]), f"{row['heldout_gain']:.5g}", _p(row["p_value"]),
                 missing, parameters, limit)  # fmt: skip
        rows.append(cells)
    table = FittingTable(headings=RANKING_HEADINGS, rows=rows, order=(4, 2, 3, 5, 1, 6), whole=frozenset({3, 4}))
    people: list[Any] = [table, ""] if rows else []
    shown = {finding["text"] for finding in value.get("record", {}).get("findings", ())}
    coded = zip(value.get("messages", ()), value.get("message_codes", repeat("")), strict=False)
    people += [f"note: {text}" for text, code in coded if text not in shown and code not in REASON_CODES]
    if value["verdict"] == "complete" and any("detectable_from" in row for row in value["ranking"]):
        people.append(BELOW_DETECTION)
    if value["verdict"] == "unknown" and value.get("shape"):
        shape = value["shape"]
        peak = max(map(abs, shape["force"]), default=0.0)
        where = f" at {shape['channel']}" if "channel" in shape else ""
        people.append(f"what is missing depends on {shape['against']}{where}, up to {peak:.3g} N; --html draws it")
    people += [value["separates"]] if value.get("separates") else []
    name = value["verdict"]
    known = f"rotorscope effects {name} says what to look at" if name in CATALOGUE else "rotorscope add puts it in"
    verdict = {
        "complete": "the model is complete: nothing in the catalogue earns its place",
        "unknown": message_text(value, {NOT_CONCLUSIVE})
        or f"something is missing that {_NO_LAW if message_text(value, NO_LAW_CODES) else _OUTSIDE_CATALOGUE}",
    }.get(name, f"{'missing' if is_of_the_model(value) else 'found in the signal'}: {name}; {known}")
    return [*people, f"verdict: {name}", _not_judged(value) or message_text(value, {RIG_FILE}) or verdict]


def _not_judged(value: Mapping[str, Any]) -> str:
    """Why nothing is named, where the bearings are not judged; else ""."""
    why = message_text(value, {NOT_JUDGED})
    return f"channels, tones and strikes name no fault, and {why}" if why else ""


def _p(value: float) -> str:
    """Beyond 1e-20 the figures mean nothing."""
    return "< 1e-20" if value < 1e-20 else f"{value:.2g}"


def improve(
    output: Output, log: Path, rig_path: Path, out: Path, html: Path | None, rerun: str | None,
    part: Part = WHOLE_RECORD,
) -> None:  # fmt: skip
    pages = Pages(html, rerun)
    spare(out)
    rig, data = given(output, log, rig_path, ("estimator.diagnosis.verdict.improvement", *IN_USE), part)
    from estimator.diagnosis.verdict import improve as improve_model

    with output.progress("improving") as progress, about(log, data):
        ladder = improve_model(rig.model, data.y, data.rate_hz, progress=progress)
    value = ladder.to_json()
    text, whole = improved(load_rig(rig_path), ladder)  # with the channels that were left out, too
    better = of_channels(whole, part.channels)
    write_whole(out, text)
    if pages:
        before = shown_compared(output, rig, data)
        now = shown_compared(output, better, data) if len(ladder.rungs) > 1 else None
        pages.write(
            better, data, comparison=now or before, before=now and before, ladder=value["ladder"],
            diagnoses=[d.to_json() for d in ladder.diagnoses], notes=value["messages"],
        )  # fmt: skip
    added = [u.name for u in better.model.effects if u.name not in [v.name for v in rig.model.effects]]
    said = f"added: {', '.join(added)}" if added else "nothing more is earned: the model stays as it is"
    notes = [f"note: {message.text}" for message in ladder.messages]
    people: list[Any] = [ladder_table(value["ladder"]), "", *notes, said, ending(ladder.last.to_json(), added)]
    people += [f"{out}: the improved rig file", *pages.said()]
    output.result(value | origin(log, rig_path, rig, data), *people)


def ending(last: Mapping[str, Any], added: Sequence[str] = ()) -> str:
    """Why an improvement stops, from its last diagnosis and what was added."""
    from estimator.diagnosis.verdict import NO_LAW_CODES

    verdict = last["verdict"]
    if verdict == "complete":
        return "the last model is complete: nothing of the catalogue predicts the record better than chance would"
    if text := message_text(last, {NOT_JUDGED, RIG_FILE, NOT_CONCLUSIVE}):
        return text
    if verdict == "unknown":
        laid = message_text(last, NO_LAW_CODES)
        return f"something is left: {laid}" if laid else f"something is left that {_OUTSIDE_CATALOGUE}"
    if verdict in added:  # the last that one run adds
        return "what the last model lacks was not examined: run improve again on the rig file that it wrote"
    return f"the last diagnosis names {verdict}, which was not added"


def improved(rig: Rig, ladder: Improvement) -> tuple[str, Rig]:
    """The rig file of a ladder's last model with its fitted values."""
    now = rig
    for use in ladder.model.effects:
        known = next((u for u in now.model.effects if u.name == use.name), None)
        new = [place for place in use.at if known is None or place not in known.at]
        if new:
            now = Rig.parse(with_effect(now, use.name, new), now.base, now.path)
    return (text := with_values(now, ladder.parameters)), Rig.parse(text, now.base, now.path)
