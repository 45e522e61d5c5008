"""Arguments and options of the verbs: their declaration, and checks that all verbs share.

A verb declares each as a parameter, ``cost: float = option("help", default=1.0)``. Options that
belong together are the fields of a dataclass, which is then one parameter of the verb. Invalid
paths, outputs that would overwrite an input or each other, and numbers beyond any machine are
refused here, before a verb opens or writes anything.
"""

from __future__ import annotations

import inspect
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, Field, field, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_type_hints, overload

import typer

from model.errors import AlreadyExists, BadInput, CdprError, StoppedByOperator
from model.files.output import file_identity, refuse_overwriting
from model.files.reading import shown

T = TypeVar("T")


@overload
def option(text: str, *names: str, default: T, **more: Any) -> T: ...


@overload
def option(text: str, *names: str, **more: Any) -> None: ...


def option(text: str, *names: str, default: Any = None, **more: Any) -> Any:
    """Declares an option.

    Args:
        text: As the help displays it.
        names: How it is typed (default: as the parameter).
        default: The value where it is not given.
        more: See `typer.Option`, such as ``min`` and ``metavar``.
    """
    return field(default=default, metadata=_declaration(typer.Option, text, names, more))


def flag(text: str, *names: str, **more: Any) -> bool:
    """Declares an option without a value, false unless it is given; see `option`."""
    return option(text, *names, default=False, **more)


def required(text: str, *names: str, **more: Any) -> Any:
    """Declares an option that must be given; see `option`."""
    return option(text, *names, default=MISSING, **more)


def argument(text: str, metavar: str | None = None, *, default: Any = MISSING, **more: Any) -> Any:
    """Declares a positional argument; without a default it must be given; see `option`."""
    more["metavar"] = metavar
    return field(default=default, metadata=_declaration(typer.Argument, text, (), more))


def _declaration(
    kind: Callable[..., Any], text: str, names: tuple[str, ...], more: dict[str, Any]
) -> dict[str, Any]:
    return {"kind": kind, "names": names, "more": {"help": text, **more}}


def as_command(verb: Callable[..., None]) -> Callable[..., None]:
    """The verb with one parameter per option, annotated as Typer reads it.

    It checks the values first. Errors name its options where the library names its arguments.
    Ctrl-C outside a run counts as the operator's stop.
    """
    expanded: dict[str, list[inspect.Parameter]] = {}
    groups: dict[str, Any] = {}
    typed: dict[str, str] = {}
    for one in inspect.signature(verb, eval_str=True).parameters.values():
        declared = [(one.name, one.annotation, one.default)]
        if is_dataclass(one.annotation):
            groups[one.name], hints = one.annotation, get_type_hints(one.annotation)
            declared = [(each.name, hints[each.name], each) for each in fields(one.annotation)]
        expanded[one.name] = [_parameter(*each) for each in declared]
        typed |= {name: _typed(name, declaration) for name, _, declaration in declared}

    @wraps(verb)
    def command(**values: Any) -> None:
        try:
            check_arguments(values, typed)
            for name, group in groups.items():
                values[name] = group(**{p.name: values.pop(p.name) for p in expanded[name]})
            verb(**values)
        except CdprError as error:
            name_options(error, typed)
            raise
        except KeyboardInterrupt:
            raise StoppedByOperator("interrupted") from None

    parameters = [parameter for each in expanded.values() for parameter in each]
    as_seen: Any = command
    as_seen.__signature__ = inspect.Signature(parameters)
    as_seen.__annotations__ = {p.name: p.annotation for p in parameters}
    return command


def _parameter(name: str, kind: Any, declared: Field[Any]) -> inspect.Parameter:
    names = declared.metadata["names"]
    if kind is bool and not names:
        names = (_typed(name, declared),)  # otherwise Typer adds ``--no-…``
    declaration = declared.metadata["kind"](*names, **declared.metadata["more"])
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=inspect.Parameter.empty if declared.default is MISSING else declared.default,
        annotation=Annotated[kind, declaration],
    )


def _typed(name: str, declared: Field[Any]) -> str:
    """How an argument or option is typed, in full."""
    if declared.metadata["kind"] is typer.Argument:
        return str(declared.metadata["more"].get("metavar") or name)
    return max(declared.metadata["names"], key=len, default=f"--{name.replace('_', '-')}")


_ARGUMENT = re.compile(r"`([a-z_]+)=([^`]*)`")
_UNITS = {"mm": 1e3, "ms": 1e3, "n": 1.0, "mm_s": 1e3}
"""Units in names of options, and how many make the SI unit."""
_UNIT = re.compile(rf"_({'|'.join(_UNITS)})$")
_OTHER_NAMES = {"realtime": "fast", "start": "simulated_start", "length": "mm"}
"""Arguments of library functions, and the options named otherwise."""


