"""The public names of the packages: their examples run, and their docstrings say what is taken, returned and raised."""

from __future__ import annotations

import dataclasses
import doctest
import importlib
import inspect
import re
from pathlib import Path
from typing import Any

import pytest

PACKAGES = ("estimator", "daq")
ROOT = Path(__file__).parents[1]
SECTIONS = ("Parameters", "Returns", "Raises")
UNDOCUMENTED = 15  # functions without a section and classes with a field that is not explained: none is the aim

NAMES = {
    f"{package}.{name}": (package, name) for package in PACKAGES for name in importlib.import_module(package).__all__
}


def public(name: str) -> Any:
    """The object behind a public name."""
    package, inner = NAMES[name]
    return getattr(importlib.import_module(package), inner)


def examples(name: str) -> list[doctest.DocTest]:
    """The examples in the docstring of a public function or class and of its methods."""
    value = public(name)
    found = doctest.DocTestFinder().find(value, name, globs={}) if callable(value) else []
    return [test for test in found if test.examples]


def undocumented(name: str) -> list[str]:
    """What the docstring of a public name leaves out: sections of a function, fields of a dataclass."""
    value = public(name)
    text = inspect.getdoc(value) or ""
    if inspect.isfunction(value):
        return [section for section in SECTIONS if not re.search(rf"^{section}\n-+$", text, re.MULTILINE)]
    if dataclasses.is_dataclass(value):
        fields = [field.name for field in dataclasses.fields(value) if field.init]
        return [field for field in fields if not re.search(rf"\b{field}\b.* : ", text)]
    return []


@pytest.mark.parametrize("name", [name for name in NAMES if examples(name)])
def test_the_examples_of_a_public_name_run(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the root of the repository, from which they name files."""
    monkeypatch.chdir(ROOT)
    for example in examples(name):
        said: list[str] = []
        doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example, out=said.append)
        assert not said, "".join(said)


def test_public_names_say_what_they_take_return_and_raise() -> None:
    found = {name: missing for name in NAMES if (missing := undocumented(name))}
    assert len(found) <= UNDOCUMENTED, found
