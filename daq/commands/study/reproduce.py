"""`rotorscope reproduce OUT/`: sections 5 and 6 of Tiwari and Vyas (1997) on the paper's rig.

The protocol of section 5: parameters in, eq. (8) integrated by an exponential Runge-Kutta rule under broad-band
Gaussian forces at the two caps, histogram, eq. (36), parameters out, compare; both directions. Twice: with the rig's
own shaft, and with a shaft as stiff as the bearings, the only one with which the masses can come out. Section 6: the
bearing by Hertz's theory.
What agrees and what cannot be known from the paper is in docs/paper.md.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from estimator.identification.moments import plane_diagnostics
from estimator.model import Theory, theory
from estimator.results import Fit
from estimator.simulation import stationarity

from .reproduce_cases import (
    BOOTSTRAP_REPLICATES,
    CAP_KG,
    PAPER_METHODS,
    RATE_HZ,
    RECORD_SECONDS,
    SOFT_SHAFT,
    Case,
    Row,
    estimates,
    paper_model,
    plane_of,
    run_case,
)


def section6(rows: list[Row], case: str) -> Theory:
    """Hertz theory of the bearing beside the stiffness that eq. (36) gave (masses given, response form)."""
    from estimator.results import Parameter

    found: dict[str, Parameter] = {}
    for row in rows:
        if (row.case, row.masses, row.method) == (case, "given", PAPER_METHODS[1]) and row.parameter.endswith(
            ("kL", "kNL")
        ):
            name = row.parameter.replace(".kNL", ".cubic.kNL")
            known = row.value is not None
            found[name] = Parameter(
                value=row.value, sd=row.sd, unit=row.unit, identifiable=known, reason="" if known else "over 50 %"
            )
    model, _ = paper_model(SOFT_SHAFT)
    return theory(model, Fit(found, None, 0, "fokker-planck"))


def reproduce(
    out_dir: Path,
    progress: Callable[[float], None] | None = None,
    seconds: float = RECORD_SECONDS,
    seed: int = 1,
    replicates: int = BOOTSTRAP_REPLICATES,
) -> dict[str, Any]:
    """Write figures 4-19 (PNG), tables 1-3 and index.html, numbers.json into `out_dir`; returns the numbers.

    progress : called with the share that is done, 0 to 1. seconds : of each of the two simulated records.
    replicates : of the bootstrap.
    """
    from .reproduce_figures import draw_all
    from .reproduce_page import write_page

    report = progress or (lambda done: None)
    out_dir.mkdir(parents=True, exist_ok=True)
    plan = (
        ("rig", "the rig's own shaft, ks/kL = 0.016", SOFT_SHAFT),
        ("strong", "a shaft as stiff as a bearing, ks = 10 N/µm", 10.0e6),
    )
    cases = []
    for k, (name, title, shaft) in enumerate(plan):
        cases.append(
            run_case(name, title, shaft, seconds, seed + k, lambda d, k=k: report((k + d) * 0.22))  # type: ignore[misc]
        )
    rows: list[Row] = []
    work = [(case, direction, known) for case in cases for direction in CAP_KG for known in (False, True)]
    for k, (case, direction, known) in enumerate(work):
        rows += estimates(case, direction, known, replicates)
        report(0.44 + 0.4 * (k + 1) / len(work))
    hertz = section6(rows, "rig")
    numbers = {
        "schema": 1,
        "seconds": seconds,
        "rate_hz": RATE_HZ,
        "seed": seed,
        "cases": [_described(case) for case in cases],
        "tables": {
            "1": [r.to_json() for r in rows if r.direction == "x"],
            "2": [r.to_json() for r in rows if r.direction == "y"],
            "3": hertz.table(),
        },
        "K_n": hertz.K_n,
        "kinematics": dict(hertz.kinematics),
    }
    figures = draw_all(out_dir, cases, rows, hertz)
    report(0.97)
    write_page(out_dir, numbers, figures, cases)
    (out_dir / "numbers.json").write_text(json.dumps(numbers, indent=1, allow_nan=False) + "\n")
    report(1.0)
    return numbers


def _described(case: Case) -> dict[str, Any]:
    condition = stationarity(case.model)
    checks = []
    for direction in CAP_KG:
        for d in plane_diagnostics(plane_of(case, direction, True), case.x[direction], case.v[direction]):
            checks.append({"name": d.name, "value": d.value, "expected": d.expected, "sd": d.sd})
    return {
        "name": case.name,
        "title": case.title,
        "ks": case.model.shaft_stiffness,
        "temperature_J": case.temperature,
        "samples": len(case.x["x"]),
        "condition_mismatch": condition.mismatch,
        "diagnostics": checks,
    }
