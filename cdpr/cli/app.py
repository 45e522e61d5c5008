"""The `cdpr` command: a table of verbs, imported when called, and error reporting."""

from __future__ import annotations

import errno
import gc
import inspect
import io
import json
import os
import re
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, NoReturn

import typer
from rich.markup import escape
from typer.core import TyperCommand, TyperGroup

import cdpr
from cdpr.cli.arguments import as_command, flag
from model.errors import (
    BadInput,
    CdprError,
    Fault,
    require_not_empty,
    without_passwords,
)
from model.files.reading import ready_folder, shown
from model.lazy import hidden_package


@dataclass(frozen=True, slots=True)
class Verb:
    """A verb or a group of verbs.

    Attributes:
        name: As typed on the command line.
        target: ``module:function`` below `cdpr.cli`; empty for a group.
        verbs: Members of a group.
        about: A group's help text.
    """

    name: str
    target: str = ""
    verbs: tuple[Verb, ...] = ()
    about: str = ""

    @property
    def help(self) -> str:
        """A group's help text, or the first line of a verb's docstring; imports nothing."""
        if self.verbs:
            return self.about
        module, _, function = self.target.partition(":")
        file = Path(__file__).parent.joinpath(*module.split(".")).with_suffix(".py")
        found = re.search(rf'^def {function}\(.*?"""(.*?)\n', file.read_text("utf-8"), re.M | re.S)
        assert found is not None, f"no docstring of {self.target}"
        return found.group(1)


def _verbs(*targets: str) -> tuple[Verb, ...]:
    """Verbs by modules below `cdpr.cli` and their functions, ``module:function,function``.

    A function named after a Python keyword or built-in ends in an underscore.
    """
    split = [(module, names) for module, _, names in (one.partition(":") for one in targets)]
    return tuple(
        Verb(name.rstrip("_"), f"{module}:{name}")
        for module, names in split
        for name in names.split(",")
    )


CALIBRATE = _verbs(
    "calibrate.camera:camera,extrinsics,readout,tags",
    "calibrate.rig:poses,rig",
    "calibrate.boards:print_",
    "calibrate.results:diff,apply,export,import_",
)
BENCH = _verbs("studies:paper")
PANELS: dict[str, tuple[Verb, ...]] = {
    "Plan": _verbs("operate.console:demo", "start:examples,new", "plan:plan", "check:check"),
    "Operate": _verbs(
        "operate.run:run",
        "operate.requests:stop,hold,resume,speed",
        "operate.console:console",
        "operate.monitor:monitor",
        "operate.service:status,reset",
        "operate.home:home",
        "operate.jog:jog",
        "operate.service:release",
    ),
    "Set up": (
        *_verbs("doctor:doctor", "sim:sim"),
        Verb(
            "calibrate",
            verbs=CALIBRATE,
            about="Calibrate cameras, tags and the rig; print targets; compare, convert results.",
        ),
    ),
    "Measure": _verbs("track:track"),
    "Analyse": (
        *_verbs("operate.run:report", "check:explain", "studies:workspace"),
        Verb("bench", verbs=BENCH, about="Measure the planner."),
    ),
}
VERBS = tuple(verb for verbs in PANELS.values() for verb in verbs)


