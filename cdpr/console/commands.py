"""What a page may say: one JSON object a message on the console's socket."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from executor.operator_requests import FASTEST, SLOWEST
from executor.remote.protocol import (
    Cable,
    Frame,
    Number,
    Sense,
    Share,
    require_one_motion,
    require_step,
)

#: Longest message, [bytes].
LONGEST = 4096

Text = Annotated[str, Field(max_length=400)]
Millimetres = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Index = Annotated[int, Field(ge=0, le=10_000)]


class _Said(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class _Command(_Said):
    kind: Literal["command"]
    id: int = 0


class PlainCommand(_Command):
    """A command without values."""

    command: Literal[
        "stop",
        "hold",
        "resume",
        "give_control",
        "home",
        "reset",
        "release",
        "run",
        "jog_begin",
        "cable_begin",
        "jog_end",
        "service_begin",
        "service_end",
    ]


class TakeCommand(_Command):
    """The page wants control; with force from a page that has it."""

    command: Literal["take_control"]
    force: bool = False


class SpeedCommand(_Command):
    """Of the planned speed."""

    command: Literal["speed"]
    percent: Annotated[int, Field(ge=SLOWEST, le=FASTEST)]


class FileCommand(_Command):
    """A plan to look at before it is run."""

    command: Literal["load_plan"]
    file: Text


class CompareCommand(_Command):
    """A plan to look at beside the one that is loaded; none to look at that alone."""

    command: Literal["compare"]
    file: Text | None


class PlanCommand(_Command):
    """A path to plan: of a scene, or through the taught poses."""

    command: Literal["plan"]
    scene: Text | None = None
    objective: Literal["shortest", "kinematic", "clearance"] = "shortest"


class NameCommand(_Command):
    """The pose as it is now is to be kept."""

    command: Literal["teach"]
    name: Text


class PickCommand(_Command):
    """A position of the scene is to be kept, with the orientation of now."""

    command: Literal["teach_at"]
    name: Text
    position_mm: Annotated[list[Millimetres], Field(min_length=3, max_length=3)]


class RenameCommand(_Command):
    """A taught pose gets another name."""

    command: Literal["rename"]
    index: Index
    name: Text


class MoveCommand(_Command):
    """A taught pose gets another place in the order."""

    command: Literal["move"]
    index: Index
    to: Index


class IndexCommand(_Command):
    """A taught pose goes."""

    command: Literal["forget"]
    index: Index


class Held(_Said):
    """A jog control is held: of the platform, with a direction, or of one cable, with a sense."""

    kind: Literal["held"]
    hold: Number
    direction: Annotated[list[Share], Field(min_length=3, max_length=3)] | None = None
    frame: Frame | None = None
    cable: Cable | None = None
    sense: Sense | None = None
    step_mm: float | None
    speed_mm_s: Annotated[float, Field(gt=0.0, le=1000.0, allow_inf_nan=False)]
    seq: int

    @model_validator(mode="after")
    def _possible(self) -> Held:
        require_one_motion(self.direction, self.frame, self.cable, self.sense)
        require_step(self.step_mm)
        return self


class LetGo(_Said):
    """A jog control is no longer held."""

    kind: Literal["let_go"]
    hold: Number


Message = (
    PlainCommand
    | TakeCommand
    | SpeedCommand
    | FileCommand
    | CompareCommand
    | PlanCommand
    | NameCommand
    | PickCommand
    | RenameCommand
    | MoveCommand
    | IndexCommand
)
_Commands = Annotated[Message, Field(discriminator="command")]
_ANY: TypeAdapter[Message | Held | LetGo] = TypeAdapter(
    Annotated[_Commands | Held | LetGo, Field(discriminator="kind")]
)


class NotAMessage(ValueError):
    """What came over the socket is none; the text says why."""


def parse_message(text: str) -> Message | Held | LetGo:
    """The message in a text.

    Raises:
        NotAMessage: It is none.
    """
    if len(text) > LONGEST:
        raise NotAMessage(f"longer than {LONGEST} characters")
    try:
        return _ANY.validate_json(text)
    except ValidationError as error:
        problems = error.errors(include_url=False, include_context=False, include_input=False)
        raise NotAMessage("; ".join(str(problem["msg"]) for problem in problems[:3])) from None
