"""init, add, remove, effects, check, schema: the rig file and what may stand in it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import Json, Output, Quiet, RigArgument, RigOption, Verbose

Rig2 = Annotated[Path, typer.Option("--out", metavar="RIG2", help="Where to write the new rig file.")]
Nodes = Annotated[
    list[str] | None,
    typer.Option("--at", metavar="NODE", help="bearing1, bearing2 or a place such as bearing1.x; may be repeated."),
]


def init(
    source: Annotated[
        Path | None,
        typer.Option("--from", metavar="FILE", help="Take the channels from a data file, a log (.mcap) or a .dbc."),
    ] = None,
    example: Annotated[
        str | None,
        typer.Option("--example", metavar="NAME", help="Copy a rig file that comes with rotorscope; ? lists them."),
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", metavar="RIG", help="The rig file to write; nothing is written over.")
    ] = Path("rig.toml"),
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """A first rig file, with comments: from a data file, a DBC, an example, or by a few questions."""
    from daq.commands.start.init import init as body

    body(Output(json, quiet, verbose), source, example, out)


def add(
    effect: Annotated[
        str, typer.Argument(metavar="EFFECT", help="Name of an effect; `rotorscope effects` lists them.")
    ],
    rig: RigOption,
    out: Rig2,
    at: Nodes = None,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Add an effect to the model; comments and layout of the file survive."""
    from daq.rig.edit import add as body

    body(Output(json, quiet, verbose), effect, rig, out, at or [])


def remove(
    effect: Annotated[str, typer.Argument(metavar="EFFECT", help="An effect of the model.")],
    rig: RigOption,
    out: Rig2,
    at: Nodes = None,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Remove an effect from the model, everywhere or at one node."""
    from daq.rig.edit import remove as body

    body(Output(json, quiet, verbose), effect, rig, out, at or [])


def effects(
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="One effect, in full.")] = None,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """The catalogue: law, parameters, units, signature, what it is confused with, source."""
    from daq.commands.catalogue import effects as body

    body(Output(json, quiet, verbose), name)


def check(
    rig: RigArgument,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Validate a rig file: every problem at once, or a summary of the rig."""
    from daq.commands.check import check as body

    body(Output(json, quiet, verbose), rig)


def schema(
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """The JSON schema of a rig file."""
    from daq.rig.schema import schema as body

    body(Output(json, quiet, verbose))


def rotor(
    source: Annotated[Path, typer.Argument(metavar="MODEL.toml", help="A rotor model saved by ROSS.")],
    out: Annotated[Path, typer.Option("--out", metavar="ROTOR.npz", help="Where to write the matrices.")],
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Matrices of the shaft and discs of a ROSS model, for a rig with shaft = "matrices"."""
    from daq.commands.start.ross_model import rotor as body

    body(Output(json, quiet, verbose), source, out)


def register(app: typer.Typer) -> None:
    for command in (init, rotor, add, remove, effects, check, schema):
        app.command(rich_help_panel="Model")(command)
