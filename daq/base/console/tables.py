"""Result tables for people: readable on a terminal and in a pipe."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from drivers.contract import Gap
from estimator.results import Parameter

from .fitting import FittingTable


def parameters_table(parameters: Mapping[str, Parameter], truth: Mapping[str, float] | None = None) -> FittingTable:
    """coefficient, value, unit, standard error, relative error, and the reason where a value is not identifiable."""
    headings = ["coefficient", "value", "std. error", "%", "unit", *([] if truth is None else ["truth", "off by"])]
    rows, remarks = [], []
    for name, p in parameters.items():
        known = [] if truth is None else _beside(p, truth.get(name))
        if p.value is None or not p.identifiable:
            cells = ["-", "-", "-", p.unit, *known]
            remarks.append(f"not identifiable: {p.reason or 'the data cannot tell'}")
        else:
            relative = "-" if not p.value or not p.sd else f"{100 * p.sd / abs(p.value):.2g}"
            cells = [number(p.value, p.sd), number(p.sd or None, p.sd), relative, p.unit, *known]
            remarks.append(p.reason)
        rows.append([name, *cells])
    order = [4, *((5, 6) if truth is not None else ()), 2, 3]  # the relative error gives way first
    if any(remarks):
        order.insert(-1, len(headings))
        headings.append("remark")
        rows = [[*row, remark] for row, remark in zip(rows, remarks, strict=True)]
    return FittingTable(
        headings=headings, rows=rows, order=order, right=frozenset({1, 2, 3, *((5, 6) if truth is not None else ())}),
        whole=frozenset({4}),
    )  # fmt: skip


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


def ladder_table(rows: list[dict[str, object]]) -> FittingTable:
    """Effects against held-out error and missing force, one row a model."""
    cells = []
    for row in rows:
        missing = row["missing_force_percent"]
        effects = row["effects"]
        names = ", ".join(str(e) for e in effects) if isinstance(effects, list) else str(effects)
        low, value, high = (missing[k] for k in ("low", "value", "high")) if isinstance(missing, dict) else (0, 0, 0)
        interval = f"{low:.2f} to {high:.2f}"
        cells.append([names or "nothing else", f"{row['heldout_nll']:.5f}", f"{value:.2f}", interval])
    headings = ("model: linear and", "held-out error [nats/sample]", "missing force [%]", "interval")
    return FittingTable(headings=headings, rows=cells, order=(2, 1, 3), right=frozenset({1, 2, 3}))
