"""import, export, recover, info, ports: files in and out, and what can be opened here."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from daq.base.console.stop import all_or_nothing

from .options import Json, Output, Part, Quiet, RigOption, Verbose, of_a_part, switch

Log = Annotated[Path, typer.Argument(metavar="LOG", readable=False, help="A log (.mcap).")]


@of_a_part
def import_(
    file: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            readable=False,
            help=".npz .csv .mat .mf4 .uff .wav .lvm .tdms .h5 .parquet, or, with a DBC, .log .blf .asc (?bus=N).",
        ),
    ],
    rig: RigOption,
    out: Annotated[Path, typer.Option("--out", metavar="LOG.mcap", help="The log to write.")],
    rate: Annotated[
        float | None, typer.Option("--rate", metavar="HZ", help="Sampling rate, if the file does not say it.")
    ] = None,
    gaps: Annotated[
        bool,
        switch("--gaps", help="Rows that are NaN in every channel become gaps, instead of an error."),
    ] = False,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    *,
    part: Part,
) -> None:
    """Import a file of another format, by its ending, into a log; several become one log, with gaps between them.

    Missing samples are never filled in.
    """
    with all_or_nothing():
        from daq.commands.files.importers import import_files as body

        body(Output(json, quiet, verbose), file, rig, out, rate, gaps, part)


@of_a_part
def export(
    log: Log,
    to: Annotated[
        Path,
        typer.Option(
            "--to", metavar="FILE", help=".npz .csv .mat .mf4 .wav .uff .h5 .parquet, .mcap .rrd (SI), by ending."
        ),
    ],
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    *,
    part: Part,
) -> None:
    """Export a log to another format, by the ending of the file. Gaps become NaN and are listed."""
    with all_or_nothing():
        from daq.commands.files.exporters import export as body

        body(Output(json, quiet, verbose), log, to, part)


def recover(
    log: Log,
    out: Annotated[Path, typer.Option("--out", metavar="LOG2", help="The recovered log.")],
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Recover a cut or damaged log, and say what was lost."""
    with all_or_nothing():
        from daq.commands.files.files import recover as body

        body(Output(json, quiet, verbose), log, out)


@of_a_part
def info(log: Log, json: Json = None, quiet: Quiet = False, verbose: Verbose = False, *, part: Part) -> None:
    """Show what a log holds."""
    from daq.commands.files.files import info as body

    body(Output(json, quiet, verbose), log, part)


def ports(json: Json = None, quiet: Quiet = False, verbose: Verbose = False) -> None:
    """List serial ports and CAN interfaces, and what is missing to use others."""
    from daq.commands.ports import ports as body

    body(Output(json, quiet, verbose))


def register(app: typer.Typer) -> None:
    app.command("import", rich_help_panel="Files")(import_)
    for command in (export, recover, info, ports):
        app.command(rich_help_panel="Files")(command)
