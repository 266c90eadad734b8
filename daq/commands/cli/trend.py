"""trend: what became of a machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import HtmlOption, Json, Output, Quiet, RerunOption, Verbose


def trend(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder of `rotorscope run --segment`, or results of `batch`.")
    ],
    since: Annotated[
        str | None,
        typer.Option("--since", metavar="7d|DATE", help="Only so long before its end, or from an ISO date on."),
    ] = None,
    machine: Annotated[
        str | None, typer.Option("--machine", metavar="NAME", help="Of the results of several machines, this one.")
    ] = None,
    html: HtmlOption = None,
    rerun: RerunOption = None,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """How parameters, severity, tones, strikes, missing force and speed went; gaps and alarms.

    The page of --html is one file, with zoom and hover, that needs no network: send it.
    """
    from daq.commands.live.trend import trend as body

    body(Output(json, quiet, verbose), folder, since, machine, html, rerun)


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Acquire")(trend)
