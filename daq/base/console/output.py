"""Output of a command: tables for people, JSON for programs, progress on a terminal only."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TextIO

from daq.base.contract.errors import ConfigError, no_folder, not_written

from . import unfinished
from .file_kinds import IMPORTED_SUFFIXES, LOG_MAGIC
from .ticking import ticking

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType

PIPE_WIDTH = 160
MIN_WIDTH, MAX_WIDTH = 20, 10_000  # columns that may be asked for
REDRAW_S = 0.5  # so that the time goes on between two calls
CONTROL_CHARACTERS = {c: "\N{REPLACEMENT CHARACTER}" for c in (*range(32), *range(127, 160)) if chr(c) not in "\n\t"}
# the reader of the output has left: the pipe is closed, the terminal hung up
READER_GONE_ERRNOS = (errno.EPIPE, errno.EIO)


@cache
def version() -> str:
    """Version of the package that is installed."""
    try:
        return metadata.version("rotorscope")
    except metadata.PackageNotFoundError:
        return "(not installed)"


class Progress(Protocol):
    """Called with the share that is done, 0 to 1, and optionally the present step."""

    def __call__(self, done: float, what: str = "", /) -> None: ...


def quiet_progress(done: float, what: str = "", /) -> None:
    """For callers without a terminal."""


@dataclass(frozen=True, slots=True)
class Output:
    """Output of one command. json : path of the JSON result, "-" for standard output (then nothing else goes there)."""

    json: str | None = None
    quiet: bool = False
    verbose: bool = False

    def __post_init__(self) -> None:
        if self.json is not None and self.json != "-":
            spare(Path(self.json), ".toml")

    @property
    def to_stdout(self) -> Console:
        return _console(soft_wrap=False, highlight=False, width=None if sys.stdout.isatty() else pipe_width())

    @property
    def to_stderr(self) -> Console:
        return _console(stderr=True, soft_wrap=True, highlight=False)

    def prepare(self) -> None:
        """Import the libraries for a result early, not at the stop of a session."""
        if not self.quiet and self.json != "-":
            _ = self.to_stdout

    def say(self, *parts: RenderableType) -> None:
        """Print for people on standard output, or on standard error if JSON goes to standard output."""
        if self.quiet:
            return
        console = self.to_stderr if self.json == "-" else self.to_stdout
        wrapped = self.json != "-" and (sys.stdout.isatty() or asked_width() is not None)  # at words
        with ignoring_no_reader(sys.stderr if self.json == "-" else sys.stdout):
            for part in parts:
                if isinstance(part, str):
                    console.print(part, markup=False, emoji=False, soft_wrap=not wrapped)
                else:
                    console.print(part)

    def note(self, text: str) -> None:
        """Print a remark that is not the result on standard error."""
        if not self.quiet:
            print_note(text)

    def detail(self, text: str) -> None:
        if self.verbose:
            print_note(text)

    def result(self, value: dict[str, Any], *people: RenderableType) -> None:
        """The result of the command, once: for people, and as JSON if that was asked for."""
        if self.json != "-":
            self.say(*people)
        if self.json is None:
            return
        value = ({"version": version()} | value) if "schema" in value else value
        text = json.dumps(finite(value), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        if self.json == "-":
            with ignoring_no_reader(sys.stdout):
                sys.stdout.write(text)
                sys.stdout.flush()
        else:
            write_whole(Path(self.json), text)

    @contextlib.contextmanager
    def progress(self, what: str) -> Iterator[Progress]:
        """A bar on a terminal, silence in a pipe."""
        if self.quiet or not sys.stderr.isatty():
            yield quiet_progress
            return
        from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as Bar

        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn())
        # Without a separate thread: the estimator uses two processes only where this one has one thread.
        with Bar(*columns, TimeElapsedColumn(), console=self.to_stderr, transient=True, auto_refresh=False) as bar:
            task = bar.add_task(what, total=None)
            bar.refresh()

            def update(done: float, now: str = "", /) -> None:
                text = f"{what}: {now}" if now else what
                bar.update(task, total=1.0, completed=min(max(done, 0.0), 1.0), description=text, refresh=True)

            with ticking(REDRAW_S, bar.refresh):
                yield update


def pipe_width() -> int:
    """Columns of a pipe or a file: the value of COLUMNS, else PIPE_WIDTH."""
    return asked_width() or PIPE_WIDTH


def asked_width() -> int | None:
    """The value of COLUMNS; None if it is not set or out of range."""
    asked = os.environ.get("COLUMNS", "")
    return int(asked) if asked.isdigit() and MIN_WIDTH <= int(asked) <= MAX_WIDTH else None


def print_note(text: str) -> None:
    """Print a line on standard error. A failure to print (no terminal, a full disk) is ignored."""
    with contextlib.suppress(OSError):
        print(f"rotorscope: {text}".translate(CONTROL_CHARACTERS), file=sys.stderr, flush=True)  # noqa: T201


def to_nowhere(stream: TextIO) -> None:
    """Discard all further output to a stream, including its buffer."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


@contextlib.contextmanager
def ignoring_no_reader(stream: TextIO) -> Iterator[None]:
    """Discard output to a pipe or terminal that is gone; the command goes on."""
    try:
        yield
    except OSError as error:
        if error.errno not in READER_GONE_ERRNOS:
            raise
        to_nowhere(stream)


def _console(**options: Any) -> Console:
    """A console to which texts of devices and files cannot send control characters."""
    from rich.console import Console
    from rich.segment import Segment

    class Pipe(Console):
        def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
            for text, style, control in super().render(renderable, options):
                yield Segment(text if control else text.translate(CONTROL_CHARACTERS), style, control)

        def on_broken_pipe(self) -> None:  # rich would end the process with status 1
            raise BrokenPipeError(errno.EPIPE, "nobody reads it")

    return Pipe(**options)


def finite(value: Any) -> Any:
    """The value with numpy's numbers as Python's, and None for numbers that are not finite."""
    if isinstance(value, dict):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    if hasattr(value, "tolist"):
        return finite(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def spare(path: Path, *others: str) -> None:
    """Of a result that is to be written there. Raises ConfigError if a log, a data file, or a file of another ending
    that it is not to replace, would be lost."""
    if not path.is_file():
        return
    from drivers.foreign import CAPTURE_SUFFIXES

    kept = (".mcap", *IMPORTED_SUFFIXES, *CAPTURE_SUFFIXES, *others)
    with contextlib.suppress(OSError), path.open("rb") as file:
        if path.suffix.lower() in kept or file.read(len(LOG_MAGIC)) == LOG_MAGIC:
            raise ConfigError(f"{path}: a result is not written over a file of this kind; choose another name")


def check_place(option: str, path: Path) -> None:
    """Refuse a place where a result could not be written, before the work is done. Raises ConfigError.

    option : that gives the place, for the message.
    """
    if folder := no_folder(path):
        raise ConfigError(f"{option} {path}: {folder}")
    if path.is_dir():
        raise ConfigError(f"{option} {path}: is a folder; give the name of a file")
    place = path if path.exists() else path.absolute().parent
    if not os.access(place, os.W_OK):
        raise ConfigError(f"{option} {path}: no permission to write there; choose another place")


def write_whole(path: Path, data: str | bytes) -> None:
    """Write a file so that no reader ever sees half of it. Raises ConfigError or LogError if this fails.

    What no text can hold, such as a file's name that is none, is written as JSON has it.
    """
    spare(path)
    try:
        unfinished.write(path, data.encode(errors="backslashreplace") if isinstance(data, str) else data)
    except OSError as error:
        raise not_written(path, error) from error
