"""batch: many logs at once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import Json, Output, Quiet, Verbose, switch

SCHEDULER_TEXT = (
    "local:N for N processes of this computer (default: one a core), or the address of a Dask scheduler, such as "
    "tcp://10.0.0.5:8786."
)


def batch(
    logs: Annotated[
        list[str],
        typer.Argument(metavar="PATTERN...", help="Logs: paths or URLs with *, ** and named fields, in quotes."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder of the tables; a second call goes on.")],
    rig: Annotated[
        Path | None, typer.Option("--rig", metavar="RIG", readable=False, help="Rig file of all logs.")
    ] = None,
    rig_of: Annotated[
        str | None,
        typer.Option("--rig-of", metavar="PATTERN", help="Rig file of each log, such as 'rigs/{machine}.toml'."),
    ] = None,
    do: Annotated[
        str, typer.Option("--do", metavar="A,B,..", help="Of severity, fit, compare, diagnose.")
    ] = "severity,fit,compare,diagnose",
    scheduler: Annotated[str | None, typer.Option("--scheduler", metavar="WHERE", help=SCHEDULER_TEXT)] = None,
    window: Annotated[
        str | None, typer.Option("--window", metavar="T", help="Cut each log into windows, such as 60s.")
    ] = None,
    every: Annotated[
        str | None, typer.Option("--every", metavar="T", help="Time between the starts of two windows, such as 1h.")
    ] = None,
    only_failed: Annotated[bool, switch("--only-failed", help="Do again what failed, and nothing else.")] = False,
    timeout: Annotated[
        float | None, typer.Option("--timeout", metavar="S", min=1.0, help="Give up an analysis that takes longer.")
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Analyse every log of an archive, on this computer or on a Dask cluster; the answers become Parquet tables.

    What is there already is not done again.
    """
    from daq.batch.command import Asked
    from daq.batch.command import batch as body
    from daq.batch.task import Windows, analyses

    output = Output(json, quiet, verbose)
    asked = Asked(
        analyses(do), rig=rig, rig_of=rig_of, windows=Windows.asked(window, every), only_failed=only_failed,
        timeout_s=timeout, scheduler=scheduler,
    )  # fmt: skip
    body(output, logs, out, asked)


def register(app: typer.Typer) -> None:
    app.command(rich_help_panel="Identify")(batch)
