"""The errors a user may see: each states what, where, why and what to do next."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from inspect import iscoroutinefunction
from multiprocessing import current_process
from numbers import Integral, Real
from os import PathLike, fspath
from pathlib import Path
from typing import Any, ClassVar, TypeVar

T = TypeVar("T")


_PASSWORD = re.compile(
    r"(?<=:/)(/?[^\s:/?#@]*:)(?:[^\n/?#]*|(?!\d{1,5}[/?#])\S*)@"
    r"|((?:pass(?:word|wort|wd)?|pwd)=)[^\s&/?#'\")]+",
    re.IGNORECASE,
)


def without_passwords(text: str) -> str:
    """A text with ``***`` for the passwords of the addresses in it.

    They are the ``PASSWORD`` of ``rtsp://USER:PASSWORD@HOST``, also with characters that should be
    escaped, and of ``?password=PASSWORD``, as camera makers spell it.
    """
    return _PASSWORD.sub(lambda found: f"{found[1]}***@" if found[1] else f"{found[2]}***", text)


class CdprError(Exception):
    """Base of every error of this project.

    Args:
        what: One sentence that states what is wrong, with measured value, unit and limit.
        where: File and position, or device, concerned.
        why: The likely cause, where known.
        next_step: What the user can do now.
        values: The numbers behind the text, by name (unit in the name).

    Passwords of addresses are left out of all texts.
    """

    code: ClassVar[str] = "fault"
    exit_code: int = 1

    def __init__(
        self,
        what: str,
        *,
        where: str = "",
        why: str = "",
        next_step: str = "",
        values: dict[str, float | str] | None = None,
    ) -> None:
        self.what, self.where, self.why, self.next_step = map(
            without_passwords, (what, where, why, next_step)
        )
        super().__init__(self.what)
        self.values = dict(values or {})

    def __str__(self) -> str:
        """The whole message, one line per part."""
        head = f"{self.where}: {self.what}" if self.where else self.what
        parts = [head]
        if self.why:
            parts.append(f"  why: {self.why}")
        if self.next_step:
            parts.append(f"  next: {self.next_step}")
        return "\n".join(parts)

    def __reduce__(self) -> tuple[object, ...]:
        """Keeps all attributes when pickled, whatever arguments a subclass takes."""
        return _restored, (type(self), self.args, self.__dict__)

    def as_dict(self) -> dict[str, object]:
        """The same message for `--json`."""
        return {
            "error": self.code,
            "exit_code": self.exit_code,
            "what": self.what,
            "where": self.where,
            "why": self.why,
            "next_step": self.next_step,
            "values": {key: _finite(value) for key, value in self.values.items()},
        }


def distinct_figures(values: Sequence[float], digits: int, kind: str = "f") -> list[str]:
    """Numbers as text, with more digits where those that differ would look alike.

    Args:
        digits: Fewest decimals, or fewest significant digits with ``kind`` "g".
        kind: Of the format: "f" or "g".
    """
    for enough in range(digits, 18):
        texts = [f"{value:z.{enough}{kind}}" for value in values]
        if len({*texts}) == len({*values}):
            break
    return texts


def first_few(texts: Sequence[str], most: int = 3) -> str:
    """The first of several texts, and the number of the others."""
    rest = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + rest


def _finite(value: object) -> object:
    """The value for JSON, which has no number for infinity."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _restored(kind: type[CdprError], args: tuple[object, ...], state: dict[str, object]) -> object:
    error = kind.__new__(kind, *args)
    error.__dict__.update(state)
    return error


class Fault(CdprError):
    """Something failed while it ran; the machine is left stopped."""


class NoSolution(CdprError):
    """The search ended at its limit without a path."""

    code = "no_solution"


class BadInput(CdprError):
    """A file, an option or a request that cannot be used."""

    code = "bad_input"
    exit_code = 2


class AlreadyExists(BadInput):
    """A file or folder that would be replaced; the caller can allow it."""

    def __init__(self, what: str, where: str, why: str = "") -> None:
        super().__init__(what, where=where, why=why, next_step="choose another name")


# Arguments of library functions, which a script may pass as anything.

