"""The page of a trend: self-contained, with zoom and hover, to send to a colleague. No network; the script is in it.

charts : [{section, title, unit, lines, limits}], and of each line: name, i (number of the bin), v (mean), h (half of
the 95 % interval of one value, or None), lo and hi (extremes of the bin, or None), z (zone, or None).
events : [{time_ms, kind, name, text}], drawn as marks and listed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from daq.base.console import unfinished
from daq.base.console.output import finite, version
from daq.base.contract.errors import LogError

Json = Mapping[str, Any]
MAX_LISTED = 200  # events in the table, the newest


def write_trend(path: Path, title: str, **parts: Any) -> None:
    """Write the page that `render_trend` makes. Raises LogError if the file cannot be written."""
    try:
        unfinished.write(path, render_trend(title, **parts).encode())
    except OSError as problem:
        raise LogError(f"trend {path}: {problem.strerror or problem}; choose another --html file") from problem


def render_trend(
    title: str, *, facts: Mapping[str, str], first_ms: float, bin_ms: float, bins: int, charts: Sequence[Json],
    events: Sequence[Json], rows: Sequence[Sequence[str]], headings: Sequence[str], notes: Sequence[str] = (),
) -> str:  # fmt: skip
    """The page as text. rows, headings : of the table of all numbers; notes : said above the charts."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    folder = Path(__file__).parent
    template = environment.from_string((folder / "trend.html").read_text(encoding="utf-8"))
    data = {"first": first_ms, "bin": bin_ms, "bins": bins, "charts": list(charts), "events": list(events)}
    made = f"rotorscope {version()}, {datetime.now().astimezone():%Y-%m-%d %H:%M %Z}"
    sections = list(dict.fromkeys(chart["section"] for chart in charts))
    return template.render(
        title=title, facts=dict(facts) | {"made by": made}, notes=notes, rows=rows, headings=headings,
        sections=[(s, [(k, c) for k, c in enumerate(charts) if c["section"] == s]) for s in sections],
        events=list(reversed(events))[:MAX_LISTED], more=max(0, len(events) - MAX_LISTED),
        data=json.dumps(finite(data), allow_nan=False, separators=(",", ":")).replace("</", "<\\/"),
        script=(folder / "trend.js").read_text(encoding="utf-8"),
    )  # fmt: skip
