"""Protocol of a run's command socket: request and answer, one JSON object per line.

A request has a ``command``: ``status``, ``stop``, ``hold``, ``resume``, or ``speed`` with
``percent`` (1 to 100). A jog session also takes ``held`` with ``press`` (a number, rising),
``step_mm`` (one of `STEPS_MM`, or null to move while it is held), ``percent`` of the jog speed,
``age_ms`` (since the operator's report, for a program that passes it on; 0 if left out), and the
motion: of the platform by ``direction`` (x, y, z; normalized by the receiver) in a
``frame`` (``world`` or ``platform``), or of one cable by ``cable`` (its number, from 1) and
``sense`` (``wind_in`` or ``pay_out``); ``let_go`` with ``press``; and ``end``. The answer has
``ok``; if true, ``status`` (see `executor.remote.status`), otherwise ``what``, a sentence.
"""

from __future__ import annotations

import json
import math
from typing import Annotated, Any, Literal, Protocol, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from executor.hold_to_run.presses import CableMove, PlatformMove, PressBoard
from executor.supervision import FASTEST, SLOWEST, RequestBoard


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class RunCommand(_Request):
    """A command without a value."""

    command: Literal["status", "stop", "hold", "resume"]


class FeedCommand(_Request):
    """Feed in per cent of the planned speed."""

    command: Literal["speed"]
    percent: Annotated[int, Field(ge=SLOWEST, le=FASTEST)]


Number = Annotated[int, Field(ge=1, le=2**53)]
Share = Annotated[float, Field(ge=-1.0, le=1.0, allow_inf_nan=False)]
#: Selectable steps of a jog, [mm].
STEPS_MM = (0.1, 1.0, 10.0)


Frame = Literal["world", "platform"]
Cable = Annotated[int, Field(ge=1, le=255)]
Sense = Literal["wind_in", "pay_out"]


class HeldMotion(BaseModel):
    """Motion of a held jog control: of the platform by a direction, or of one cable by a sense."""

    direction: Annotated[list[Share], Field(min_length=3, max_length=3)] | None = None
    frame: Frame | None = None
    cable: Cable | None = None
    sense: Sense | None = None
    step_mm: float | None = None

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.direction is None:
            is_one = None not in (self.cable, self.sense) and self.frame is None
        else:
            is_one = (self.cable, self.sense) == (None, None)
        if not is_one:
            raise ValueError("a held control has either a direction, or a cable and its sense")
        if self.direction is not None and math.hypot(*self.direction) < 1e-3:
            raise ValueError("the direction is zero")
        if self.step_mm is not None and self.step_mm not in STEPS_MM:
            raise ValueError(f"step_mm is none of {', '.join(map(str, STEPS_MM))}")
        return self


class HeldCommand(_Request, HeldMotion):
    """Held jog control."""

    command: Literal["held"]
    press: Number
    percent: Annotated[int, Field(ge=SLOWEST, le=FASTEST)] = FASTEST
    age_ms: Annotated[int, Field(ge=0, le=10_000)] = 0


class LetGoCommand(_Request):
    """Released jog control."""

    command: Literal["let_go"]
    press: Number


class EndCommand(_Request):
    """End of the jog session."""

    command: Literal["end"]


JogCommand = HeldCommand | LetGoCommand | EndCommand
Command = RunCommand | FeedCommand | JogCommand
_COMMANDS: TypeAdapter[Command] = TypeAdapter(Annotated[Command, Field(discriminator="command")])


class InvalidCommand(ValueError):
    """The received line is not a command; with the reason."""


def parse_command(line: bytes) -> Command:
    """Parses a command.

    Raises:
        InvalidCommand: The line is not a command.
    """
    try:
        return _COMMANDS.validate_json(line)
    except ValidationError as error:
        problems = error.errors(include_url=False, include_context=False)
        raise InvalidCommand("; ".join(str(problem["msg"]) for problem in problems)) from None


def make_line(command: str, **values: Any) -> bytes:
    """Encodes a request; values of None are left out."""
    given = {name: value for name, value in values.items() if value is not None}
    return json.dumps({"command": command, **given}, allow_nan=False).encode() + b"\n"


class StatusSource(Protocol):
    """Reports its status, from any thread."""

    def as_dict(self) -> dict[str, Any]:
        """See `executor.remote.status`."""


def answer_to(
    line: bytes,
    board: RequestBoard,
    status: StatusSource,
    presses: PressBoard | None = None,
    *,
    ahead: bool = False,
) -> bytes:
    """Executes a request; returns the encoded answer.

    A command takes effect even if the run then cannot report its status.

    Args:
        status: Reported in the answer.
        presses: Of a jog session; None for any other motion.
        ahead: The motion is still being prepared, and takes only a stop.
    """
    try:
        command = parse_command(line)
        if ahead and command.command not in ("status", "stop"):
            raise InvalidCommand("the motion is still being prepared, and takes only a stop")
        if isinstance(command, JogCommand):
            _jog(command, presses)
        else:
            _request(command, board, presses)
        return status_answer(status)
    except InvalidCommand as error:
        return _line({"ok": False, "what": f"not a command: {error}"})
    except Exception as error:
        what = f"the run cannot report its status: {type(error).__name__}: {error}"
        return _line({"ok": False, "what": what})


def status_answer(status: StatusSource) -> bytes:
    """Encodes an answer with the status."""
    return _line({"ok": True, "status": status.as_dict()})


def _line(answer: dict[str, Any]) -> bytes:
    return json.dumps(answer, allow_nan=False).encode() + b"\n"


def _request(
    command: RunCommand | FeedCommand, board: RequestBoard, presses: PressBoard | None
) -> None:
    if presses is not None and command.command not in ("status", "stop"):
        raise InvalidCommand(
            f"a session of jogs has no path, so `{command.command}` would do nothing;"
            " it moves only while a control is held, and `cdpr stop` ends it"
        )
    if isinstance(command, FeedCommand):
        board.ask_speed(command.percent)
    elif command.command == "stop":
        board.ask_stop()
    elif command.command != "status":
        board.ask_hold(command.command == "hold")


def _jog(command: JogCommand, presses: PressBoard | None) -> None:
    if presses is None:
        raise InvalidCommand("this run takes no jogs")
    if isinstance(command, EndCommand):
        presses.end()
    elif isinstance(command, LetGoCommand):
        presses.let_go(command.press)
    else:
        try:
            is_taken = _hold(command, presses)
        except ValueError as error:
            raise InvalidCommand(str(error)) from None
        if not is_taken:
            raise InvalidCommand(f"press {command.press} is over")


def _hold(command: HeldCommand, presses: PressBoard) -> bool:
    move: PlatformMove | CableMove
    if command.cable is not None:
        move = CableMove(command.cable, command.sense == "pay_out")
    else:
        direction = np.array(command.direction, dtype=np.float64)
        move = PlatformMove(direction / np.linalg.norm(direction), command.frame == "platform")
    return presses.hold(
        command.press,
        move,
        step=None if command.step_mm is None else command.step_mm / 1000.0,
        percent=command.percent,
        age=command.age_ms / 1000.0,
    )
