"""Ctrl-C, SIGTERM, a closed terminal at any step of a command that writes a file: all of it or nothing, at its end."""

from __future__ import annotations

import contextlib
import linecache
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

from daq.base.console import unfinished
from daq.base.console.output import write_whole
from daq.base.console.stop import all_or_nothing, unbroken
from daq.commands.cli import files
from daq.log.reader import read_log

RIG = Path(__file__).parents[3] / "configs" / "tiwari_vyas_1997.toml"
OPCODE_BY_OPCODE = ("base/console/stop", "base/console/unfinished", "log/file", "log/place")
LINE_BY_LINE = (
    "log/writer",
    "commands/files/importers",
    "log/recover",
    "commands/files/exporters",
    "commands/cli/files",
)
PACKAGE = Path(unfinished.__file__).parents[2]
COMMANDS: dict[str, Callable[[str], None]] = {
    "import": lambda name: files.import_(
        file=[Path("x.npz")], rig=Path("rig.toml"), out=Path(f"{name}.mcap"), quiet=True
    ),
    "recover": lambda name: files.recover(log=Path("l.mcap"), out=Path(f"{name}.mcap"), quiet=True),
    "export": lambda name: files.export(log=Path("l.mcap"), to=Path(f"{name}.npz"), quiet=True),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("anywhere")
    (folder / "rig.toml").write_bytes(RIG.read_bytes())
    y = np.arange(3000.0)
    np.savez(folder / "x.npz", rate_hz=25600.0, b1x=y, b1y=y, b2x=y, b2y=y)
    with contextlib.chdir(folder):
        COMMANDS["import"]("l")
        for command in COMMANDS.values():  # what is imported and compiled once is, from here on
            command("o")
        Path("o.mcap").unlink()
        Path("o.npz").unlink()
    return folder


class Interrupter:
    """Sends a signal to ourselves at the n-th step that this thread takes in our own files; 0 counts them only."""

    def __init__(self, at: int, number: signal.Signals) -> None:
        self.steps = 0
        self._at, self._number = at, number

    def __enter__(self) -> Interrupter:
        sys.settrace(self._called)
        return self

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)

    def _called(self, frame: FrameType, _event: str, _what: Any) -> Any:
        path = Path(frame.f_code.co_filename)
        own = str(path.relative_to(PACKAGE).with_suffix("")) if path.is_relative_to(PACKAGE) else ""
        if own not in (*OPCODE_BY_OPCODE, *LINE_BY_LINE):
            return None
        frame.f_trace_opcodes = own in OPCODE_BY_OPCODE  # a signal acts between two of them, not only between lines
        frame.f_trace_lines = not frame.f_trace_opcodes
        return self._step

    def _step(self, _frame: FrameType, event: str, _what: Any) -> Any:
        if event in ("line", "opcode"):
            self.steps += 1
            handled = signal.getsignal(self._number) is not signal.SIG_DFL  # else nothing is begun yet, or all is done
            if self.steps == self._at and handled:
                signal.raise_signal(self._number)
        return self._step


def steps(run: Callable[[], object]) -> int:
    with Interrupter(0, signal.SIGINT) as counted:
        run()
    return counted.steps


@pytest.fixture
def default_signals() -> Iterator[None]:
    """As a separate program has them, with SIGINT handled."""
    before = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # a log that was being read
