"""demo: the whole story on one machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import Json, Output, Quiet, Verbose


def demo(
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for logs, rig files and the report.")
    ] = Path("rotorscope-demo"),
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """A simulated rig with an effect its model lacks: acquire, compare, diagnose, add, compare; under a minute."""
    from daq.commands.demo import demo as body

    body(Output(json, quiet, verbose), out)


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Begin here")(demo)
