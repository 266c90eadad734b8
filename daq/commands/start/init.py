"""The body of init: where the channels of a new rig file come from."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.base.console.output import Output, write_whole
from daq.base.contract.errors import ConfigError
from daq.rig.problems import did_you_mean
from daq.rig.rig import Rig, load_rig
from estimator.model import MOTION_UNITS

from .examples import example, example_files
from .guess import Guess, guesses, kind_of_unit
from .questions import ask
from .text import NewRig, rig_text

MAX_MOVED_SAMPLES = 0.01  # of the last row, by a rounder rate


def init(output: Output, source: Path | None, name: str | None, out: Path) -> None:
    """Write a rig file of an example, of a file, or of answers. Nothing that is there is written over."""
    if source is not None and name is not None:
        raise ConfigError("--from and --example: give one of the two")
    copied = None if name is None else example(name)
    if out.exists():
        raise ConfigError(f"{out}: is there already, and is not written over; choose another --out")
    if copied is not None:
        text, notes = _of_example(copied, out)
    elif source is not None:
        text, notes = _of_file(output, source, out)
    elif sys.stdin.isatty():
        text, notes = rig_text(ask(out.stem)), []
    else:
        names = ", ".join(example_files())
        raise ConfigError(f"init: give --from FILE (data, log or DBC) or --example NAME ({names}); a terminal asks")
    rig = Rig.parse(text, out.parent, out, str(out))
    write_whole(out, text)
    for note in notes:
        output.note(note)
    channels = [{"name": c.name, "node": c.node, "direction": c.direction, "kind": c.kind, "unit": c.unit}
                for c in rig.file.channel]  # fmt: skip
    said = ", ".join(f"{c.name} [{c.unit}] at {c.node}.{c.direction}" for c in rig.file.channel)
    value = {"schema": 1, "file": str(out), "channels": channels, "band": list(rig.model.band)}
    output.result(value, f"{out}: {said}", f"look through it, then: rotorscope check {out}")


def _of_example(path: Path, out: Path) -> tuple[str, list[str]]:
    """The text of an example; its DBC and the matrices of its rotor are copied beside the new file."""
    rig, notes = load_rig(path), []
    rotor = rig.file.rig.rotor
    matrices = rig.base / rotor.file if rotor is not None and rotor.file is not None else None
    for needed, word in ((rig.dbc, "DBC"), (matrices, "rotor")):
        if needed is not None and not (out.parent / needed.name).exists():
            write_whole(out.parent / needed.name, needed.read_bytes())
            notes.append(f"{out.parent / needed.name}: the {word} that the example needs")
    return path.read_text("utf-8"), notes


def _of_file(output: Output, source: Path, out: Path) -> tuple[str, list[str]]:
    if source.is_dir():
        raise ConfigError(f"--from {source}: is a folder; give a file in it")
    if not source.is_file():
        raise ConfigError(f"--from {source}: there is no such file; check the path")
    if source.suffix.lower() == ".dbc":
        return _of_dbc(source, out)
    if source.suffix.lower() == ".mcap":
        return _of_log(source, out)
    return _of_data(output, source, out)


def _of_dbc(source: Path, out: Path) -> tuple[str, list[str]]:
    from drivers.contract import LinkError
    from drivers.foreign import load_dbc

    try:
        database = load_dbc(source.read_bytes())
    except LinkError as error:
        raise ConfigError(f"--from {source}: {error}") from error
    signals = [(f"{m.name}.{s.name}", s.unit or "") for m in database.messages for s in m.signals]
    measured = [(name, unit) for name, unit in signals if unit and list(guesses([(name, unit)]))]
    kinds = [kind_of_unit(unit) for _, unit in measured]
    best = next((kind for kind in MOTION_UNITS if kind in kinds), "")  # accelerations first; a GPS has speeds too
    found = list(guesses([own for own, kind in zip(measured, kinds, strict=True) if kind == best]))
    if not found:
        said = ", ".join(f"{n} [{u}]" for n, u in signals[:6])
        raise ConfigError(
            f"--from {source}: no signal in a unit of vibration (m/s^2, g, mm/s ...); it has {said or 'none'}"
        )
    path = os.path.relpath(source.absolute(), out.absolute().parent)
    new = NewRig(name=out.stem, origin=f"Written by rotorscope init from {source.name}.", channels=found, dbc=path)
    return rig_text(new), _left([name for name, _ in measured], found)


def _of_log(source: Path, out: Path) -> tuple[str, list[str]]:
    from daq.log.reader import read_log

    log = read_log(source)
    if (own := log.rig_text.strip()) and "rig.toml" in log.attachments:
        text, notes = _with_rotor(own, log.attachments, out)
        return text + "\n", [f"{source}: holds its rig file, which is copied", *notes]
    signals = [(s.name, s.unit) for s in log.info.signals]
    found = _some(source, list(guesses(signals)), [name for name, _ in signals])
    new = NewRig(name=out.stem, origin=f"Written by rotorscope init from {source.name}.", channels=found,
                 rate_hz=log.rate_hz)  # fmt: skip
    return rig_text(new), _left([name for name, _ in signals], found)


def _with_rotor(text: str, attached: Mapping[str, bytes], out: Path) -> tuple[str, list[str]]:
    """The rig file of a log; the matrices of its rotor are written beside the new file, and named there."""
    from daq.rig.rotor_table import ATTACHED_NAME

    rotor = Rig.parse(text, attached=attached).file.rig.rotor if ATTACHED_NAME in attached else None
    if rotor is None or rotor.file is None:
        return text, []
    target = out.parent / (Path(rotor.file).stem + ".npz")
    if not target.exists():
        write_whole(target, attached[ATTACHED_NAME])
    return text.replace(f'"{rotor.file}"', f'"{target.name}"'), [f"{target}: the matrices of its rotor"]


def rate_of(time: NDArray[np.float64]) -> float | None:
    """The rate of a time column in Hz, from its whole length, as its steps are rounded; None if it does not increase.

    The roundest number at which the last row moves by less than a hundredth of a sample.
    """
    steps = np.diff(time)
    step = float(np.median(steps)) if steps.size else 0.0
    if not (np.isfinite(time).all() and step > 0 and (steps > 0).all()):
        return None
    rows, length = float(np.rint(steps / step).sum()), float(time[-1] - time[0])
    rate_hz = rows / length
    round_ones = (float(f"{rate_hz:.{digits}g}") for digits in range(3, 12))
    return next((r for r in round_ones if abs(r - rate_hz) * length < MAX_MOVED_SAMPLES), rate_hz)


def _of_data(output: Output, source: Path, out: Path) -> tuple[str, list[str]]:
    from daq.exchange.formats import read

    named = read(source, ())
    signals = [(name, named.units.get(name, "")) for name in named.values]
    found = _some(source, list(guesses(signals)), [name for name, _ in signals])
    rate_hz = named.rate_hz
    if rate_hz is None:
        columns = read(source, [own.source for own in found])
        rate_hz = None if columns.time is None else rate_of(np.asarray(columns.time, np.float64).ravel())
    notes = _left([name for name, _ in signals], found)
    if rate_hz is None:
        notes.append(f"{source}: says no sampling rate; import it with --rate, and set the band")
    new = NewRig(name=out.stem, origin=f"Written by rotorscope init from {source.name}.", channels=found,
                 rate_hz=rate_hz)  # fmt: skip
    return rig_text(new), notes


def _some(source: Path, found: list[Guess], names: list[str]) -> list[Guess]:
    if found:
        return found
    said = did_you_mean("b1x", names, "its columns are") if names else "it names none: begin with --example"
    raise ConfigError(f"--from {source}: no channel of vibration found; {said}")


def _left(names: list[str], found: list[Guess]) -> list[str]:
    """The parts that were left out, in a line."""
    left = [name for name in names if name not in {own.source for own in found}]
    return [f"left out: {', '.join(left[:8])}" + (" ..." if len(left) > 8 else "")] if left else []
