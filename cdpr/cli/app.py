"""The `cdpr` command: its verbs, and what happens to errors."""

from __future__ import annotations

import gc
import json
import sys
import tempfile
import traceback
from importlib.metadata import version
from typing import Annotated

import typer

from cdpr.cli.verbs import add_verbs
from cdpr.errors import CdprError

EPILOG = (
    "Exit codes: 0 ok, 1 fault, 2 bad input, 3 refused by a safety check,"
    " 4 hardware missing, 130 stopped by the operator."
)


def _tell_version(wanted: bool) -> None:
    if wanted:
        print(f"cdpr {version('cdpr')}")
        raise typer.Exit


def build_app() -> typer.Typer:
    """The whole command line."""
    app = typer.Typer(
        epilog=EPILOG,
        no_args_is_help=True,
        add_completion=True,
        rich_markup_mode="rich",
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_options)
    add_verbs(app)
    return app


def _options(
    _version: Annotated[
        bool,
        typer.Option(
            "--version", help="Show the version and exit.", callback=_tell_version, is_eager=True
        ),
    ] = False,
) -> None:
    """Plan, prove, run and measure paths of cable-driven parallel robots."""


def main() -> None:
    """Runs the command line; every error ends in one message and its exit code."""
    # Importing makes some 10^5 objects that stay; looking through them again and again for
    # rubbish took a tenth of the time of a plan.
    gc.set_threshold(100_000, 50, 50)
    try:
        build_app()()
    except CdprError as error:
        _tell(error)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    except Exception as error:
        _tell_bug(error)
        sys.exit(1)
    finally:
        # Nor is there rubbish to be found in them at the end, which took another fifth.
        gc.freeze()


def _tell(error: CdprError) -> None:
    if "--json" in sys.argv:
        print(json.dumps(error.as_dict(), indent=1))
    print(f"error: {error}", file=sys.stderr)


def _tell_bug(error: Exception) -> None:
    """An error nobody foresaw: one line for the user, the trace for us in a file."""
    with tempfile.NamedTemporaryFile(
        "w", prefix="cdpr-error-", suffix=".txt", delete=False, encoding="utf-8"
    ) as file:
        file.write("".join(traceback.format_exception(error)))
    print(
        f"error: {type(error).__name__}: {error}\n"
        "  why: this is a defect of cdpr, not of your input\n"
        f"  next: please report it with the file {file.name}",
        file=sys.stderr,
    )
