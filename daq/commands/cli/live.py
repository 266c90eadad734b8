"""run, simulate, replay: everything with a link or a clock."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .options import Json, Output, Part, Quiet, RigArgument, Verbose, of_a_part, switch

LINK_FORMS = (
    "virtual: | can:INTERFACE:CHANNEL?bitrate=..&fd=1 | slcan:PORT?bitrate=.. | serial:PORT?baud=.. | "
    "capture:FILE | replay:LOG.mcap"
)


def _above_zero(value: float | None) -> float | None:
    if value is not None and not 0 < value < 1e12:
        raise typer.BadParameter(f"{value:g} is no length; give seconds above 0, or leave it out")
    return value


Seconds = Annotated[
    float | None,
    typer.Option("--seconds", metavar="S", callback=_above_zero, help="Stop after S seconds of data."),
]


Segment = Annotated[
    str | None,
    typer.Option("--segment", metavar="10min|500MB", help="Logs of this length or size each, in the folder --out."),
]
KeepOption = Annotated[
    list[str] | None,
    typer.Option("--keep", metavar="30d|200GB", help="Remove the oldest segments beyond this; may be repeated."),
]
KeepFree = Annotated[
    str | None,
    typer.Option("--keep-free", metavar="SIZE", help="Remove them to leave so much disk free (1GB with --keep)."),
]
RemoveAlarms = Annotated[bool, switch("--remove-alarms", help="Remove segments with an alarm like the others.")]
Every = Annotated[
    str | None, typer.Option("--every", metavar="1h", help="Store samples once in so long, for --for; estimate always.")
]
MqttOption = Annotated[
    str | None,
    typer.Option(
        "--mqtt", metavar="URL", help="Publish alarms: mqtt://HOST, or mqtt://USER@HOST:PORT/PREFIX (mqtts: with TLS)."
    ),
]
ForOption = Annotated[str | None, typer.Option("--for", metavar="30s", help="How long, of each --every.")]


def run(
    rigs: Annotated[
        list[str], typer.Argument(metavar="RIG", help="Rig file (TOML); several devices: RIG or RIG=LINK of each.")
    ],
    link: Annotated[
        str | None, typer.Option("--link", metavar="LINK", help=f"{LINK_FORMS} (default: the rig's)")
    ] = None,
    seconds: Seconds = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="LOG.mcap|DIR", help="Write a log; a folder: of several devices, of segments."),
    ] = None,
    segment: Segment = None,
    keep: KeepOption = None,
    keep_free: KeepFree = None,
    remove_alarms: RemoveAlarms = False,
    every: Every = None,
    length: ForOption = None,
    mqtt: MqttOption = None,
    rerun: Annotated[
        str | None, typer.Option("--rerun", metavar="WHERE", help="FILE.rrd, spawn, or the URL of a viewer.")
    ] = None,
    strict: Annotated[bool, switch("--strict", help="Exit with 1 if any sample was lost or an alarm came.")] = False,
    metrics: Annotated[
        int | None, typer.Option("--metrics", metavar="PORT", help="Prometheus metrics on 127.0.0.1:PORT.")
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Live acquisition and rolling estimation.

    Ctrl-C ends a run with a complete log and status 130; SIGTERM does so with status 0.
    A measurement that lies at LOG.mcap is not overwritten: it is kept beside the new one, as LOG-1.mcap.
    Several devices, each with its own link, clock and log: `run press.toml fan.toml=slcan:/dev/ttyACM1 --out logs`.
    A device that fails is reported and tried again; the others go on. The exit status is the worst of them.
    For years: `run press.toml --out press --segment 10min --keep 30d`, with the trend of all numbers in press/trend.
    """
    from daq.commands.live.run import run as body
    from daq.commands.live.watching import Watching

    watching = Watching.asked(
        out, segment, keep or (), keep_free, every=every, length=length, remove_alarms=remove_alarms, mqtt=mqtt
    )
    body(Output(json, quiet, verbose), rigs, link, seconds, out, rerun, strict, metrics, watching)


def simulate(
    rig: RigArgument,
    out: Annotated[Path | None, typer.Option("--out", metavar="LOG.mcap", help="Simulate into a log.")] = None,
    serve: Annotated[str | None, typer.Option("--serve", metavar="LINK", help="Simulate a device on a link.")] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            "--seconds", metavar="S", callback=_above_zero, help="Length (default: 60 for a log, no end for a device)."
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", metavar="N", min=0, help="Seed of the random forces and of the noise.")
    ] = 1,
    truth: Annotated[
        Path | None,
        typer.Option(
            "--truth", metavar="TRUTH.toml", help="Simulate this rig's model instead; if it is not there, write it."
        ),
    ] = None,
    speed: Annotated[
        str | None,
        typer.Option("--speed", metavar="X|max", help="Times real time (default: max for a log, 1 for a device)."),
    ] = None,
    clock_ppm: Annotated[
        float, typer.Option("--clock-ppm", metavar="PPM", help="How much too fast the device clock runs.")
    ] = 20.0,
    jitter_ms: Annotated[
        float, typer.Option("--jitter-ms", metavar="MS", min=0.0, help="Mean delay of the frames.")
    ] = 0.1,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            "--fault", metavar="KIND:RATE", help="drop, duplicate, flip, restart ...: share of frames; may be repeated."
        ),
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """A simulated rig, into a log or as a device on a link.

    LINK to serve: serial:pty, slcan:pty, serial:socket://HOST:PORT, can:INTERFACE:CHANNEL or a serial port; what to
    give to `rotorscope run --link` is printed. What the rig file leaves open is filled in with plain values, which are
    said and written to --truth.
    """
    from daq.commands.live.run import simulate as body

    device = {"clock_ppm": clock_ppm, "jitter_s": 1e-3 * jitter_ms}
    body(Output(json, quiet, verbose), rig, out, serve, seconds, seed, truth, speed, device, fault or [])


@of_a_part
def replay(
    log: Annotated[
        Path, typer.Argument(metavar="LOG.mcap|DIR", readable=False, help="A log, or a folder of segments.")
    ],
    speed: Annotated[str, typer.Option("--speed", metavar="X|max", help="Times real time.")] = "max",
    rig: Annotated[
        Path | None,
        typer.Option("--rig", metavar="RIG", readable=False, help="Another rig file than the one in the log."),
    ] = None,
    check: Annotated[
        bool,
        switch("--check", help="Exit with 1 unless the estimates equal the logged ones bit for bit."),
    ] = False,
    out: Annotated[Path | None, typer.Option("--out", metavar="LOG.mcap", help="Write a new log.")] = None,
    rerun: Annotated[
        str | None, typer.Option("--rerun", metavar="WHERE", help="FILE.rrd, spawn, or the URL of a viewer.")
    ] = None,
    json: Json = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
    *,
    part: Part,
) -> None:
    """Run a log through the pipeline of a live acquisition again."""
    from daq.commands.live.run import replay as body

    body(Output(json, quiet, verbose), log, speed, rig, check, out, rerun, part)


def register(app: typer.Typer) -> None:
    for command in (run, simulate, replay):
        app.command(rich_help_panel="Acquire")(command)
