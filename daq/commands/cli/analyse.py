"""severity, fit, compare, diagnose, improve, theory, reproduce, confusion: what the data say about the model."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from .options import (
    HtmlOption,
    Json,
    LogArgument,
    Output,
    Part,
    Quiet,
    RerunOption,
    RigArgument,
    RigOption,
    Verbose,
    of_a_part,
)


class Method(StrEnum):
    spectral = "spectral"
    fokker_planck = "fokker-planck"
    score_matching = "score-matching"


@of_a_part
def severity(
    log: LogArgument,
    rig: RigOption,
    html: HtmlOption = None,
    rerun: RerunOption = None,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    *,
    part: Part,
) -> None:
    """First numbers of each channel: rms, peak, crest, kurtosis, velocity with its zone of ISO 20816, band levels."""
    from daq.commands.severity import severity as body

    body(Output(json, quiet, verbose), log, rig, html, rerun, part)


@of_a_part
def fit(
    log: LogArgument,
    rig: RigOption,
    method: Annotated[Method, typer.Option("--method", help="Method of estimation.")] = Method.spectral,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="RIG2", help="Write the rig file with the fitted values.")
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    *,
    part: Part,
) -> None:
    """Parameters with units, standard deviations and an identifiability verdict."""
    from daq.commands.analyse import fit as body

    body(Output(json, quiet, verbose), log, rig, method.value, out, part)


@of_a_part
def compare(
    log: LogArgument,
    rig: RigOption,
    html: HtmlOption = None,
    rerun: RerunOption = None,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    *,
    part: Part,
) -> None:
    """Model against measurement, on held-out data; where it fails."""
    from daq.commands.analyse import compare as body

    body(Output(json, quiet, verbose), log, rig, html, rerun, part)


@of_a_part
def diagnose(
    log: LogArgument,
    rig: RigOption,
    html: HtmlOption = None,
    rerun: RerunOption = None,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    *,
    part: Part,
) -> None:
    """Which effect is missing, ranked, with evidence; or "complete"; or "unknown" with the shape of what is missing."""
    from daq.commands.diagnosis import diagnose as body

    body(Output(json, quiet, verbose), log, rig, html, rerun, part)


@of_a_part
def improve(
    log: LogArgument,
    rig: RigOption,
    out: Annotated[Path, typer.Option("--out", metavar="RIG2", help="Where to write the improved rig file.")],
    html: HtmlOption = None,
    rerun: RerunOption = None,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    *,
    part: Part,
) -> None:
    """Compare, diagnose, add an effect and refit, until no effect improves the model; prints the error of each step."""
    from daq.commands.diagnosis import improve as body

    body(Output(json, quiet, verbose), log, rig, out, html, rerun, part)


def theory(
    rig: RigArgument,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Hertz stiffness of the bearing against preload, together with the fitted values."""
    from daq.commands.analyse import theory as body

    body(Output(json, quiet, verbose), rig)


def reproduce(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder for figures, tables and numbers.")],
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """The paper of Tiwari and Vyas (1997), sections 5 and 6, on its rig: tables and figures."""
    from daq.commands.analyse import reproduce as body

    body(Output(json, quiet, verbose), out)


def confusion(
    rig: RigArgument,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the runs and the matrix; a second call goes on.")
    ],
    effects: Annotated[str, typer.Option("--effects", metavar="A,B,..", help="Effects to hide; all if empty.")] = "",
    strengths: Annotated[str, typer.Option("--strengths", help="weak, strong or both, with a comma.")] = "weak,strong",
    at: Annotated[str, typer.Option("--at", help="bearing1, both, or the two with a comma.")] = "bearing1",
    seeds: Annotated[int, typer.Option("--seeds", min=0, help="Runs of each effect and strength.")] = 1,
    complete: Annotated[int, typer.Option("--complete", min=0, help="Runs with nothing hidden.")] = 4,
    pairs: Annotated[
        int, typer.Option("--pairs", min=0, help="Runs with two effects hidden together, which improve is to add.")
    ] = 0,
    seconds: Annotated[float, typer.Option("--seconds", min=1.0, help="Length of each record.")] = 20.0,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """For developers: hide every effect in simulated records of a rig, and count what diagnose calls it."""
    from daq.commands.study.confusion import confusion as body

    given = (effects.split(",") if effects else [], strengths.split(","), at.split(","))
    body(Output(json, quiet, verbose), rig, out, *given, seeds, complete, pairs, seconds)


def register(app: typer.Typer) -> None:
    for command in (severity, fit, compare, diagnose, improve, theory, reproduce, confusion):
        app.command(rich_help_panel="Identify")(command)
