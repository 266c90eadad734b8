"""`rotorscope effects`: the catalogue, for people and programs."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from daq.base.console.fitting import FittingTable
from daq.base.console.output import Output
from daq.base.contract.errors import ConfigError
from daq.rig.problems import did_you_mean
from estimator.effects import CATALOGUE
from estimator.model import Effect


def effects(output: Output, name: str | None) -> None:
    if name is None:
        rows = [
            (e.name, _ACTS_ON[e.kind], ", ".join(f"{p.name} [{p.unit}]" for p in e.parameters), e.equation)
            for e in CATALOGUE.values()
        ]
        table = FittingTable(headings=("effect", "acts on", "parameters", "law"), rows=rows, order=(3, 2, 1))
        people = "More of one: rotorscope effects NAME. Add one: rotorscope add NAME --rig RIG --out RIG2."
        output.result({"schema": 1, "effects": [as_json(e) for e in CATALOGUE.values()]}, table, people)
        return
    if name not in CATALOGUE:
        raise ConfigError(f'"{name}" is not an effect; {did_you_mean(name, CATALOGUE, "there are")}')
    effect = CATALOGUE[name]
    output.result({"schema": 1} | as_json(effect), _texts(effect), "", _parameters(effect))


_ACTS_ON = {
    "force": "bearing cap",
    "memory": "bearing cap, with states of its own",
    "disc": "disc",
    "shaft": "shaft",
    "excitation": "unknown force",
    "sensor": "measured channel",
}


def _plain(text: str) -> Any:
    from rich.text import Text

    return Text(text)


def _texts(effect: Effect) -> Table:
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for heading, text in (
        ("effect", effect.name),
        ("acts on", _ACTS_ON[effect.kind]),
        ("law", effect.equation),
        ("parameters", "for each direction" if effect.scope == "direction" else "one set for both directions"),
        ("signature", effect.signature),
        ("confused with", ", ".join(effect.confused_with) or "nothing in the catalogue"),
        ("distinguished by", effect.distinguish),
        ("on the machine", effect.on_machine),
        ("source", effect.reference),
        ("checked by", effect.check),
    ):
        table.add_row(heading, _plain(text))
    return table


def _parameters(effect: Effect) -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False)
    for heading in ("parameter", "unit", "estimated by", "meaning"):
        table.add_column(heading, overflow="fold")
    for p in effect.parameters:
        how = "given" if getattr(p, "given", False) else "linear solution" if p.linear else "search"
        table.add_row(p.name, _plain(p.unit), how, _plain(p.description))
    return table


def as_json(effect: Effect) -> dict[str, Any]:
    return {
        "name": effect.name,
        "kind": effect.kind,
        "scope": effect.scope,
        "law": effect.equation,
        "parameters": [
            {"name": p.name, "unit": p.unit, "description": p.description, "linear": p.linear}
            for p in effect.parameters
        ],
        "signature": effect.signature,
        "confused_with": list(effect.confused_with),
        "distinguish": effect.distinguish,
        "source": effect.reference,
        "check": effect.check,
        "on_machine": effect.on_machine,
        "stationary_density": effect.stationary_density,
    }
