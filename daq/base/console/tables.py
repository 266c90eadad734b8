"""Result tables for people: readable on a terminal and in a pipe."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from rich.table import Table
from rich.text import Text

from drivers.contract import Gap
from estimator.results import Parameter


def parameters_table(parameters: Mapping[str, Parameter], truth: Mapping[str, float] | None = None) -> Table:
    """coefficient, value, unit, standard error, relative error, and why not where the data cannot tell."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column("coefficient", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("std. error", justify="right", no_wrap=True)
    table.add_column("%", justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    if truth is not None:
        table.add_column("truth", justify="right", no_wrap=True)
        table.add_column("off by", justify="right", no_wrap=True)
    table.add_column("", overflow="fold")
    for name, p in parameters.items():
        known = [] if truth is None else _beside(p, truth.get(name))
        if p.value is None or not p.identifiable:
            cells = ["-", "-", "-", p.unit, *known]
            remark = Text(f"not identifiable: {p.reason or 'the data cannot tell'}", style="yellow")
        else:
            relative = "-" if not p.value or not p.sd else f"{100 * p.sd / abs(p.value):.2g}"
            cells = [number(p.value, p.sd), number(p.sd or None, p.sd), relative, p.unit, *known]
            remark = Text(p.reason)
        table.add_row(Text(name), *(Text(c) for c in cells), remark)
    return table


def _beside(p: Parameter, truth: float | None) -> list[str]:
    if truth is None:
        return ["", ""]
    off = "" if p.value is None or not truth else f"{100 * (p.value / truth - 1):+.2g} %"
    return [f"{truth:.4g}", off]


def number(value: float | None, sd: float | None = None) -> str:
    """A value with as many digits as its standard deviation supports (two digits of it), at most six."""
    if value is None:
        return "-"
    digits = 4
    if sd and value:
        from math import floor, log10

        digits = min(6, max(2, floor(log10(abs(value))) - floor(log10(abs(sd))) + 2))
    return f"{value:.{digits}g}"


def gap_lines(gaps: Sequence[Gap], first: int = 0, rate_hz: float | None = None, most: int = 10) -> list[str]:
    """One line for each gap, the first few of them."""
    real = [g for g in gaps if g.count]
    lines = []
    for g in real[:most]:
        at = "" if rate_hz is None else f", t = {(g.index - first) / rate_hz:.6g} s"
        lines.append(f"gap: {g.count} samples from index {g.index} on{at} ({g.reason})")
    return [*lines, f"... and {len(real) - most} more gaps"] if len(real) > most else lines


def gap_reasons(gaps: Sequence[Gap]) -> str:
    """How many gaps by which reason: "3 gaps: 2 by crc, 1 by reconnect"."""
    reasons = Counter(g.reason for g in gaps if g.count)
    named = ", ".join(f"{n} by {reason}" for reason, n in reasons.items())
    total = sum(reasons.values())
    return f"{total} gap{'s' if total != 1 else ''}: {named}"


def ladder_table(rows: list[dict[str, object]]) -> Table:
    """Effects against held-out error and missing force, one row a model."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column("model: linear and", overflow="fold")
    for heading in ("held-out error [nats/sample]", "missing force [%]", "interval"):
        table.add_column(Text(heading), justify="right", no_wrap=True)
    for row in rows:
        missing = row["missing_force_percent"]
        effects = row["effects"]
        names = ", ".join(str(e) for e in effects) if isinstance(effects, list) else str(effects)
        low, value, high = (missing[k] for k in ("low", "value", "high")) if isinstance(missing, dict) else (0, 0, 0)
        table.add_row(
            Text(names or "nothing else"), f"{row['heldout_nll']:.5f}", f"{value:.2f}", f"{low:.2f} to {high:.2f}"
        )
    return table
