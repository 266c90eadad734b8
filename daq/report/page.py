"""One self-contained HTML page of a comparison, a diagnosis or an improvement.

The page needs no network and no script; pictures are inline SVG. It works from the `to_json()` of the results
(contract.md), whose further keys it draws where they are there, all in SI units:

comparison
    curves : [{channel, against, at, force, band_low, band_high}], residual force in N with its 95 % band, `at` in m,
        m/s, deg ... (AXIS_OF_STATE)
    laws : [{channel, against, at, measured, band_low, band_high, model}], restoring force without a straight line
    spectra : {channel: {frequency_hz, measured, model}}, one-sided PSD in the channel's unit squared per Hz
    densities : {channel: {at, measured, model}}, of the displacement in m, 1/m
    orbits : {bearing: {measured: [x, y], model: [x, y]}}, displacements in m
    parameters : as in `fit`; messages : [text]
signal
    spectra : {channel: {frequency_hz, psd, unit, marks: [[Hz, label]]}}, measured; envelopes : the squared envelope in
        `band_hz`, its PSD with marks at the defect frequencies; modes : as in a diagnosis
diagnosis
    shape : with band_low, band_high; separates : text, what separates the verdict from the runner-up; messages : [text]
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from daq.base.console import unfinished
from daq.base.console.output import version
from daq.base.contract.errors import LogError

from . import curves as curves
from . import figures as figures
from . import layers as layers
from . import numbers as numbers
from . import signal_figures as signal_figures
from . import words as words

Json = Mapping[str, Any]
NO_RESULT: Json = {}
MIN_RANKING_ROWS, MAX_RANKING_ROWS = 3, 10  # rows of the ranking that are shown


def write_report(path: Path, title: str, **parts: Any) -> None:
    """Write the page that `render` makes of the same arguments. Raises LogError if the file cannot be written."""
    page = render(title, **parts)
    try:
        unfinished.write(path, page.encode())
    except OSError as problem:
        raise LogError(f"report {path}: {problem.strerror or problem}; choose another --html file") from problem


def render(
    title: str,
    *,
    facts: Mapping[str, str] = NO_RESULT,
    comparison: Json | None = None,
    before: Json | None = None,
    signal: Json = NO_RESULT,
    diagnoses: Sequence[Json] = (),
    ladder: Sequence[Json] = (),
    notes: Sequence[str] = (),
    seen: Json = NO_RESULT,
    rig_text: str = "",
) -> str:
    """The page as text.

    signal : measured spectra; comparison : of the model as it is now, None where no model of the bearings is judged;
    before : of the first model, without additions; diagnoses : of every model of the ladder, in order; notes : of
    the improvement; seen : layers of a record without a comparison, and its messages `said`; facts :
    log, rig, length of the record ... as the head of the page shows them.
    """
    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.globals |= {
        "number": numbers.number,
        "fixed": numbers.fixed,
        "odds": numbers.odds,
        "percent": numbers.percent,
        "parameter": numbers.parameter,
        "listed": words.listed,
        "detectable": words.detectable,
        "model_name": figures.model_name,
    }
    template = environment.from_string(Path(__file__).with_name("report.html").read_text(encoding="utf-8"))
    now, old = comparison or NO_RESULT, before or NO_RESULT
    said = [*now.get("messages", ()), *notes, *(m for d in diagnoses for m in d.get("messages", ()))]
    return template.render(
        title=title,
        facts=dict(facts) | {"made by": f"rotorscope {version()}, {datetime.now().astimezone():%Y-%m-%d %H:%M %Z}"},
        summary=words.summary(comparison, diagnoses, ladder) or list(seen.get("said", ())),
        pictures=pictures(now, old, ladder, before is not None) | signal_figures.pictures(signal),
        layers=layers.lines(diagnoses[0] if diagnoses else seen, measured_units(signal)),
        comparison=comparison,
        heading_of_map=words.heading_of_map(comparison),
        where=words.regions(before, comparison),
        findings=[finding(d, k, len(diagnoses), ladder) for k, d in enumerate(diagnoses)],
        ladder=ladder,
        messages=list(dict.fromkeys(said)),
        parameters=now.get("parameters", {}),
        rig_text=rig_text,
    )


def pictures(now: Json, old: Json, ladder: Sequence[Json], two: bool) -> dict[str, str | None]:
    """SVG by name, None where there is nothing to show. two : whether there is a model before."""
    return {
        "ladder": figures.ladder(ladder) if ladder else None,
        "laws": curves.laws(now.get("laws", ()), old.get("laws", ())),
        "residuals": curves.residuals(now.get("curves", ()), old.get("curves", ())),
        "where": figures.where_map(now.get("where", ()), old.get("where", ()) if two else None, looked_at(old, now)),
        "spectra": figures.spectra(now.get("spectra", {}), old.get("spectra", {}), now.get("psd_distance_db", {})),
        "densities": figures.densities(now.get("densities", {}), old.get("densities", {}), now.get("pdf_distance", {})),
        "orbits": figures.orbits(now.get("orbits", {})),
    }


def measured_units(signal: Json) -> dict[str, str]:
    """Channel -> SI unit of those with a measured spectrum."""
    return {name: s["unit"] for name, s in signal.get("spectra", {}).items()}


def looked_at(*comparisons: Json) -> list[str]:
    """The channels of comparisons. A model with a sensor fault draws no laws for a clipped channel."""
    return list(dict.fromkeys(c["channel"] for one in comparisons for c in one.get("curves", ())))


def finding(diagnosis: Json, number: int, of: int, ladder: Sequence[Json]) -> dict[str, Any]:
    """Content of the page for one diagnosis. number : on the ladder, from 0."""
    past = number + 1 < len(ladder)
    rows = worth_showing(diagnosis)
    now = "What is left" if number else "What is missing"
    heading = "What was missing" if past else now if words.is_of_the_model(diagnosis) else "What was found"
    return {
        "heading": heading + (f": step {number + 1}" if past and of > 2 else ""),
        "model": figures.model_name(ladder[number]["effects"]) if number < len(ladder) else "",
        "past": past,
        "diagnosis": diagnosis,
        "verdict": diagnosis["verdict"],
        "effect": described(diagnosis["verdict"]),
        "ranking": rows,
        "runner_up": words.runner_up(diagnosis) if diagnosis["ranking"] else None,
        # of an improvement, those of the last model: missing effects may have hidden them before
        "limits": [r for r in diagnosis["ranking"] if r.get("detectable_from")] if number == of - 1 else [],
        "picture": figures.ranking(rows, number) if rows else None,
        "shape": curves.shape(diagnosis["shape"], number) if diagnosis.get("shape") else None,
    }


def worth_showing(diagnosis: Json) -> list[Json]:
    """The first few effects of the ranking, and those after them that gain anything."""
    rows = list(diagnosis["ranking"])[:MAX_RANKING_ROWS]
    return [r for k, r in enumerate(rows) if k < MIN_RANKING_ROWS or r["heldout_gain"] > 1.0]


def described(verdict: str) -> Any:
    """The catalogue's entry of a verdict; None if it is not an effect of the catalogue."""
    from estimator.effects import CATALOGUE

    return CATALOGUE.get(verdict)