@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize(
    ("what", "number"),
    [*((what, signal.SIGINT) for what in COMMANDS), ("import", signal.SIGTERM), ("recover", signal.SIGHUP)],
)
@pytest.mark.parametrize("tries", [50, pytest.param(200, marks=[pytest.mark.slow, pytest.mark.timeout(1200)])])
def test_all_of_the_file_or_none_of_it(
    folder: Path, what: str, number: signal.Signals, tries: int, record_property: Callable[[str, object], None]
) -> None:
    command = COMMANDS[what]
    before = {path.name for path in folder.iterdir()}
    handlers = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    with contextlib.chdir(folder):
        every = steps(lambda: command("o"))
        (new,) = {path for path in folder.iterdir() if path.name not in before}
        new.unlink()
        at = np.unique(np.linspace(1, every, tries).astype(int)).tolist()
        for step in at:
            done = False
            name = f"{what}-{number}-{tries}-{step}"  # its own: here, a thread that writes may outlive the interrupt
            with contextlib.suppress(KeyboardInterrupt), Interrupter(step, number):
                command(name)
                done = True
            unfinished.remove_all()  # as at the program's end
            whole = new.with_stem(name)
            left = {path.name for path in folder.iterdir()} - before
            assert left <= {whole.name}, step
            assert left or not done, step
            if left and whole.suffix == ".mcap":
                assert read_log(whole).complete
            whole.unlink(missing_ok=True)
            for n, handler in handlers.items():  # interrupted while it put them back
                signal.signal(n, handler)
    row = f"`{what}` stopped at any step | {number.name} at {len(at)} of its {every} steps | all or nothing"
    record_property("reliability", f"{row} | no half of a file")


class Locks(Interrupter):
    """Steps at which the log's lock is taken or let go, instead of a signal."""

    def __init__(self) -> None:
        super().__init__(0, signal.SIGINT)
        self.at: list[int] = []

    def _step(self, frame: FrameType, event: str, what: Any) -> Any:
        step = super()._step(frame, event, what)
        if event == "line" and "with self._changed" in linecache.getline(frame.f_code.co_filename, frame.f_lineno):
            self.at.append(self.steps)
        return step


@pytest.mark.timeout(60)
@pytest.mark.usefixtures("default_signals")
def test_a_signal_as_a_lock_is_let_go_leaves_no_writer_waiting(folder: Path) -> None:
    """It stayed held, the thread that writes waited for it, and the import for the thread, for ever."""
    with contextlib.chdir(folder):
        with Locks() as locks:
            COMMANDS["import"]("locks")
        Path("locks.mcap").unlink()
        assert locks.at
        for step in locks.at:
            with contextlib.suppress(KeyboardInterrupt), Interrupter(step, signal.SIGINT):
                COMMANDS["import"](f"o{step}")
            unfinished.remove_all()
            Path(f"o{step}.mcap").unlink(missing_ok=True)


@pytest.mark.usefixtures("default_signals")
def test_a_signal_waits_until_the_end_of_what_is_unbroken() -> None:
    done = []

    def interrupted_twice() -> None:
        with unbroken():
            signal.raise_signal(signal.SIGINT)
            with unbroken():
                signal.raise_signal(signal.SIGINT)
            done.append("all of it")

    with pytest.raises(KeyboardInterrupt):
        interrupted_twice()
    assert done == ["all of it"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures("default_signals")
def test_an_interrupt_that_a_library_swallowed_is_remembered(tmp_path: Path) -> None:
    with all_or_nothing():
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            unfinished.begin(tmp_path / "x")
    unfinished.remove_all()


@pytest.mark.usefixtures("default_signals")
def test_an_interrupt_that_a_library_made_another_error_of_is_one() -> None:
    @all_or_nothing()
    def command() -> None:
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise ValueError("SchemaError")  # pydantic's

    with pytest.raises(KeyboardInterrupt):
        command()


@pytest.mark.usefixtures("default_signals")
def test_a_small_file_is_the_old_or_the_new_one(tmp_path: Path) -> None:
    path = tmp_path / "r.html"
    every = steps(lambda: write_whole(path, "old"))
    for at in range(1, every + 1):
        write_whole(path, "old")
        with contextlib.suppress(KeyboardInterrupt), Interrupter(at, signal.SIGINT):
            write_whole(path, "new")
        assert path.read_text() in ("old", "new")
        assert [p.name for p in tmp_path.iterdir()] == ["r.html"]