class LazyGroup(TyperGroup):
    """A command group over a table; help and completion of names import no verb's module."""

    def __init__(self, verbs: tuple[Verb, ...] = VERBS, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.verbs = verbs
        panels = {verb: panel for panel, members in PANELS.items() for verb in members}
        self.commands = {
            verb.name: TyperCommand(verb.name, help=verb.help, rich_help_panel=panels.get(verb))
            for verb in self.verbs
        }

    def loaded(self, name: str) -> TyperCommand | TyperGroup:
        """The verb itself, with its options, from its module."""
        return _loaded(next(verb for verb in self.verbs if verb.name == name))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """As in Typer, but imports the verb that is called."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, self.loaded(name) if command is not None and name else command, rest


def _loaded(verb: Verb) -> TyperCommand | TyperGroup:
    if verb.verbs:
        return LazyGroup(
            verb.verbs,
            name=verb.name,
            help=verb.help,
            no_args_is_help=True,
            rich_markup_mode="rich",
        )
    module, _, function = verb.target.partition(":")
    app = typer.Typer(rich_markup_mode="rich", add_completion=False)
    called = getattr(import_module(f"cdpr.cli.{module}"), function)
    app.command(verb.name, cls=_VerbCommand, help=_help_of(called))(as_command(called))
    command: Any = typer.main.get_command(app)
    return command  # type: ignore[no-any-return]


def _help_of(verb: Callable[..., None]) -> str:
    """A verb's docstring as Typer displays it, which joins the lines of a paragraph.

    A heading is dimmed, and each example becomes a paragraph.
    """
    text = re.sub(r"^([A-Z][a-z ]+:)$", r"[dim]\1[/dim]", inspect.getdoc(verb) or "", flags=re.M)
    text = re.sub(r"\n  (?=cdpr )", r"\n\n  ", text)
    return re.sub(r"\n {6}(?=-)", r"\n  ", text)


class _VerbCommand(TyperCommand):
    """A verb whose points are always typed as X Y Z, and whose values are never empty."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """As in Typer, after joining each point into one word.

        Raises:
            BadInput: A value is empty, such as an unset variable of the shell.
        """
        words = joined_points(args)
        try:
            rest = super().parse_args(ctx, list(words))
        except Exception as error:  # Typer's messages repeat what was typed
            if isinstance(text := getattr(error, "message", None), str):
                error.message = without_passwords(text)  # type: ignore[attr-defined]
            raise
        if not ctx.resilient_parsing:  # then a word is still being completed
            self._require_values(ctx, words)
        return rest

    def _require_values(self, ctx: Any, words: list[str]) -> None:
        """Checks the words: `Path` turns an empty one into the current folder."""
        typed, _, _ = self.make_parser(ctx).parse_args(words)
        for parameter in self.params:
            given = typed.get(parameter.name or "")
            for value in given if isinstance(given, (list, tuple)) else [given]:
                if isinstance(value, str):
                    require_not_empty(max(parameter.opts, key=len), value)


def joined_points(arguments: Sequence[str]) -> list[str]:
    """The arguments with the three words after each ``--via-mm`` joined into one.

    Typer supports options with three values and repeatable options, but not both at once.
    """
    words = iter(arguments)
    joined: list[str] = []
    for word in words:
        joined.append(word)
        if word == "--via-mm":
            joined.append(" ".join(islice(words, 3)))
    return joined


EPILOG = (
    "Exit codes: 0 ok, 1 fault, 2 bad input, 3 refused by a safety check,"
    " 4 hardware missing, 130 stopped by the operator."
    f"\n\nDocumentation (docs/ in help texts): {ready_folder('docs')}"
)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"cdpr {cdpr.__version__}")
        raise typer.Exit


def build_app() -> typer.Typer:
    """The whole command line."""
    app = typer.Typer(
        cls=LazyGroup,
        epilog=escape(EPILOG),
        no_args_is_help=True,
        add_completion=True,
        rich_markup_mode="rich",
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(as_command(_options))
    return app


def _options(
    *,
    _version: bool = flag(
        "Show the version and exit.", "--version", callback=_show_version, is_eager=True
    ),
) -> None:
    """Plan, prove, run and measure paths of cable-driven parallel robots."""


def main() -> None:
    """Runs the command line; every error ends in one message and its exit code."""
    # Imports create some 10^5 permanent objects; garbage collection over them took a tenth of
    # the time of a plan.
    gc.set_threshold(100_000, 50, 50)
    os.environ["MPLBACKEND"] = "agg"  # no verb opens a window; the user's may be invalid
    _replace_closed_streams()
    _escape_unprintable()
    try:
        build_app()()
    except SystemExit:
        _flush_output()
        raise
    except CdprError as error:
        _exit_with(error)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    except OSError as error:
        _exit_with(_from_os_error(error))
    except MemoryError:
        _exit_with(
            Fault(
                "not enough memory",
                next_step="reduce the problem size, or use a computer with more memory",
            )
        )
    except Exception as error:
        _refuse_hidden_package(error)
        _print_defect(error)
        sys.exit(1)
    finally:
        # The final collection took another fifth.
        gc.freeze()


def _replace_closed_streams() -> None:
    """Opens `os.devnull` for streams that were closed before the start (``<&-``, ``2>&-``).

    In order of their numbers, so that each gets its own: a file or a socket that is opened later
    would get it, here or in a child process, and receive what is meant for the terminal.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = Path(os.devnull).open(mode, encoding="utf-8")  # noqa: SIM115  # to the end
            os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)