_MAKERS = {
    "Rig": "cdpr.load_rig",
    "Scene": "cdpr.load_scene",
    "Plan": "cdpr.load_plan",
    "Pose": "cdpr.Pose.level",
    "CalibrationResult": "cdpr.load_calibration",
    "ResultDocument": "cdpr.load_calibration",
}
_UNITS = {"Pose": ", with the position in metres"}
_OTHERS = {
    "Load": "scene.load, or leave it out",
    "Listener": "an object of a subclass of model.progress.Listener, or leave it out",
    "Board": "a cdpr.Chessboard, or another board of `calibration`",
    "Camera": "rig.camera(), or rig.camera(name)",
    "Survey": "a calibration.Survey, or leave it out",
    "StopDocument": "some of scene.document.stops, or stops in a scene's keys: Scene.from_dict("
    "{**scene.as_dict(), 'stops': [{'name': 'a', 'position_mm': [0, 0, 400]}]})",
    "Payload": "one in a scene's keys: Scene.from_dict("
    "{**scene.as_dict(), 'load': {'payload_kg': 1.0}})",
    "Supervisor": "an object of a subclass of executor.supervision.Supervisor, or leave it out",
}


def require_types(
    *given: tuple[object, type[Any]], optional: Iterable[tuple[object, type[Any]]] = ()
) -> None:
    """Requires objects of these types of `cdpr`, where a script may pass a path or a list.

    Args:
        given: Values and their types.
        optional: The same, where None is allowed.

    Raises:
        BadInput: One is of another type; with the function that makes it.
    """
    for value, kind in (*given, *(one for one in optional if one[0] is not None)):
        if not isinstance(value, kind):
            name, shown = kind.__name__, repr(value)
            if isinstance(value, PathLike):
                shown = repr(str(value))
            made_from = isinstance(value, str | PathLike) or name == "Pose"
            found = "text" if isinstance(value, str) else type(value).__name__
            pass_it = _OTHERS.get(name) or (
                f"{_MAKERS[name]}({shown if made_from and len(shown) < 80 else '...'})"
            )
            next_step = f"pass {pass_it}{_UNITS.get(name, '')}"
            raise BadInput(f"expected a {name}, not {found}", next_step=next_step)


def require_text(**given: object) -> None:
    """Requires texts, by the name of their argument.

    Raises:
        BadInput: One is something else.
    """
    for name, value in given.items():
        if not isinstance(value, str):
            raise _unusable(name, "text", value)


def require_functions(**given: object) -> None:
    """Requires functions, by the name of their argument; None for those left out.

    Raises:
        BadInput: One cannot be called, or is a coroutine function, which a call would not run.
    """
    for name, value in given.items():
        if not (value is None or callable(value)) or iscoroutinefunction(value):
            raise _unusable(name, "a function, without `async`", value)


def require_child_processes(use: str, or_else: str = "") -> None:
    """Requires that this process may start others.

    Args:
        use: What they are for.
        or_else: What a caller can do without them, as a clause.

    Raises:
        BadInput: It may not.
    """
    if current_process().daemon:
        raise BadInput(
            f"this process cannot start others, for {use}",
            why="it is daemonic, as a worker of `multiprocessing.Pool` is",
            next_step="use `concurrent.futures.ProcessPoolExecutor` instead" + or_else,
        )


def sequence_of(name: str, values: Iterable[T]) -> tuple[T, ...]:
    """The values of any iterable, once.

    Raises:
        BadInput: It is not iterable, or a text.
    """
    if isinstance(values, str | bytes) or not isinstance(values, Iterable):
        raise _unusable(name, "a list", values)
    return tuple(values)


def is_masked(value: object) -> bool:
    """Whether it is a masked scalar of NumPy, which converts to the number behind its mask."""
    return getattr(value, "shape", None) == () and bool(getattr(value, "mask", False))


def is_truth_value(value: object) -> bool:
    """Whether it is True or False, also NumPy's; ``"no"``, 0, None and a masked one are neither."""
    of_numpy = getattr(value, "shape", None) == () and str(getattr(value, "dtype", "")) == "bool"
    return isinstance(value, bool) or (of_numpy and not is_masked(value))


def truth_value(name: str, value: object) -> bool:
    """True or False, also NumPy's.

    Raises:
        BadInput: It is something else.
    """
    if not is_truth_value(value):
        raise _unusable(name, "True or False", value)
    return bool(value)


def real_number(name: str, value: object, unit: str = "") -> float:
    """A number of any type, such as NumPy's, as a float; the caller checks its range.

    Raises:
        BadInput: It is a text, a list, masked or another object, or too large.
    """
    single = value.item() if getattr(value, "shape", None) == () else value  # type: ignore[attr-defined]
    if is_masked(value) or isinstance(single, bool) or not isinstance(single, Real):
        raise _unusable(name, f"a number [{unit}]" if unit else "a number", value)
    try:
        return float(single)
    except OverflowError:
        raise BadInput(f"{name} is too large a number") from None


