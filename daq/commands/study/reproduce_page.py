"""index.html of `rotorscope reproduce`: tables 1-3 and figures 4-19 on one page."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .reproduce_cases import Case

PAGE_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1d1d1d; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; } h3 { font-size: 1rem; }
table { border-collapse: collapse; font-size: 0.85rem; margin: 0.6rem 0 1.2rem; }
th, td { padding: 0.25rem 0.7rem; text-align: right; border-bottom: 1px solid #e2e2e2; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
thead th { border-bottom: 1.5px solid #777; vertical-align: bottom; }
td.none { color: #8a5a00; } figure { margin: 1.2rem 0; } img { max-width: 100%; } figcaption { color: #444; }
.wide { overflow-x: auto; }
"""
UNIT_OF_PARAMETER = {"kL": (1e-6, "N/µm"), "kNL": (1e-18, "N/µm³"), "lambda": (1e-12, "1/µm²"), "mu": (1.0, "")}


def _cell(row: Mapping[str, Any] | None, scale: float) -> str:
    if row is None:
        return "<td></td>"
    if row["value"] is None:
        return '<td class="none">not identifiable</td>'
    error = 100.0 * (row["value"] / row["true"] - 1.0)
    return f"<td>{row['value'] * scale:.4g} &plusmn; {1.96 * row['sd'] * scale:.2g} ({error:+.1f} %)</td>"


def estimate_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """One case, one direction: parameters down, methods across, value +- 95 % half-width (error)."""
    methods = list(dict.fromkeys(r["method"] for r in rows))
    parameters = list(dict.fromkeys(r["parameter"] for r in rows))
    head = "".join(f"<th>{html.escape(m)}</th>" for m in methods)
    body = []
    for parameter in parameters:
        here = {r["method"]: r for r in rows if r["parameter"] == parameter}
        scale, unit = UNIT_OF_PARAMETER[parameter.rsplit(".", 1)[1]]
        true = next(iter(here.values()))["true"] * scale
        cells = "".join(_cell(here.get(m), scale) for m in methods)
        name = f"{html.escape(parameter)}{', ' + unit if unit else ''}"
        body.append(f"<tr><td>{name}</td><td>{true:.4g}</td>{cells}</tr>")
    return (
        f'<div class="wide"><table><thead><tr><th>parameter</th><th>in</th>{head}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _number(value: Any) -> str:
    if value is None:
        return "<td></td>"
    return f"<td>{html.escape(value)}</td>" if isinstance(value, str) else f"<td>{value:.4g}</td>"


def theory_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Table 3: theory by preload, the fitted caps below at the preload that they imply."""
    heads = {
        "row": "",
        "preload_um": "preload, µm",
        "kL_N_per_mm": "kL, N/mm",
        "kNL_N_per_mm3": "kNL, N/mm³",
        "tangent_k0": "tangent k0, N/mm",
        "tangent_k2": "k2, N/mm³",
        "secant_k0": "secant k0, N/mm",
        "secant_k2": "k2, N/mm³",
    }
    head = "".join(f"<th>{h}</th>" for h in heads.values())
    body = "".join("<tr>" + "".join(_number(r.get(key)) for key in heads) + "</tr>" for r in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def write_page(out: Path, numbers: Mapping[str, Any], figures: Mapping[int, str], cases: Sequence[Case]) -> None:
    """Write index.html beside the figures."""
    parts = [
        "<h1>Tiwari and Vyas (1997), sections 5 and 6, on this rig</h1>",
        f"<p>Parameters in, {numbers['seconds']:g} s simulated at {numbers['rate_hz']:g} Hz "
        "(exponential Runge-Kutta, force held over the step), histogram, eq. (36), parameters out. "
        "Value, half-width of the 95 % interval, error in per cent. "
        "The numbers that go in are this project's: those of the paper did not survive in the copy at hand "
        "(docs/paper.md).</p>",
    ]
    for number, direction, word in (("1", "x", "vertical"), ("2", "y", "horizontal")):
        parts.append(f"<h2>Table {number}. Parameters in and out, {word} direction ({direction})</h2>")
        for case in cases:
            for given in ("unknown", "given"):
                rows = [r for r in numbers["tables"][number] if r["case"] == case.name and r["masses"] == given]
                parts.append(f"<h3>{html.escape(case.title)}; masses {given}</h3>")
                parts.append(estimate_table(rows))
    parts.append("<h2>Table 3. Theory of the bearing, and what eq. (36) gave</h2>")
    parts.append(f"<p>K_n = {numbers['K_n'] / 10**4.5:.4g} N/mm<sup>1.5</sup>.</p>")
    parts.append(theory_table(numbers["tables"]["3"]))
    parts.append("<h2>Figures</h2>")
    for n, caption in figures.items():
        parts.append(
            f'<figure><img src="figure_{n:02d}.png" alt="{html.escape(caption)}">'
            f"<figcaption>Figure {n}. {html.escape(caption)}.</figcaption></figure>"
        )
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Rotorscope: the paper reproduced</title>'
        f"<style>{PAGE_STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )
    (out / "index.html").write_text(page, encoding="utf-8")
