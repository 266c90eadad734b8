"""The logs of an archive and the rig file of each: patterns with named fields, on any file system that fsspec knows."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from daq.base.contract.errors import ConfigError, LogError
from daq.rig.rig import check_laws, load_rig

STAMP_KEYS = ("ETag", "etag", "mtime", "LastModified", "last_modified", "updated")  # a file system has one of them
FIELD_PATTERN = re.compile(r"\{(\w+)\}")
TOKEN_PATTERN = re.compile(r"\{\w+\}|\*\*/|\*\*|\*|\?|[^{*?]+|\{")
REMEDY_TEXT = "name the field in the pattern of the logs, such as 'archive/{machine}/**/*.mcap'"


@dataclass(frozen=True, slots=True, kw_only=True)
class RigSource:
    """A rig file as workers get it: they need not reach the file.

    path : absolute; "" where there is none. base : folder that paths in it start from. digest : of its text and
    its Python files. name : of the rig. problem : why it cannot be used; "" if it can.
    """

    path: str
    digest: str
    base: str = ""
    text: str = ""
    name: str = ""
    problem: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class LogSource:
    """A log of the archive.

    url : absolute path, or URL. stamp : changes when the file does. machine : the named fields of its path, or the
    name of its rig. rig : its rig file.
    """

    url: str
    stamp: str
    machine: str
    rig: RigSource


def find_logs(patterns: Sequence[str], rig_of: Callable[[str, dict[str, str]], RigSource]) -> list[LogSource]:
    """The files that patterns name, each once, in order. rig_of : from URL and named fields.

    Raises ConfigError if a pattern names none, or its file system cannot be reached.
    """
    found: dict[str, LogSource] = {}
    for pattern in patterns:
        before = len(found)
        for url, stamp, fields in _files(pattern):
            rig = rig_of(url, fields)
            machine = "/".join(fields.values()) or rig.name
            found.setdefault(url, LogSource(url=url, stamp=stamp, machine=machine, rig=rig))
        if len(found) == before and len(patterns) == 1:
            raise ConfigError(f"{pattern}: no file matches; check the pattern, and put it in quotes")
    if not found:
        raise ConfigError(f"{' '.join(patterns[:3])}: no file matches; check the patterns")
    return [found[url] for url in sorted(found)]


def _files(pattern: str) -> Iterator[tuple[str, str, dict[str, str]]]:
    """URL, stamp and named fields of each file that a pattern names."""
    import fsspec

    try:
        system, path = fsspec.core.url_to_fs(pattern)
        local = is_local(system)
        if system.isfile(path):
            listed = {path: system.info(path)}
        else:
            listed = system.glob(FIELD_PATTERN.sub("*", path), detail=True)
    except (OSError, ValueError, ImportError) as error:
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigError(f"{pattern}: cannot be listed: {text}; check the address, or install its protocol") from error
    form = _form(path)
    for name, about in listed.items():
        if about.get("type") == "file":
            match = form.fullmatch(name)
            fields = {} if match is None or match.re.groups == 0 else match.groupdict()
            yield name if local else system.unstrip_protocol(name), _stamp(about), fields


def is_local(system: Any) -> bool:
    """Whether a file system of fsspec is that of this computer."""
    return "file" in ((system.protocol,) if isinstance(system.protocol, str) else system.protocol)


def _stamp(about: dict[str, Any]) -> str:
    changed = next((str(about[key]) for key in STAMP_KEYS if about.get(key)), "")
    return f"{about.get('size')} {changed}"


def _form(pattern: str) -> re.Pattern[str]:
    """A pattern as a regular expression; {field} is a part of one folder's or file's name."""
    known: set[str] = set()
    out = ""
    for token in TOKEN_PATTERN.findall(pattern):
        if token == "**/":
            out += "(?:.*/)?"
        elif token == "**":
            out += ".*"
        elif token in ("*", "?"):
            out += "[^/]*" if token == "*" else "[^/]"
        elif token.startswith("{") and token.endswith("}"):
            name = token[1:-1]
            out += f"(?P={name})" if name in known else f"(?P<{name}>[^/]+?)"
            known.add(name)
        else:
            out += re.escape(token)
    return re.compile(out)


def read_rig(path: str) -> RigSource:
    """A rig file, checked; the same one is known again from wherever it is named. Raises ConfigError as `load_rig`."""
    rig = load_rig(path)
    check_laws(rig, Path(path))
    digest = hashlib.sha256(repr(sorted(rig.attachments().items())).encode()).hexdigest()
    whole = os.path.abspath(path)
    return RigSource(path=whole, base=os.path.dirname(whole), text=rig.text, digest=digest, name=rig.model.name)


def _unusable(path: str, problem: str) -> RigSource:
    return RigSource(path=path, digest=hashlib.sha256(problem.encode()).hexdigest(), problem=problem)


class RigsByField:
    """Finds the rig file of a log by `--rig-of 'rigs/{machine}.toml'`.

    A field that the pattern of the logs names too has the value that it has there. The value of another one is the
    name of a folder of the log's path, or of the log without its ending, for which a rig file exists.
    """

    def __init__(self, template: str) -> None:
        """Raises ConfigError for a template without a field."""
        if not FIELD_PATTERN.search(template):
            raise ConfigError(f"--rig-of {template}: names no field such as {{machine}}; one rig file for all is --rig")
        self._template = template
        self._rigs: dict[str, RigSource] = {}
        self._there: dict[str, list[str]] = {}

    def __call__(self, url: str, fields: dict[str, str]) -> RigSource:
        """The rig file of a log, or why there is none. Fields that were found are added to `fields`."""
        template = self._template
        for name, value in fields.items():
            template = template.replace(f"{{{name}}}", value)
        names = FIELD_PATTERN.findall(template)
        if not names:
            return self._read(template)
        path = PurePosixPath(url)
        parts = {*path.parts[:-1], path.stem}
        fit = {}
        form = _form(template)
        for file in self._files(template):
            match = form.fullmatch(file)
            if match is not None and parts.issuperset(match.groupdict().values()):
                fit[file] = match.groupdict()
        if len(fit) == 1:
            file, found = next(iter(fit.items()))
            fields |= found
            return self._read(file)
        if fit:
            return _unusable("", f"{url}: {' and '.join(sorted(fit)[:3])} both fit its path; {REMEDY_TEXT}")
        text = f"{url}: no rig file {self._template} has the name of a folder of its path; add it, or {REMEDY_TEXT}"
        return _unusable("", text)

    def _files(self, template: str) -> list[str]:
        """Rig files that there are, as the template names them."""
        if template not in self._there:
            from glob import glob

            self._there[template] = sorted(glob(FIELD_PATTERN.sub("*", template)))
        return self._there[template]

    def _read(self, path: str) -> RigSource:
        if path not in self._rigs:
            try:
                self._rigs[path] = read_rig(path)
            except (ConfigError, LogError) as error:
                self._rigs[path] = _unusable(os.path.abspath(path), str(error).splitlines()[0])
        return self._rigs[path]
