"""Options of every command."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from daq.base.console.output import Output
from daq.base.contract.part import Part


def switch(*names: str, help: str, **more: Any) -> Any:
    """An option that takes no value: the help shows no type beside it. more : of `typer.Option`."""
    return typer.Option(*names, metavar="", help=help, **more)


Json = Annotated[
    str | None, typer.Option("--json", metavar="FILE", help="Write the result as JSON; - for standard output.")
]
Quiet = Annotated[bool, switch("--quiet", "-q", help="Only errors.")]
Verbose = Annotated[bool, switch("--verbose", "-v", help="More detail, and tracebacks of errors.")]
# Of what is to be read: who reads it says why it cannot be, and what to do.
RigArgument = Annotated[Path, typer.Argument(metavar="RIG", readable=False, help="Rig file (TOML).")]
RigOption = Annotated[Path, typer.Option("--rig", metavar="RIG", readable=False, help="Rig file (TOML).")]
LogArgument = Annotated[
    Path,
    typer.Argument(metavar="LOG", readable=False, help="Log (.mcap), or a file that `rotorscope import` reads."),
]
HtmlOption = Annotated[Path | None, typer.Option("--html", metavar="FILE", help="Write a self-contained report page.")]

RerunOption = Annotated[
    str | None, typer.Option("--rerun", metavar="WHERE", help="Show it: FILE.rrd, spawn, or the URL of a viewer.")
]
From = Annotated[
    str | None,
    typer.Option("--from", metavar="T", help="Read from here on: s from the start of the record, or an ISO date."),
]
UNTIL_TEXT = "Read up to here: s from the start, or an ISO date."
To = Annotated[str | None, typer.Option("--to", "--until", metavar="T", help=UNTIL_TEXT)]
Until = Annotated[str | None, typer.Option("--until", metavar="T", help=UNTIL_TEXT)]  # where --to names a file
Length = Annotated[
    float | None, typer.Option("--seconds", metavar="S", help="Read so much, from --from or the start on.")
]
Channels = Annotated[
    str | None, typer.Option("--channels", metavar="A,B,..", help="Read these channels only, by their names.")
]
PART_OPTIONS = {"start": From, "stop": To, "seconds": Length, "channels": Channels}


def of_a_part(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command --from, --to, --seconds and --channels; it gets them as `part`."""

    @functools.wraps(command)
    def with_options(**given: Any) -> None:
        asked = [given.pop(name, None) for name in PART_OPTIONS]
        command(part=Part.asked(*asked), **given)

    signature = inspect.signature(command, eval_str=True)
    options = PART_OPTIONS | ({"stop": Until} if "to" in signature.parameters else {})
    own = [p for p in signature.parameters.values() if p.name != "part"]
    at = next((k for k, p in enumerate(own) if p.name == "json"), len(own))
    more = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=option)
        for name, option in options.items()
    ]
    ordered = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in (*own[:at], *more, *own[at:])]
    with_options.__signature__ = signature.replace(parameters=ordered)  # type: ignore[attr-defined]
    with_options.__annotations__ = {p.name: p.annotation for p in ordered}
    return with_options


__all__ = [
    "HtmlOption", "Json", "LogArgument", "Output", "Part", "Quiet", "RerunOption", "RigArgument", "RigOption",
    "Verbose", "of_a_part",
]  # fmt: skip