def require_fields(thing: Any) -> None:
    """Requires values of their types in the fields of a dataclass: text, numbers, truth values.

    Raises:
        BadInput: One is of another type.
    """
    for one in fields(thing):
        value = getattr(thing, one.name)
        if one.type == "str":
            require_text(**{one.name: value})
        elif one.type == "bool":
            truth_value(one.name, value)
        elif one.type == "int" and (isinstance(value, bool) or not isinstance(value, Integral)):
            raise _unusable(one.name, "a whole number", value)
        elif one.type == "float":
            real_number(one.name, value)


def positive_number(
    name: str, value: object, unit: str = "1", *, or_zero: bool = False, most: float = 1e9
) -> float:
    """A positive number of any type as a float.

    Args:
        name: As the message names it.
        or_zero: Whether it may be 0.

    Raises:
        BadInput: It is not such a number, or NaN.
    """
    number = real_number(name, value, unit)
    if not (0.0 < number <= most or (or_zero and number == 0.0)):
        least = "0 or more" if or_zero else "above 0"
        raise _unusable(name, f"a number [{unit}] {least}, at most {most:g}", value)
    return number


def path_of(value: object) -> Path:
    """A path, from text or a path object.

    Raises:
        BadInput: It is empty, or something else, such as None, a number or bytes.
    """
    if not isinstance(value, str | PathLike) or not isinstance(fspath(value), str):
        raise _unusable("the path", "a str or a pathlib.Path", value)
    require_not_empty("the path", text := fspath(value))
    if "\0" in text:
        raise _unusable("the path", "without a null character", value)
    return Path(text)


def require_not_empty(name: str, text: str) -> None:
    """Requires a text; an empty path would mean the current folder.

    Args:
        name: As the message names it.
        text: What is given for it.

    Raises:
        BadInput: It is empty.
    """
    if not text:
        raise BadInput(
            f"{name} is empty",
            why="a variable of the shell or the program has no value",
            next_step="give a value; the current folder is '.'",
        )


def _unusable(name: str, expected: str, value: object) -> BadInput:
    shown = repr(value)
    shown = f"{shown[:60]}…" if len(shown) > 60 else shown
    return BadInput(f"{name} must be {expected}, it is {shown} ({type(value).__name__})")


class Refused(CdprError):
    """A safety check refused before anything moved."""

    code = "refused"
    exit_code = 3


class HardwareMissing(CdprError):
    """A bus, drive or camera that does not answer or cannot be opened."""

    code = "hardware_missing"
    exit_code = 4


class StoppedByOperator(CdprError):
    """The operator ended the run; drives hold their position."""

    code = "stopped"
    exit_code = 130


@dataclass(frozen=True, slots=True)
class Problem:
    """One problem of an input file.

    Attributes:
        key: Path of the key, such as ``winches[2].node_id``.
        what: What is wrong with it.
        line: Line in the file, counted from 1, or 0 where it has none.
        column: Column in the file, counted from 1, or 0 where it has none.
    """

    key: str
    what: str
    line: int = 0
    column: int = 0


class InvalidFile(BadInput):
    """An input file with one or more problems, all reported at once."""

    code = "invalid_file"

    def __init__(self, path: str, problems: Sequence[Problem], next_step: str = "") -> None:
        self.path = path
        self.problems = tuple(problems)
        count = len(self.problems)
        super().__init__(
            f"{count} problem{'s' if count != 1 else ''} in the file",
            where=path,
            next_step=next_step or "fix the lines above and run the command again",
        )

    def __str__(self) -> str:
        """One line per problem, each with file:line:column."""
        lines = [self._line(problem) for problem in self.problems]
        return "\n".join([*lines, f"  next: {self.next_step}"])

    def _line(self, problem: Problem) -> str:
        position = self.path
        if problem.line:
            position += f":{problem.line}:{problem.column}"
        key = f" {problem.key}:" if problem.key else ""
        return f"{position}:{key} {problem.what}"

    def as_dict(self) -> dict[str, object]:
        """The same message for `--json`, with the list of problems."""
        problems = [
            {"key": p.key, "what": p.what, "line": p.line, "column": p.column}
            for p in self.problems
        ]
        return {**super().as_dict(), "problems": problems}
