"""The house in order: sizes, names and imports of the source, asked of the files themselves (docs/decisions/0001)."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from estimator.effects import CATALOGUE

ROOT = Path(__file__).parents[1]
PACKAGES = ("estimator", "daq", "drivers")
PATCHES = {"setattr", "delattr", "setitem", "delitem"}  # of pytest's monkeypatch
# How many names that are not public a file of tests may take from the product, and why. It is to shrink.
LEAVES, SEAM = "leaves with the file that it tests", "no seam yet"
INSIDE = {
    "daq/commands/test_entry.py": (2, "the state of a process that has been interrupted"),
    "daq/log/test_place.py": (1, SEAM),
    "estimator/diagnosis/hypotheses/test_trial.py": (1, SEAM),
    "estimator/identification/batch/test_full_fit.py": (1, SEAM),
    "estimator/identification/batch/test_long_record.py": (1, "a record of a quarter of an hour takes too long"),
    "estimator/identification/residual/test_measured_path.py": (1, SEAM),
}
FILE_LINES = 400
FUNCTION_LINES = 60
CHAIN_FILES = {"estimator": 6, "daq": 7, "drivers": 5}  # of imports inside a folder; between rooms the layers hold
FOLDER_ENTRIES = {"estimator": 12, "daq": 16, "drivers": 16}  # files and folders, without marks for tools: 12 are asked
ROOMS = {"model", "effects", "signals", "likelihood", "simulation", "identification", "diagnosis"}
ROOT_FILES = {"__init__.py", "arrays.py", "errors.py", "parallel.py", "results.py", "py.typed"}
# Ratchets: a change may lower these numbers and never raise them.
EFFECT_NAMING_FILES = 0  # files of estimator/ outside effects/ with an effect's name in a string: none is the aim
MODULE_CONSTANTS = 188  # of estimator: names of data, codes and texts; at most 200 are wanted
ONE_WORD_CONSTANTS = {"estimator": 0, "daq": 0, "drivers": 0}  # upper-case, at module level: none is the aim
SAME_OPENINGS = 0  # docstrings in estimator/ that open with "The same": none is the aim
POSITIONAL_CALLS = 0  # constructions of classes with more than four positional arguments: none
REPEATED_FUNCTIONS = {
    "find", "left", "own", "seen", "judged", "moved", "alike", "told", "said", "plain", "at", "of", "along", "build",
    "gain", "response",
}  # fmt: skip
REPEATED = 0  # how many modules define one of these beyond the first of each name: none is the aim


@cache
def sources(package: str) -> dict[Path, ast.Module]:
    """The parsed files of a package."""
    return {path: ast.parse(path.read_text("utf-8")) for path in sorted((ROOT / package).rglob("*.py"))}


def functions(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    """Every function and method."""
    return (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


def constants(tree: ast.Module) -> Iterator[str]:
    """Upper-case names assigned at module level."""
    for node in tree.body:
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        for target in targets:
            for name in ast.walk(target):
                if isinstance(name, ast.Name) and name.id.isupper():
                    yield name.id


def one_word(package: str) -> list[str]:
    """Constants of one word: a name has to say quantity and unit. Names of effects' objects are no constants."""
    tables = {"CATALOGUE", "NAMED", "THRESHOLDS", "LIMITS"}  # of effects, and of a room's limits
    objects = {name.upper() for name in CATALOGUE} | tables
    return [
        f"{path.relative_to(ROOT)}: {name}"
        for path, tree in sources(package).items()
        for name in dict.fromkeys(constants(tree))
        if "_" not in name.strip("_") and name not in objects and len(name) > 1
    ]


def module_constants() -> list[str]:
    """Constants of modules in estimator: limits belong into the `Thresholds` of their room."""
    objects = {name.upper() for name in CATALOGUE} | {"THRESHOLDS", "LIMITS"}
    return [
        f"{path.relative_to(ROOT)}: {name}"
        for path, tree in sources("estimator").items()
        for name in dict.fromkeys(constants(tree))
        if name not in objects and len(name) > 1
    ]


def naming_effects() -> list[str]:
    """Files outside effects/ that hold the name of an effect as a string."""
    return [
        str(path.relative_to(ROOT))
        for path, tree in sources("estimator").items()
        if "effects" not in path.relative_to(ROOT).parts
        and any(
            isinstance(n, ast.Constant) and isinstance(n.value, str) and n.value in CATALOGUE for n in ast.walk(tree)
        )
    ]


