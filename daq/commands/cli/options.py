"""What every command takes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from daq.base.console.output import Output

Json = Annotated[
    str | None, typer.Option("--json", metavar="FILE", help="Write the result as JSON; - for standard output.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Only errors.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="More detail, and tracebacks of errors.")]
RigArgument = Annotated[Path, typer.Argument(metavar="RIG", help="Rig file (TOML).")]
RigOption = Annotated[Path, typer.Option("--rig", metavar="RIG", help="Rig file (TOML).")]
LogArgument = Annotated[
    Path, typer.Argument(metavar="LOG", help="Log (.mcap), or a file that `rotorscope import` reads.")
]
HtmlOption = Annotated[Path | None, typer.Option("--html", metavar="FILE", help="Write a self-contained report page.")]

RerunOption = Annotated[
    str | None, typer.Option("--rerun", metavar="WHERE", help="Show it: FILE.rrd, spawn, or the URL of a viewer.")
]

__all__ = ["HtmlOption", "Json", "LogArgument", "Output", "Quiet", "RerunOption", "RigArgument", "RigOption", "Verbose"]
