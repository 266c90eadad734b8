"""import, export, recover, info, ports: files in and out, and what can be opened here."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from daq.base.console.stop import all_or_nothing

from .options import Json, Output, Quiet, RigOption, Verbose

Log = Annotated[Path, typer.Argument(metavar="LOG", help="A log (.mcap).")]


def import_(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help=".npz .csv .mat .mf4 .uff .wav, or .log .blf .asc with a DBC.")
    ],
    rig: RigOption,
    out: Annotated[Path, typer.Option("--out", metavar="LOG.mcap", help="The log to write.")],
    rate: Annotated[
        float | None, typer.Option("--rate", metavar="HZ", help="Sampling rate, if the file does not say it.")
    ] = None,
    gaps: Annotated[
        bool, typer.Option("--gaps", help="Rows that are NaN in every channel become gaps, instead of an error.")
    ] = False,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Another format into a log, by file ending; never a silent fill."""
    with all_or_nothing():
        from daq.commands.files.importers import import_file as body

        body(Output(json, quiet, verbose), file, rig, out, rate, gaps)


def export(
    log: Log,
    to: Annotated[Path, typer.Option("--to", metavar="FILE", help=".npz .csv .mat .wav, by ending.")],
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """A log into another format, by file ending; gaps become NaN, and are named."""
    with all_or_nothing():
        from daq.commands.files.exporters import export as body

        body(Output(json, quiet, verbose), log, to)


def recover(
    log: Log,
    out: Annotated[Path, typer.Option("--out", metavar="LOG2", help="The mended log.")],
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Mend a cut log, and say what was lost."""
    with all_or_nothing():
        from daq.commands.files.files import recover as body

        body(Output(json, quiet, verbose), log, out)


def info(log: Log, json: Json = None, quiet: Quiet = False, verbose: Verbose = False) -> None:
    """What is in a log."""
    from daq.commands.files.files import info as body

    body(Output(json, quiet, verbose), log)


def ports(json: Json = None, quiet: Quiet = False, verbose: Verbose = False) -> None:
    """What can be opened here: serial ports, CAN interfaces, and what is missing."""
    from daq.commands.ports import ports as body

    body(Output(json, quiet, verbose))


def register(app: typer.Typer) -> None:
    app.command("import", rich_help_panel="Files")(import_)
    for command in (export, recover, info, ports):
        app.command(rich_help_panel="Files")(command)