def same_openings() -> list[str]:
    """Docstrings that open with "The same", in place of what the thing is."""
    return [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path, tree in sources("estimator").items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and (ast.get_docstring(node) or "").startswith("The same")
    ]


def positional_calls() -> list[str]:
    """Constructions of classes with more than four positional arguments."""
    return [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for package in PACKAGES
        for path, tree in sources(package).items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and re.fullmatch(r"_?[A-Z][a-z]\w*|cls", getattr(node.func, "id", getattr(node.func, "attr", "")))
        and len(node.args) > 4
    ]


def positional_fields() -> list[str]:
    """Dataclasses that can be constructed with more than four arguments by position."""
    return [
        f"{path.relative_to(ROOT)}: {node.name}"
        for package in PACKAGES
        for path, tree in sources(package).items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
        and any("dataclass" in (text := ast.unparse(d)) and "kw_only=True" not in text for d in node.decorator_list)
        and len(_fields_by_position(node)) > 4
    ]


def _fields_by_position(node: ast.ClassDef) -> list[str]:
    """Annotations of the fields before `_: KW_ONLY`."""
    kinds = [ast.unparse(line.annotation) for line in node.body if isinstance(line, ast.AnnAssign)]
    return [kind for kind in kinds[: kinds.index("KW_ONLY") if "KW_ONLY" in kinds else None] if "ClassVar" not in kind]


def repeated() -> list[str]:
    """Module-level functions of a name that says nothing, beyond the first of each name."""
    found = [
        node.name
        for tree in sources("estimator").values()
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and node.name in REPEATED_FUNCTIONS
    ]
    return [f"{name}: {count}" for name, count in Counter(found).items() for _ in range(count - 1)]


def neighbours(path: Path, tree: ast.Module) -> set[Path]:
    """The files of its own folder that a file imports when it runs."""
    package = ".".join(path.parent.relative_to(ROOT).parts)
    typing = {n for node in ast.walk(tree) if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
              for n in ast.walk(node)}  # fmt: skip
    names: list[str] = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.ImportFrom) or node in typing or node.level > 1:
            continue
        module = ".".join(filter(None, [package if node.level else "", node.module]))
        if module == package:
            names += [alias.name for alias in node.names]
        elif module.startswith(f"{package}."):
            names.append(module.removeprefix(f"{package}.").split(".")[0])
    return {there for name in names if (there := path.with_name(f"{name}.py")) != path and there.is_file()}


def chains(package: str) -> dict[str, int]:
    """The longest chain of imports inside each folder, in files. A table of limits imports nothing and is no link."""
    no_links = ("__init__.py", "thresholds.py")
    beside = {path: neighbours(path, tree) for path, tree in sources(package).items() if path.name not in no_links}

    @cache
    def length(path: Path) -> int:
        return 1 + max((length(other) for other in beside[path] if other in beside), default=0)

    out: dict[str, int] = {}
    for path in beside:
        folder = str(path.parent.relative_to(ROOT))
        out[folder] = max(out.get(folder, 0), length(path))
    return out


def product_modules(tree: ast.Module) -> dict[str, str]:
    """Modules of the product by the names that a test has them under."""
    return {
        alias.asname or alias.name: f"{node.module}.{alias.name}"
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in PACKAGES
        for alias in node.names
        if (path := ROOT / f"{node.module}.{alias.name}".replace(".", "/")).is_dir()
        or path.with_suffix(".py").is_file()
    }