def name_options(error: CdprError, options: Mapping[str, str]) -> None:
    """Names a verb's options in a message of the library, which knows none.

    Arguments of its functions, such as ```budget=```, become options; where something exists
    already, ``--force`` is offered by the verbs that have it.

    Values of arguments, in SI, are converted to the unit of the option.

    Args:
        options: How the user types them, such as ``--budget-ms``, by parameter name.
    """
    by_name = {_UNIT.sub("", name): name for name in options}

    def as_typed(found: re.Match[str]) -> str:
        name, value = _UNIT.sub("", found.group(1)), found.group(2).strip("'")
        for known in (name, name.removesuffix("s"), _OTHER_NAMES.get(name)):
            if known in by_name:
                option = by_name[known]
                return f"{options[option]} {_in_unit(value, option)}".rstrip()
        return found.group()

    for part in ("what", "where", "why", "next_step"):
        setattr(error, part, _ARGUMENT.sub(as_typed, getattr(error, part)))
    if isinstance(error, AlreadyExists) and "force" in options:
        error.next_step += ", or pass --force to replace it"


def _in_unit(value: str, option: str) -> str:
    """A value in SI as an option takes it; nothing for a flag."""
    if value in ("True", "False"):
        return ""
    unit = _UNIT.search(option)
    try:
        return f"{float(value) * (_UNITS[unit[1]] if unit else 1.0):.12g}"
    except ValueError:
        return value


def given_options(group: Any) -> dict[str, object]:
    """Value of each option of a group, as typed, that differs from its default; else None."""
    values = [(one, getattr(group, one.name)) for one in fields(group)]
    return {_typed(one.name, one): None if value == one.default else value for one, value in values}


OUTPUTS = ("output", "mcap", "overlay")
"""The arguments that name what a verb writes; every other path is read."""

MOST, MOST_WHOLE, MOST_SEED = 1e9, 2**31 - 1, 2**63 - 1
"""Largest absolute value of a number, of an integer, and of a random seed."""
MOST_OF = {"seed": MOST_SEED, "workers": 1024, "columns": 1000, "rows": 1000, "size_px": 16384}
"""Largest integer of single arguments, overriding `MOST_WHOLE`."""
LONGEST_TEXT = 100
"""Of a name that becomes part of a file name, [bytes]."""
NAMES = ("name", "channel", "interface")


def check_arguments(arguments: Mapping[str, object], options: Mapping[str, str]) -> None:
    """Refuses arguments that are invalid for every verb.

    Args:
        arguments: The verb's arguments, by parameter name.
        options: How the user types them, such as ``--at-mm``, by parameter name.

    Raises:
        BadInput: A path or number is invalid, or an output is also an input or another output.
    """
    given = {
        name: list(value) if isinstance(value, (list, tuple)) else [value]
        for name, value in arguments.items()
    }
    for name, values in given.items():
        for value in values:
            _check(name, options[name], value)
    outputs = {options[n]: p for n in OUTPUTS if n in given for p in _paths(n, given[n])}
    inputs = [p for n, values in given.items() if n not in OUTPUTS for p in _inputs(values)]
    refuse_overwriting(outputs, inputs)


def _check(name: str, typed: str, value: object) -> None:
    match value:
        case bool() | None:
            return
        case int():
            _check_whole(typed, value, MOST_OF.get(name, MOST_WHOLE))
        case float():
            _check_number(typed, value)
        case Path():
            file_identity(value)
        case str():
            _check_text(typed, value, is_name=name in NAMES)


def _check_whole(typed: str, value: int, most: int) -> None:
    if abs(value) > most:
        what = f"{typed} is {str(value)[:40]}; the limit is {most}"
        raise BadInput(what, where="command line", next_step="give a smaller number")


def _check_number(typed: str, value: float) -> None:
    what, hint = f"{typed} is {value:g}", "in the option's unit"
    if not math.isfinite(value):
        raise BadInput(what, where="command line", next_step=f"give a finite number, {hint}")
    if abs(value) > MOST:
        what = f"{what}; the limit is {MOST:g}"
        raise BadInput(what, where="command line", next_step=f"give a smaller number, {hint}")


def _check_text(typed: str, text: str, *, is_name: bool) -> None:
    size = len(os.fsencode(text))
    if "\0" in text or (is_name and size > LONGEST_TEXT):
        what = f"{typed} has {size} bytes and is not a valid name"
        hint = f"give a name of {LONGEST_TEXT} bytes at most"
        raise BadInput(what, where=shown(text), next_step=hint)
    if "://" not in text:
        file_identity(Path(text))


def _paths(name: str, values: Iterable[object]) -> list[Path]:
    """Paths of an output; a folder of results may also be read, as result names are unique."""
    found = [value for value in values if isinstance(value, Path)]
    return [path for path in found if name == "overlay" or not path.is_dir()]


def _inputs(values: Iterable[object]) -> Iterator[Path]:
    """Paths that are read, also in texts such as ``front=video.avi``, if the file exists."""
    for value in values:
        if isinstance(value, Path):
            yield value
        elif isinstance(value, str):
            for text in {value, value.partition("=")[2]} - {""}:
                if os.path.exists(text):
                    yield Path(text)