def _escape_unprintable() -> None:
    """Escapes characters that the terminal or its encoding cannot show, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _exit_with(error: CdprError) -> NoReturn:
    with suppress(OSError):  # the cause may be that nothing can be written
        print(f"error: {error}", file=sys.stderr)
    with suppress(OSError):
        if "--json" in sys.argv:
            print(json.dumps(error.as_dict(), indent=1))
        sys.stdout.flush()
    _discard_output()
    sys.exit(error.exit_code)


def _flush_output() -> None:
    """Flushes the output before the command exits with success."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:  # such as `cdpr … | head`
        _discard_output()
    except OSError as error:
        _exit_with(_from_os_error(error))


def _discard_output() -> None:
    """Discards unwritten output; the interpreter would retry at exit and complain."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _from_os_error(error: OSError) -> CdprError:
    """An `OSError` that no verb handled, as bad input (a path) or a fault (the output)."""
    why = error.strerror or str(error)
    if isinstance(error, FileNotFoundError) and not _current_folder_exists():
        hint = "change to a folder that exists, then repeat the command"
        return BadInput("the current folder was removed", next_step=hint)
    if error.filename is not None:
        hint = "check the path, its permissions and the free space"
        return BadInput(
            "the path cannot be used", where=shown(str(error.filename)), why=why, next_step=hint
        )
    if error.errno in (errno.EMFILE, errno.ENFILE):
        hint = "allow more open files, for instance `ulimit -n 1024`"
        return Fault("the system allows no more open files", why=why, next_step=hint)
    hint = "check the output's destination and its free space"
    return Fault("the command could not write all its output", why=why, next_step=hint)


def _current_folder_exists() -> bool:
    try:
        return Path.cwd().is_dir()
    except OSError:
        return False


def _refuse_hidden_package(error: Exception) -> None:
    """Reports the user's file or folder, where it hides one of our packages, and exits."""
    if isinstance(error, ImportError) and (hidden := hidden_package(error)):
        package, path = hidden
        _exit_with(
            BadInput(
                f"this file or folder hides the package `{package}` of cdpr",
                where=shown(path),
                why="Python finds it first, as in a folder of PYTHONPATH",
                next_step="take that folder out of PYTHONPATH (unset PYTHONPATH), or rename it",
            )
        )


def _print_defect(error: Exception) -> None:
    """Reports an unexpected error: one line for the user, the traceback in a file."""
    with tempfile.NamedTemporaryFile(
        "w", prefix="cdpr-error-", suffix=".txt", delete=False, encoding="utf-8"
    ) as file:
        file.write(without_passwords("".join(traceback.format_exception(error))))
    print(
        f"error: {type(error).__name__}: {without_passwords(str(error))}\n"
        "  why: this is a defect in cdpr, not in your input\n"
        f"  next: please report it with the file {file.name}",
        file=sys.stderr,
    )