def inside(tree: ast.Module) -> Iterator[str]:
    """Private names of the product that a test imports, and attributes of its modules that a test replaces."""
    modules = product_modules(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in PACKAGES:
            yield from (f"{node.module}.{alias.name}" for alias in node.names if alias.name.startswith("_"))
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules:
            if re.fullmatch(r"_[a-zA-Z]\w*", node.attr):
                yield f"{modules[node.value.id]}.{node.attr}"
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in PATCHES:
            match node.args:
                case [ast.Constant(str(name)), *_] if name.split(".")[0] in PACKAGES:
                    yield name
                case [ast.Name(module), ast.Constant(name), *_] if module in modules:
                    yield f"{modules[module]}.{name}"


@pytest.mark.parametrize("package", PACKAGES)
def test_no_file_is_long(package: str) -> None:
    long = {
        str(p.relative_to(ROOT)): n
        for p in sources(package)
        if (n := len(p.read_text("utf-8").splitlines())) > FILE_LINES
    }
    assert not long


@pytest.mark.parametrize("package", PACKAGES)
def test_no_function_is_long(package: str) -> None:
    long = [
        f"{path.relative_to(ROOT)}: {node.name} {length}"
        for path, tree in sources(package).items()
        for node in functions(tree)
        if (length := (node.end_lineno or 0) - node.lineno + 1) > FUNCTION_LINES
    ]
    assert not long


@pytest.mark.parametrize("package", PACKAGES)
def test_no_folder_is_crowded(package: str) -> None:
    folders = {path.parent for path in sources(package)}
    crowded = {
        str(f.relative_to(ROOT)): n
        for f in folders
        if (n := sum(entry.name not in ("__pycache__", "py.typed") for entry in f.iterdir())) > FOLDER_ENTRIES[package]
    }
    assert not crowded


@pytest.mark.parametrize("package", PACKAGES)
def test_no_chain_of_imports_inside_a_folder_is_long(package: str) -> None:
    assert {folder: n for folder, n in chains(package).items() if n > CHAIN_FILES[package]} == {}


def test_the_estimator_has_seven_rooms_and_five_files() -> None:
    entries = {entry.name for entry in (ROOT / "estimator").iterdir() if entry.name != "__pycache__"}
    assert entries == ROOMS | ROOT_FILES


def test_public_names_of_the_rooms_have_numpy_docstrings() -> None:
    """Where names of a room's `__init__` are defined. The laws of effects/ are recognised by their fields."""
    files = set()
    for path, tree in sources("estimator").items():
        if path.name == "__init__.py":
            for node in tree.body:
                if isinstance(node, ast.ImportFrom) and node.module:
                    at = path.parent if node.level == 1 else ROOT
                    files.add((at / node.module.replace(".", "/")).with_suffix(".py"))
    kinds = {"damping", "excitation", "rotating", "sensor", "stiffness"}
    found = [str(f) for f in files if f.is_file() and f.parent.name not in kinds]
    rules = ["--isolated", "--select=D", "--ignore=D105,D107,D401", '--config=lint.pydocstyle.convention="numpy"']
    done = subprocess.run([sys.executable, "-m", "ruff", "check", *rules, *found], capture_output=True, text=True)
    assert len(found) > 30
    assert done.returncode == 0, done.stdout


def test_other_packages_import_only_public_names_of_a_room() -> None:
    inner = []
    for path, tree in sources("daq").items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ("estimator", "drivers"):
                place = ROOT / str(node.module).replace(".", "/")
                if not place.is_dir() and place.with_suffix(".py").parent.name not in ("estimator", "drivers"):
                    inner.append(f"{path.relative_to(ROOT)}:{node.lineno} {node.module}")
    assert not inner


def test_array_types_come_from_one_file() -> None:
    own = [
        str(path.relative_to(ROOT))
        for path, tree in sources("estimator").items()
        for node in tree.body
        if isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Name)
        and node.targets[0].id in ("Array", "Floats", "Complexes", "Series")
        and path.name != "arrays.py"
    ]
    assert not own


def test_tests_take_the_public_names_of_the_product() -> None:
    found = {str(path.relative_to(ROOT / "tests")): {*inside(tree)} for path, tree in sources("tests").items()}
    beyond = {file: names for file, names in found.items() if len(names) > INSIDE.get(file, (0, ""))[0]}
    assert not beyond
    assert not {file for file, (most, _) in INSIDE.items() if not most or file not in found}


SHRINKING = {
    "files that name an effect": (naming_effects, EFFECT_NAMING_FILES),
    "constants of modules in estimator": (module_constants, MODULE_CONSTANTS),
    "constants of one word in estimator": (lambda: one_word("estimator"), ONE_WORD_CONSTANTS["estimator"]),
    "constants of one word in daq": (lambda: one_word("daq"), ONE_WORD_CONSTANTS["daq"]),
    "constants of one word in drivers": (lambda: one_word("drivers"), ONE_WORD_CONSTANTS["drivers"]),
    "openings with 'The same'": (same_openings, SAME_OPENINGS),
    "more than four positional arguments": (positional_calls, POSITIONAL_CALLS),
    "more than four fields by position": (positional_fields, POSITIONAL_CALLS),
    "repeated functions": (repeated, REPEATED),
}


@pytest.mark.parametrize("what", SHRINKING)
def test_what_is_to_shrink_does_not_grow(what: str) -> None:
    found, most = SHRINKING[what]
    here = found()
    assert len(here) <= most, here


if __name__ == "__main__":
    for title, (found, _) in SHRINKING.items():
        rows = found()
        print(f"\n{title}: {len(rows)}", *rows, sep="\n  ")
