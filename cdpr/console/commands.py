"""What a page may say, one JSON object a message on its socket, and which page may operate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from executor.remote.protocol import (
    Cable,
    Frame,
    Number,
    Sense,
    Share,
    require_one_motion,
    require_step,
)
from executor.supervision import FASTEST, SLOWEST

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
    pose: Text
    name: Text


class MoveCommand(_Command):
    """A taught pose gets another place in the order."""

    command: Literal["move"]
    pose: Text
    to: Index


class ForgetCommand(_Command):
    """A taught pose goes."""

    command: Literal["forget"]
    pose: Text


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
    | ForgetCommand
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


# Which page may operate, and which press of a jog control is meant. Pure.


@dataclass(slots=True)
class _Page:
    name: str
    hold: int = 0
    motion: int = 0
    press: int = 0
    over: int = 0


class PageControl:
    """Everybody may look and stop; one page at a time may operate."""

    def __init__(self, now_ms: Callable[[], int]) -> None:
        """No page is open.

        Args:
            now_ms: A clock that all consoles of this computer share, [ms]: presses are numbered by
                it, so that no console goes on with the press of another, or of one before it.
        """
        self._pages: dict[int, _Page] = {}
        self._now_ms = now_ms
        self._next_page, self._last_press = 1, 0
        self.holder: int | None = None
        """The page that has control."""
        self.is_service = False
        """That page is in service mode."""

    def join(self, host: str) -> int:
        """A page was opened on a computer; its number."""
        number, self._next_page = self._next_page, self._next_page + 1
        self._pages[number] = _Page(f"page {number} on {host}")
        return number

    def leave(self, page: int) -> int | None:
        """A page is gone; the press that it held, if any, and its control end."""
        held = self.let_go(page)
        del self._pages[page]
        if self.holder == page:
            self._free()
        return held

    def take(self, page: int, *, moving: bool, force: bool = False) -> str:
        """Gives a page control; why not, or nothing.

        Args:
            page: Which.
            moving: Something moves.
            force: Take it from a page that has it; only while nothing moves.
        """
        if self.holder not in (None, page):
            assert self.holder is not None
            if moving or not force:
                holder = self._pages[self.holder].name
                when = " while the robot moves" if moving and force else ""
                return f"{holder} has control; it is not taken away{when}"
            self.let_go(self.holder)
            self._free()
        self.holder = page
        return ""

    def give(self, page: int) -> int | None:
        """A page gives its control back; the press that it held ends."""
        held = self.let_go(page)
        if self.holder == page:
            self._free()
        return held

    def _free(self) -> None:
        self.holder, self.is_service = None, False

    def set_service(self, page: int, on: bool) -> int | None:
        """The page that has control enters or leaves service mode; the press that it held ends."""
        held = self.let_go(page)
        if self.holder == page:
            self.is_service = on
        return held

    def mode(self, page: int) -> str:
        """What a page may do: ``observe``, ``operate`` or ``service``."""
        if self.holder != page:
            return "observe"
        return "service" if self.is_service else "operate"

    def holder_name(self) -> str | None:
        """Who has control."""
        return None if self.holder is None else self._pages[self.holder].name

    def hold(self, page: int, hold: int, motion: int) -> int | None:
        """The press that a page's control is held with; None where it may not, or no longer.

        A press that is heard of while the page may not operate is over: who gets control later has
        to press again, and nothing that was said before moves anything.

        Args:
            page: Which.
            hold: The page's own number of the press, rising from 1.
            motion: Number of the session that it is to move; a press is over with the session in
                which it began, and at once where there is none (0).
        """
        mine = self._pages[page]
        if hold <= mine.over or hold < mine.hold:
            return None
        if self.holder != page or motion == 0 or (hold == mine.hold and motion != mine.motion):
            mine.over = hold
            return None
        if hold > mine.hold:
            self._last_press = max(self._last_press + 1, self._now_ms())
            mine.hold, mine.press, mine.motion = hold, self._last_press, motion
        return mine.press

    def let_go(self, page: int, hold: int | None = None) -> int | None:
        """The press that ends: of this number on the page, or the one that is held."""
        mine = self._pages[page]
        if hold is None:
            hold = mine.hold
        mine.over = max(mine.over, hold)
        return mine.press if hold >= mine.hold > 0 else None
