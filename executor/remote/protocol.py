"""What is said on a run's command socket: one JSON object a line, a question and an answer.

The question names a ``command``: ``status``, ``stop``, ``hold``, ``resume``, or ``speed`` with
``percent`` (1 to 100). The answer has ``ok``; when it is true ``status`` (see
`executor.remote.status`), otherwise ``what``, a sentence.
"""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal, Protocol

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from executor.operator_requests import FASTEST, SLOWEST, RequestBoard


class _Question(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class PlainCommand(_Question):
    """A command without a number."""

    command: Literal["status", "stop", "hold", "resume"]


class SpeedCommand(_Question):
    """How fast to go, in per cent of the planned speed."""

    command: Literal["speed"]
    percent: Annotated[int, Field(ge=SLOWEST, le=FASTEST)]


Command = Annotated[PlainCommand | SpeedCommand, Field(discriminator="command")]
_COMMANDS: TypeAdapter[PlainCommand | SpeedCommand] = TypeAdapter(Command)


class NotACommand(ValueError):
    """What came over the socket is none; the text says why."""


def parse_command(line: bytes) -> PlainCommand | SpeedCommand:
    """The command in a line.

    Raises:
        NotACommand: It is none.
    """
    try:
        return _COMMANDS.validate_json(line)
    except ValidationError as error:
        problems = error.errors(include_url=False, include_context=False)
        raise NotACommand("; ".join(str(problem["msg"]) for problem in problems)) from None


def make_line(command: str, percent: int | None = None) -> bytes:
    """A question as it is sent."""
    question = {"command": command} if percent is None else {"command": command, "percent": percent}
    return json.dumps(question).encode() + b"\n"


class Told(Protocol):
    """What can say how it stands, from any thread."""

    def as_dict(self) -> dict[str, Any]:
        """See `executor.remote.status`."""
        ...


def answer_to(line: bytes, board: RequestBoard, status: Told) -> bytes:
    """Does what a line asks for; the answer as it is sent.

    A command counts even where the run then cannot report its status.
    """
    try:
        _put_up(parse_command(line), board)
        return word_of(status)
    except NotACommand as error:
        return _line({"ok": False, "what": f"not a command: {error}"})
    except Exception as error:
        what = f"the run cannot report its status: {type(error).__name__}: {error}"
        return _line({"ok": False, "what": what})


def word_of(status: Told) -> bytes:
    """How it stands, as an answer is sent."""
    return _line({"ok": True, "status": status.as_dict()})


def _line(answer: dict[str, Any]) -> bytes:
    return json.dumps(answer, allow_nan=False).encode() + b"\n"


def _put_up(command: PlainCommand | SpeedCommand, board: RequestBoard) -> None:
    if isinstance(command, SpeedCommand):
        board.ask_speed(command.percent)
    elif command.command == "stop":
        board.ask_stop()
    elif command.command != "status":
        board.ask_hold(command.command == "hold")
