"""A JSON document of an analysis as rows of the tables of parameters, verdicts and severity."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

Document = Mapping[str, Any]
Rows = dict[str, list[dict[str, Any]]]  # table -> rows
NO_EVIDENCE = 1.0  # p-value of a record in which no candidate came as far as a test


def rows_of(analysis: str, document: Document) -> Rows:
    """The rows of a document, without the columns that say of which run they are."""
    return _ROWS_OF_ANALYSIS[analysis](document)


def _severity(document: Document) -> Rows:
    columns = ("unit", "rms", "peak", "crest", "kurtosis", "velocity_rms_mm_s", "displacement_rms_um", "zone")
    channels = document["channels"]
    return {"severity": [{"channel": name} | {c: own[c] for c in columns} for name, own in channels.items()]}


def _fit(document: Document) -> Rows:
    columns = ("value", "sd", "unit", "identifiable")
    found = document["parameters"]
    return {"parameters": [{"name": name} | {c: own[c] for c in columns} for name, own in found.items()]}


def _compare(document: Document) -> Rows:
    row = {key: document[key] for key in ("adequate", "heldout_nll", "reference_nll")}
    return {"verdicts": [row | _missing(document["missing_force_percent"])]}


def _missing(force: Document) -> dict[str, float]:
    names = {"value": "missing_force_percent", "low": "missing_force_low", "high": "missing_force_high"}
    return {name: force[key] for key, name in names.items()}


def _diagnose(document: Document) -> Rows:
    """p_value : of the candidate that is named; where none is, the least of all candidates."""
    ranking, verdict = document["ranking"], document["verdict"]
    named = next((entry for entry in ranking if entry["effect"] == verdict), None)
    others = [entry for entry in ranking if entry is not named]
    row = {
        "verdict": verdict,
        "p_value": min((entry["p_value"] for entry in ranking), default=NO_EVIDENCE),
        "runner_up": others[0]["effect"] if named is not None and others else None,
        "judged": document.get("bearing", {}).get("judged"),
        "codes": list(document.get("message_codes", ())),
    }
    if named is not None:
        row |= {
            "at": list(named["at"]),
            "p_value": named["p_value"],
            "heldout_gain": named["heldout_gain"],
            "missing_force_percent": named["missing_force_before_percent"],
            "missing_force_after_percent": named["missing_force_after_percent"],
            "order": next((p["value"] for name, p in named["parameters"].items() if name.endswith(".order")), None),
        }
    return {"verdicts": [row]}


_ROWS_OF_ANALYSIS: dict[str, Callable[[Document], Rows]] = {
    "severity": _severity,
    "fit": _fit,
    "compare": _compare,
    "diagnose": _diagnose,
}
