"""[rig.rotor]: shaft and discs as matrices, from a file or in the rig file, with bearings at named nodes."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationInfo, field_validator

from estimator.errors import ModelError
from estimator.model import RotorMatrices, reduced_rotor

from .table import Table

NODE_NAME = r"^[a-z][a-z0-9_]*$"
MAX_BEARINGS = 8
ATTACHED_NAME = "rotor.npz"  # of the matrices in a log
SYMMETRY_REL = 1e-6  # of the largest entry, up to which two entries of a matrix are equal, or an entry is 0
MIN_MASS_REL = 1e-12  # least eigenvalue of M, its diagonal scaled to 1
NodeName = Annotated[str, Field(pattern=NODE_NAME)]
Matrix = list[list[float]]
Arrays = dict[str, NDArray[np.float64]]
# indices of the displacement and the slope of each plane within a node; 4 and 6 are the order of ROSS
PLANES_OF_NODE: dict[int, dict[str, tuple[int, ...]]] = {
    1: {"x": (0,)}, 2: {"x": (0, 1)}, 4: {"x": (0, 3), "y": (1, 2)}, 6: {"x": (0, 4), "y": (1, 3)},
}  # fmt: skip


class RotorTable(Table):
    """Shaft and discs without bearings, as matrices in SI: those of a file, or M and K here.

    Nodes count from 0. A file is .npz or .json with M, K and, if there are, C and G. The equation of motion is
    M a + (C + speed G) v + K x = force, speed in rad/s.
    """

    file: str | None = Field(default=None, description="path from the rig file; `rotorscope rotor` makes it from ROSS")
    bearings: dict[NodeName, int] = Field(description="name of each bearing -> its node")
    discs: dict[NodeName, int] = Field(default={}, description="name -> node, where imbalance may act")
    dofs_per_node: Literal[1, 2, 4, 6] | None = Field(
        default=None, validate_default=True, description="1: x. 2: x, slope. 4: x, y, two slopes. 6: ROSS"
    )
    damping_ratio: Annotated[float, Field(ge=0, lt=1, description="of every bending mode of the free shaft")] = 0.0
    M: Matrix | None = Field(default=None, description="kg, instead of a file")
    K: Matrix | None = Field(default=None, description="N/m, instead of a file")
    C: Matrix | None = None
    G: Matrix | None = None

    @field_validator("bearings")
    @classmethod
    def few(cls, value: dict[str, int]) -> dict[str, int]:
        if not value:
            raise ValueError("names no bearing: write the name and the node of each, such as { drive = 2, free = 18 }")
        if len(value) > MAX_BEARINGS:
            raise ValueError(f"{len(value)} bearings: at most {MAX_BEARINGS} are supported; leave the stiffest out")
        return value

    @field_validator("discs")
    @classmethod
    def nodes_of_their_own(cls, value: dict[str, int], info: ValidationInfo) -> dict[str, int]:
        names: dict[int, str] = {}
        for name, node in [*info.data.get("bearings", {}).items(), *value.items()]:
            if node in names:
                raise ValueError(f"{names[node]} and {name} are both at node {node}; give each a node of its own")
            names[node] = name
        if same := set(value) & set(info.data.get("bearings", {})):
            raise ValueError(f'"{min(same)}" is a bearing too; rename the disc')
        return value

    @property
    def names(self) -> RotorMatrices:
        """The names of bearings and discs, without matrices."""
        none = np.zeros((0, 0))
        return RotorMatrices(dofs=(), bearings=(*self.bearings,), discs=(*self.discs,), M=none, C=none, K=none)

    @property
    def inline(self) -> dict[str, Matrix]:
        """The matrices that stand in the rig file."""
        return {key: own for key in "MCKG" if (own := getattr(self, key)) is not None}


class RotorError(ValueError):
    """Problems of the matrices. key : of [rig.rotor] at which it is to be said."""

    def __init__(self, key: str, text: str) -> None:
        super().__init__(text)
        self.key = key


def read_matrices(table: RotorTable, base: Path | None, attached: Mapping[str, bytes]) -> Arrays:
    """The arrays M, K and, if there are, C, G and dofs_per_node. attached : of a log, which come first.

    Raises RotorError.
    """
    if table.inline and table.file is not None:
        raise RotorError("file", "is given beside matrices in the rig file: keep one of them")
    if table.file is None:
        found: dict[str, Any] = dict(table.inline)
    elif ATTACHED_NAME in attached:
        found = _npz(io.BytesIO(attached[ATTACHED_NAME]))
    elif base is None:
        raise RotorError("file", f"{table.file} is not in the log; give the rig file itself: --rig")
    else:
        found = _of_file(base / table.file)
    if table.dofs_per_node is not None:
        found["dofs_per_node"] = table.dofs_per_node
    key = "file" if table.file else "M"
    out: Arrays = {}
    for name in found.keys() & {*"MCKG", "dofs_per_node"}:
        try:
            out[name] = np.asarray(found[name], dtype=np.float64)
        except (ValueError, TypeError) as error:
            raise RotorError(key, f"{name} is not a matrix of numbers: rows of one length are needed") from error
    _check(out, key, sorted(found))
    return out


def _of_file(path: Path) -> dict[str, Any]:
    if path.suffix == ".toml":
        text = f"{path.name}: a model saved by ROSS; rotorscope rotor {path.name} --out rotor.npz writes its matrices"
        raise RotorError("file", f"{text}: name that file here")
    if path.suffix not in (".npz", ".json"):
        raise RotorError("file", f"{path.name}: matrices come from .npz or .json; write numpy.savez(FILE, M=M, K=K)")
    if not path.is_file():
        raise RotorError("file", f"there is no file {path}; the path starts at the rig file")
    try:
        if path.suffix == ".npz":
            return _npz(path)
        found = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        text = f"{path.name} is no {path.suffix} file of matrices; write it by numpy.savez(FILE, M=M, K=K), or as JSON"
        raise RotorError("file", text) from error
    return found if isinstance(found, dict) else {}


def _npz(source: Path | io.BytesIO) -> dict[str, Any]:
    with np.load(source, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _check(given: Arrays, key: str, there: list[str]) -> None:
    """Raises RotorError for arrays that are no matrices of a shaft."""
    missing = [name for name in "MK" if name not in given]
    if missing:
        has = ", ".join(there) or "no arrays"
        raise RotorError(key, f"there is no {missing[0]}, but {has}; M and K are needed, and C and G if there are")
    for name in sorted(given.keys() - {"dofs_per_node"}):
        A = given[name]
        if A.ndim != 2 or A.shape != (len(given["M"]),) * 2:
            shape, size = " x ".join(map(str, A.shape)), len(given["M"])
            raise RotorError(key, f"{name} is {shape}, and M has {size} rows: all are square matrices of one size")
        if not np.isfinite(A).all():
            raise RotorError(key, f"{name} holds a number that is not finite; write the file again")
        other, word = (-A.T, "skew-symmetric") if name == "G" else (A.T, "symmetric")
        apart = np.abs(A - other)
        if apart.max(initial=0.0) > SYMMETRY_REL * np.abs(A).max(initial=0.0):
            i, j = np.unravel_index(np.argmax(apart), A.shape)
            text = f"{name} is not {word} ({name}[{i}, {j}] = {A[i, j]:.4g}, {name}[{j}, {i}] = {A[j, i]:.4g})"
            raise RotorError(key, f"{text}: give the shaft with its discs alone, bearings and seals left out")


def rotor_of_table(table: RotorTable, given: Arrays, speed_rpm: float, high_hz: float) -> RotorMatrices:
    """The rotor reduced to its bearings, discs and the modes that matter up to high_hz. Raises RotorError."""
    per_node = int(given.get("dofs_per_node", np.zeros(())))
    size = len(given["M"])
    if per_node not in PLANES_OF_NODE:
        text = "is missing: say 1 (x), 2 (x and its slope), 4 (x, y, slope about x, slope about y) or 6 (as ROSS)"
        raise RotorError("dofs_per_node", text)
    if size % per_node:
        raise RotorError("dofs_per_node", f"{per_node}: the matrices have {size} rows, which is no multiple of it")
    nodes = size // per_node
    for key, own in (("bearings", table.bearings), ("discs", table.discs)):
        for name, node in own.items():
            if not 0 <= node < nodes:
                raise RotorError(key, f"{name} = {node}: the model has the nodes 0 to {nodes - 1}")
    M, K = given["M"], given["K"]
    C = given.get("C", np.zeros_like(M)) + 2 * np.pi * speed_rpm / 60.0 * given.get("G", np.zeros_like(M))
    key = "file" if table.file else "M"
    inner = PLANES_OF_NODE[per_node]
    if "y" not in inner:  # one plane: the other is alike
        if "G" in given:
            raise RotorError(key, "G couples two planes: give both, with dofs_per_node = 4 or 6, or leave G out")
        M, C, K = (np.asarray(np.kron(np.eye(2), A), np.float64) for A in (M, C, K))
    planes = {d: [per_node * k + i for k in range(nodes) for i in own] for d, own in inner.items()}
    if "y" not in planes:
        planes["y"] = [size + i for i in planes["x"]]
    for name, A in (("M", M), ("K", K)):
        if np.abs(A[np.ix_(planes["x"], planes["y"])]).max() > SYMMETRY_REL * np.abs(A).max():
            order = "x, y, slope about x, slope about y" if per_node == 4 else "those of ROSS"
            raise RotorError(key, f"{name} couples x and y: the degrees of freedom of a node have to be {order}")
        scale = np.sqrt(np.abs(np.diag(A)))
        row = next((i for own in planes.values() for i in own if A[i, i] <= 0.0), None)
        if row is not None:
            remedy = "condense what has no mass, or give it one" if name == "M" else "check its signs"
            raise RotorError(key, f"{name}[{row}, {row}] = {A[row, row]:g} is not above 0: {remedy}")
        scaled = A / scale[:, None] / scale
        least = min(float(np.linalg.eigvalsh(scaled[np.ix_(own, own)])[0]) for own in planes.values())
        if least < (MIN_MASS_REL if name == "M" else -SYMMETRY_REL):
            raise RotorError(key, f"{name} is not positive definite: no shaft has such a matrix; check its signs")
    of_node = {"x": 0, "y": inner["y"][0] if "y" in inner else size}
    names = table.bearings | table.discs
    named = {name: {d: per_node * node + of_node[d] for d in "xy"} for name, node in names.items()}
    try:
        return reduced_rotor(
            M, C, K, planes=planes, nodes=named, bearings=tuple(table.bearings), highest_hz=high_hz,
            damping_ratio=table.damping_ratio,
        )  # fmt: skip
    except ModelError as error:
        raise RotorError("bearings", str(error)) from error


def check_directions(table: RotorTable, rotor: RotorMatrices, places: Collection[str]) -> None:
    """Raises RotorError where gyroscopic moments couple a measured direction to one that is not measured."""
    x, y = ([i for i, dof in enumerate(rotor.dofs) if dof.endswith(f".{d}")] for d in "xy")
    alone = [p for p in places if p[:-1] + ("y" if p.endswith("x") else "x") not in places]
    if alone and rotor.C[np.ix_(x, y)].any():
        text = f"G couples x and y, and {alone[0].split('.')[0]} is measured in {alone[0][-1]} alone"
        raise RotorError("file" if table.file else "G", f"{text}: measure both directions, or leave G out")


def attachment(table: RotorTable, base: Path) -> dict[str, bytes]:
    """The matrices of a file, for a log."""
    if table.file is None:
        return {}
    target = io.BytesIO()
    np.savez_compressed(target, **read_matrices(table, base, {}))  # type: ignore[arg-type]
    return {ATTACHED_NAME: target.getvalue()}
