"""The `cdpr` command: its verbs, and what happens to errors."""

from __future__ import annotations

import gc
import io
import json
import os
import sys
import tempfile
import traceback
from contextlib import suppress
from typing import Annotated, NoReturn

import typer

from cdpr.cli.verbs import LazyGroup
from model.errors import AlreadyExists, BadInput, CdprError, Fault
from model.files.reading import shown

EPILOG = (
    "Exit codes: 0 ok, 1 fault, 2 bad input, 3 refused by a safety check,"
    " 4 hardware missing, 130 stopped by the operator."
)


def _show_version(wanted: bool) -> None:
    if wanted:
        # Takes longer to import than all else here, and only this option needs it.
        from importlib.metadata import version

        print(f"cdpr {version('cdpr')}")
        raise typer.Exit


def build_app() -> typer.Typer:
    """The whole command line."""
    app = typer.Typer(
        cls=LazyGroup,
        epilog=EPILOG,
        no_args_is_help=True,
        add_completion=True,
        rich_markup_mode="rich",
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_options)
    return app


def _options(
    _version: Annotated[
        bool,
        typer.Option(
            "--version", help="Show the version and exit.", callback=_show_version, is_eager=True
        ),
    ] = False,
) -> None:
    """Plan, prove, run and measure paths of cable-driven parallel robots."""


def main() -> None:
    """Runs the command line; every error ends in one message and its exit code."""
    # Importing makes some 10^5 objects that stay; looking through them again and again for
    # rubbish took a tenth of the time of a plan.
    gc.set_threshold(100_000, 50, 50)
    _print_anything()
    try:
        build_app()()
    except SystemExit:
        _end_of_output()
        raise
    except CdprError as error:
        _end(error)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    except OSError as error:
        _end(_of_the_system(error))
    except MemoryError:
        _end(
            Fault(
                "not enough memory",
                next_step="reduce the problem size, or use a computer with more memory",
            )
        )
    except Exception as error:
        _print_defect(error)
        sys.exit(1)
    finally:
        # Nor is there rubbish to be found in them at the end, which took another fifth.
        gc.freeze()


def _print_anything() -> None:
    """A sign that the terminal cannot show, or a file name that is no text, ends no command."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _end(error: CdprError) -> NoReturn:
    with suppress(OSError):  # the cause may be that nothing can be written
        _print_error(error)
    with suppress(OSError):
        sys.stdout.flush()
    _forget_output()
    sys.exit(error.exit_code)


def _end_of_output() -> None:
    """What was printed is written before the command says that it went well."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:  # such as `cdpr … | head`
        _forget_output()
    except OSError as error:
        _end(_of_the_system(error))


def _forget_output() -> None:
    """The interpreter would try again to write it at its end, and complain."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _of_the_system(error: OSError) -> CdprError:
    """The operating system refused a file that a verb did not expect it to, or its output."""
    why = error.strerror or str(error)
    if error.filename is not None:
        hint = "check the path, its permissions and the free space"
        return BadInput(
            "the path cannot be used", where=shown(str(error.filename)), why=why, next_step=hint
        )
    hint = "check the output's destination and its free space"
    return Fault("the command could not write all its output", why=why, next_step=hint)


def _print_error(error: CdprError) -> None:
    if isinstance(error, AlreadyExists):  # the library knows no options
        error.next_step += ", or pass --force to replace it"
    if "--json" in sys.argv:
        print(json.dumps(error.as_dict(), indent=1))
    print(f"error: {error}", file=sys.stderr)


def _print_defect(error: Exception) -> None:
    """An unexpected error: one line for the user, the trace in a file."""
    with tempfile.NamedTemporaryFile(
        "w", prefix="cdpr-error-", suffix=".txt", delete=False, encoding="utf-8"
    ) as file:
        file.write("".join(traceback.format_exception(error)))
    print(
        f"error: {type(error).__name__}: {error}\n"
        "  why: this is a defect in cdpr, not in your input\n"
        f"  next: please report it with the file {file.name}",
        file=sys.stderr,
    )
