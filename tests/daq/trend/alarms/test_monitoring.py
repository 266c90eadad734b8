"""What is shipped for Prometheus and Grafana asks for metrics that there are."""

from __future__ import annotations

import json
import re
from pathlib import Path

from daq.report.metrics import TOTAL_METRICS, VALUE_METRICS

FOLDER = Path(__file__).parents[4] / "docs" / "monitoring"
METRICS = {f"rotorscope_{name}_total" for name in TOTAL_METRICS} | {f"rotorscope_{name}" for name in VALUE_METRICS}


def asked(text: str) -> set[str]:
    return set(re.findall(r"rotorscope_\w+", text))


def test_rules_and_dashboard_ask_for_metrics_that_there_are() -> None:
    rules = (FOLDER / "rotorscope.rules.yml").read_text()
    board = json.loads((FOLDER / "grafana.json").read_text())
    expressions = [target["expr"] for panel in board["panels"] for target in panel["targets"]]
    assert asked(rules) | asked(" ".join(expressions)) <= METRICS
    assert "rotorscope_alarm == 1" in rules
    assert len({panel["id"] for panel in board["panels"]}) == len(board["panels"]) > 5
