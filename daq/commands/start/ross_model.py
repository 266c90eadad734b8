"""`rotorscope rotor`: the matrices of shaft and discs of a model saved by ROSS, and the rig table that uses them."""

from __future__ import annotations

import io
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from daq.base.console.extras import check_installed
from daq.base.console.output import Output, write_whole
from daq.base.contract.errors import ConfigError

# ROSS prints while it is loaded, and takes seconds: it runs in a separate process
CHILD_CODE = """
import json, sys
import numpy as np, ross
source, target = sys.argv[1:]
whole = ross.Rotor.load(source)
rotor = ross.Rotor(whole.shaft_elements, whole.disk_elements, None, whole.point_mass_elements)
size = rotor.number_dof
np.savez(target, M=rotor.M(0), K=rotor.K(0), C=rotor.C(0), G=rotor.G(), dofs_per_node=size)
seals = [b for b in whole.bearing_elements if isinstance(b, ross.SealElement)]
model = {
    "nodes": len(rotor.M(0)) // size,
    "bearings": [[str(b.tag or ""), int(b.n)] for b in whole.bearing_elements if b not in seals],
    "discs": [[str(d.tag or ""), int(d.n)] for d in whole.disk_elements],
    "seals": len(seals),
    "supports": sum(b.n_link is not None for b in whole.bearing_elements),
}
print("\\n" + json.dumps(model))
"""


def rotor(output: Output, source: Path, out: Path) -> None:
    """Write the matrices, and print the tables for the rig file. Raises ConfigError."""
    if out.suffix != ".npz":
        raise ConfigError(f"{out}: the matrices are written as .npz; choose such a name")
    if source.is_dir():
        raise ConfigError(f"{source}: is a folder; give the file that ROSS saved in it")
    if not source.is_file():
        raise ConfigError(f"{source}: no such file; save the model in ROSS: rotor.save('{source.stem}.toml')")
    check_installed(("ross",), "ross", f"{source}: a model saved by ROSS")
    model, arrays = _matrices(source)
    bearings, discs = _named(model["bearings"], "bearing"), _named(model["discs"], "disc")
    if len(bearings) < 1:
        raise ConfigError(f"{source}: holds no bearing; add bearing elements, for their nodes")
    write_whole(out, arrays)
    text = _tables(out, bearings, discs)
    notes = []
    if model["seals"]:
        notes.append(f"note: {model['seals']} seals are left out: what they do is for the record to show")
    if model["supports"]:
        notes.append(
            f"note: {model['supports']} bearings stand on supports, which are left out: give a pedestal effect"
        )
    value = {"schema": 1, "file": str(out), "nodes": model["nodes"], "bearings": bearings, "discs": discs}
    output.result(value, text, *notes, f"{out}: shaft and discs of {source.name}, {model['nodes']} nodes")


def _matrices(source: Path) -> tuple[dict[str, Any], bytes]:
    """Names and counts of the model's elements, and its matrices as .npz."""
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as folder:
        target = Path(folder) / "rotor.npz"
        done = subprocess.run(  # noqa: S603
            [sys.executable, "-W", "ignore", "-c", CHILD_CODE, str(source.absolute()), str(target)],
            capture_output=True, text=True, check=False, cwd=folder,
        )  # fmt: skip
        if done.returncode:
            raise ConfigError(f"{source}: {_refusal(source, done.stderr)}")
        with np.load(target) as arrays:
            kept = {name: arrays[name] for name in arrays.files}
        packed = io.BytesIO()
        np.savez_compressed(packed, **kept)
        model: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
        return model, packed.getvalue()


def _refusal(source: Path, said: str) -> str:
    """Why a file cannot be loaded, with a remedy. said : text of ROSS on standard error."""
    again = f"save the model in ROSS: rotor.save('{source.stem}.toml')"
    try:
        text = source.read_text("utf-8")
        tables = json.loads(text) if source.suffix.lower() == ".json" else tomllib.loads(text)
    except ValueError as error:
        return f"is no whole TOML or JSON file ({error}); {again}"
    if "rig" in tables:
        return f"is a rig file (rotorscope check {source}), and no model of ROSS; {again}"
    if "parameters" not in tables:
        return f"is no model saved by ROSS: its first table, [parameters], is missing; {again}"
    if not any(name.startswith("ShaftElement") for name in tables):
        return f"holds no shaft element; {again}"
    last = (said.strip().splitlines() or ["it says nothing"])[-1]
    if missing := re.fullmatch(r"KeyError: '(.*)'", last):
        last = f'it asks for "{missing[1]}", which the file lacks'
    written = f"saved by ROSS {tables['ross_version']}, and " if "ross_version" in tables else ""
    return f"{written}ROSS here cannot load it: {last}; correct it, or {again}"


def _named(tagged: list[tuple[str, int]], word: str) -> dict[str, int]:
    """Name -> node: the tags of ROSS as names of the rig file, each once."""
    out: dict[str, int] = {}
    for tag, node in tagged:
        if node in out.values():
            continue
        name = re.sub(r"[^a-z0-9]+", "_", tag.lower()).strip("_") or word
        name = name if name[0].isalpha() else f"{word}_{name}"
        taken = name in out
        out[f"{name}_{node}" if taken else name] = node
    return out


def _tables(out: Path, bearings: dict[str, int], discs: dict[str, int]) -> str:
    def inline(names: dict[str, int]) -> str:
        return "{ " + ", ".join(f"{name} = {node}" for name, node in names.items()) + " }"

    lines = ['shaft = "matrices"        # in [rig]', "", "[rig.rotor]", f"file = {json.dumps(out.name)}"]
    lines += [f"bearings = {inline(bearings)}", *([f"discs = {inline(discs)}"] if discs else [])]
    return "\n".join([*lines, "damping_ratio = 0.003     # of the bending modes of the free shaft: an estimate"])
