"""One self-contained HTML page of a comparison, a diagnosis, an improvement: to send to a colleague.

The page needs no network and no script; pictures are inline SVG. It works from the `to_json()` of the results
(contract.md), whose further keys it draws where they are there, all in SI units:

comparison
    curves : [{channel, against, at, force, band_low, band_high}], residual force in N with its 95 % band, `at` in m,
        m/s, deg ... (report_figures.AGAINST)
    spectra : {channel: {frequency_hz, measured, model}}, one-sided PSD in the channel's unit squared per Hz
    densities : {channel: {at, measured, model}}, of the displacement in m, 1/m
    orbits : {bearing: {measured: [x, y], model: [x, y]}}, displacements in m
    parameters : as in `fit`; messages : [text]
diagnosis
    shape : with band_low, band_high; separates : text, what tells the verdict from the runner-up; messages : [text]
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from . import report_figures as figures
from . import report_numbers as numbers
from . import report_words as words
from .errors import LogError

Json = Mapping[str, Any]
NOTHING: Json = {}
FEWEST, MOST = 3, 10  # rows of the ranking that are shown


def write_report(
    path: Path,
    title: str,
    *,
    facts: Mapping[str, str] = NOTHING,
    comparison: Json | None = None,
    before: Json | None = None,
    diagnosis: Json | None = None,
    ladder: Sequence[Json] = (),
    rig_text: str = "",
) -> None:
    """Write the page. Raises LogError if the file cannot be written.

    comparison : of the model as it is now; before : of the model before anything was added; facts : log, rig, length
    of the record ... as the head of the page shows them.
    """
    page = render(
        title, facts=facts, comparison=comparison, before=before, diagnosis=diagnosis, ladder=ladder, rig_text=rig_text
    )
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as problem:
        raise LogError(f"report {path}: {problem.strerror or problem}; choose another --html file") from problem


def render(
    title: str,
    *,
    facts: Mapping[str, str] = NOTHING,
    comparison: Json | None = None,
    before: Json | None = None,
    diagnosis: Json | None = None,
    ladder: Sequence[Json] = (),
    rig_text: str = "",
) -> str:
    """The page as text."""
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
    now, old = comparison or NOTHING, before or NOTHING
    return template.render(
        title=title,
        facts=dict(facts) | {"made by": f"rotorscope {version()}, {datetime.now().astimezone():%Y-%m-%d %H:%M %Z}"},
        summary=words.summary(comparison, diagnosis, ladder),
        pictures=pictures(now, old, diagnosis, ladder),
        comparison=comparison,
        diagnosis=diagnosis,
        ladder=ladder,
        ranking=worth_showing(diagnosis),
        limits=[r for r in diagnosis["ranking"] if r.get("detectable_from")] if diagnosis else [],
        runner_up=words.runner_up(diagnosis) if diagnosis and diagnosis["ranking"] else None,
        effects=described(diagnosis),
        messages=[*now.get("messages", ()), *(diagnosis or NOTHING).get("messages", ())],
        parameters=now.get("parameters", {}),
        rig_text=rig_text,
    )


def pictures(now: Json, old: Json, diagnosis: Json | None, ladder: Sequence[Json]) -> dict[str, str | None]:
    """SVG by name, None where there is nothing to show."""
    ranking = worth_showing(diagnosis)
    return {
        "ladder": figures.ladder(ladder) if ladder else None,
        "residuals": figures.residuals(now.get("curves", ()), old.get("curves", ())),
        "where": figures.where_map(now.get("where", ()), old.get("where", ())),
        "spectra": figures.spectra(now.get("spectra", {}), old.get("spectra", {}), now.get("psd_distance_db", {})),
        "densities": figures.densities(now.get("densities", {}), old.get("densities", {}), now.get("pdf_distance", {})),
        "orbits": figures.orbits(now.get("orbits", {})),
        "ranking": figures.ranking(ranking) if ranking else None,
        "shape": figures.shape(diagnosis["shape"]) if diagnosis and diagnosis.get("shape") else None,
    }


def worth_showing(diagnosis: Json | None) -> list[Json]:
    """The first few effects of the ranking, and those after them that gain anything."""
    rows = list(diagnosis["ranking"])[:MOST] if diagnosis else []
    return [r for k, r in enumerate(rows) if k < FEWEST or r["heldout_gain"] > 1.0]


def described(diagnosis: Json | None) -> dict[str, Any]:
    """The catalogue's entry of every effect that the ranking shows."""
    if diagnosis is None:
        return {}
    from estimator.effects import CATALOGUE

    return {r["effect"]: CATALOGUE[r["effect"]] for r in diagnosis["ranking"][:MOST] if r["effect"] in CATALOGUE}


def version() -> str:
    try:
        return metadata.version("rotorscope")
    except metadata.PackageNotFoundError:
        return "(not installed)"
