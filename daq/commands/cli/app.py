"""The command `rotorscope`: builds the application, and turns errors into one line and an exit status."""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from collections.abc import Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

# our matrices are small: a threaded BLAS only makes threads wait (diagnose on a busy machine: 4 times)
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from daq.base.console.output import print_note, to_nowhere  # noqa: E402
from daq.base.console.stop import asked  # noqa: E402
from daq.base.contract.errors import exit_status  # noqa: E402

from . import analyse, archive, demo, files, live, model, trend  # noqa: E402
from .options import switch  # noqa: E402

INTERRUPTED_STATUS = 130  # 128 + SIGINT
ABOUT_TEXT = (
    "Acquire bearing vibration, identify the rotor's stiffness from it, and learn which physics the model lacks."
)
EPILOG_TEXT = (
    "Exit status: 0 fine, 1 the check asked for failed, 2 bad usage or configuration, 3 link, 4 log or data, "
    "130 interrupted."
)


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        print(f"rotorscope {version('rotorscope')}")  # noqa: T201
        raise typer.Exit


class _HelpIsASwitch:
    """Of a command: its help shows no type beside --help, as beside any other switch."""

    def get_help_option(self, ctx: Any) -> Any:
        option: Any = super().get_help_option(ctx)  # type: ignore[misc]
        if option is not None:
            option.metavar = ""
        return option


class _Command(_HelpIsASwitch, TyperCommand):
    pass


class _Group(_HelpIsASwitch, TyperGroup):
    pass


def application(only: str = "") -> typer.Typer:
    """All commands, in the order in which --help shows them, or one: to build all takes longer than to run some."""
    app = typer.Typer(
        cls=_Group,
        help=ABOUT_TEXT,
        epilog=EPILOG_TEXT,
        add_completion=False,
        no_args_is_help=True,
        context_settings={"help_option_names": ["-h", "--help"]},
        pretty_exceptions_enable=False,
    )

    @app.callback()
    def rotorscope(
        version: Annotated[bool, switch("--version", callback=_version, is_eager=True, help="Print it.")] = False,
    ) -> None:
        pass

    for group in (demo, live, trend, analyse, archive, model, files):
        group.register(app)
    for command in app.registered_commands:
        command.cls = _Command
    named = [c for c in app.registered_commands if only == (c.name or getattr(c.callback, "__name__", None))]
    app.registered_commands = named or app.registered_commands
    return app


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; its exit status."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    verbose = "--verbose" in arguments or "-v" in arguments
    usage_error: Any = typer.BadParameter.__base__
    try:
        status = application(*arguments[:1])(arguments, prog_name="rotorscope", standalone_mode=False)
        sys.stdout.flush()
        if status == INTERRUPTED_STATUS:  # as typer has it
            raise KeyboardInterrupt
        return status if isinstance(status, int) else 0
    except usage_error as error:
        command = error.ctx.command_path if error.ctx is not None else "rotorscope"
        if type(error).__name__ == "NoArgsIsHelpError":
            print(error.format_message(), file=sys.stderr)  # noqa: T201
            return 2
        text = error.format_message().rstrip(".").replace("\n", " ").replace("Value error, ", "")
        return _failed(f"{text}; see {command} --help", 2, verbose)
    except (KeyboardInterrupt, typer.Abort) as error:
        if isinstance(error.__cause__, EOFError):  # typer takes it for Ctrl-D at a question, and we ask none
            return _unexpected(error.__cause__, verbose)
        return _failed("interrupted", INTERRUPTED_STATUS, verbose=False)
    except BrokenPipeError:  # the reader of our output has seen enough
        with contextlib.suppress(OSError):
            to_nowhere(sys.stdout)
        return 0
    except SystemExit as error:  # of the help's printer, where nobody reads on
        if isinstance(error.__context__, BrokenPipeError):
            return 0
        raise
    except Exception as error:
        if _interrupted(error):
            return _failed("interrupted", INTERRUPTED_STATUS, verbose=False)
        status = exit_status(error)
        if status is not None:
            return _failed(str(error), status, verbose)
        if isinstance(error, OSError) and error.filename is not None and error.strerror:  # of a name none has looked at
            return _failed(f"{error.filename}: {error.strerror}; choose another name or place", 4, verbose)
        return _unexpected(error, verbose)


def _unexpected(error: Exception, verbose: bool) -> int:
    text = f"unexpected {type(error).__name__}: {error}; run it again with --verbose and report what it prints"
    return _failed(text, 1, verbose)


def _interrupted(error: BaseException | None) -> bool:
    """Python and libraries wrap what they were interrupted with (3.11, in `__set_name__`: RuntimeError)."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None or asked()


def _failed(text: str, status: int, verbose: bool) -> int:
    if verbose:
        traceback.print_exc()
    for line in text.splitlines() or [""]:
        print_note(line)
    return status
