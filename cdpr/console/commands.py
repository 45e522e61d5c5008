"""Messages from a page, one JSON object each, those that wait, and which page has control."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Generic, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from executor.remote.protocol import HeldMotion, Number
from executor.supervision import FASTEST, SLOWEST

#: Longest message, [bytes].
LONGEST = 4096
#: Largest number of queued commands per page and queue; STOP is never queued.
MOST_WAITING = 8
#: Commands to a run that moves: they wait for no other command, such as loading a plan.
TO_RUN = frozenset({"hold", "resume", "speed"})
#: Commands whose answer a page awaits, as they load files or read drives once they are begun.
AWAITED = frozenset({"load_plan", "compare", "run", "plan", "teach", "teach_at"})

Text = Annotated[str, Field(max_length=400)]
Millimetres = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Index = Annotated[int, Field(ge=0, le=10_000)]


class _Incoming(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class _Command(_Incoming):
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
        "release",
        "read_drives",
        "jog_begin",
        "cable_begin",
        "jog_end",
        "service_begin",
        "service_end",
    ]


class TakeCommand(_Command):
    """Take control; with force, from the page that was seen to have it."""

    command: Literal["take_control"]
    force: bool = False
    held_by: Text | None = None


class RunPlanCommand(_Command):
    """Run the loaded plan, if it is the one that was shown; by its hash."""

    command: Literal["run"]
    plan: Text


class ResetCommand(_Command):
    """Reset the latched fault, if its cause is the one that was shown; None if none was latched."""

    command: Literal["reset"]
    cause: Annotated[str, Field(max_length=3000)] | None


class SpeedCommand(_Command):
    """Set the speed, in per cent of the planned one."""

    command: Literal["speed"]
    percent: Annotated[int, Field(ge=SLOWEST, le=FASTEST)]


class FileCommand(_Command):
    """Load a plan for preview."""

    command: Literal["load_plan"]
    file: Text


class CompareCommand(_Command):
    """Show a plan beside the loaded one; None ends the comparison."""

    command: Literal["compare"]
    file: Text | None


class PlanCommand(_Command):
    """Plan a path for a scene, or through the taught poses.

    Attributes:
        scene: File of the scene; None for the taught poses.
        objective: What the path minimizes.
        from_here: The path begins at the current pose, then goes through the taught poses in order.
        pose: Only to this taught pose, from the current one.
    """

    command: Literal["plan"]
    scene: Text | None = None
    objective: Literal["shortest", "kinematic", "clearance"] = "shortest"
    from_here: bool = False
    pose: Text | None = None


class NameCommand(_Command):
    """Teach the current pose."""

    command: Literal["teach"]
    name: Text


class PickCommand(_Command):
    """Teach a position picked in the scene, with the present orientation."""

    command: Literal["teach_at"]
    name: Text
    position_mm: Annotated[list[Millimetres], Field(min_length=3, max_length=3)]


class RenameCommand(_Command):
    """Rename a taught pose."""

    command: Literal["rename"]
    pose: Text
    name: Text


class MoveCommand(_Command):
    """Move a taught pose within the order."""

    command: Literal["move"]
    pose: Text
    to: Index


class ForgetCommand(_Command):
    """Remove a taught pose."""

    command: Literal["forget"]
    pose: Text


class Held(_Incoming, HeldMotion):
    """A jog control is held.

    `state` is the number of the newest state that the page has received.
    """

    kind: Literal["held"]
    hold: Number
    step_mm: float | None
    speed_mm_s: Annotated[float, Field(gt=0.0, le=1000.0, allow_inf_nan=False)]
    seq: Number
    state: Number


class LetGo(_Incoming):
    """A jog control is no longer held."""

    kind: Literal["let_go"]
    hold: Number


class Seen(_Incoming):
    """A state has reached the page, with the time of receipt on the page's clock."""

    kind: Literal["seen"]
    seq: Number
    at_ms: Annotated[float, Field(ge=0.0, le=1e15, allow_inf_nan=False)]


Message = (
    PlainCommand
    | TakeCommand
    | RunPlanCommand
    | ResetCommand
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
_ANY: TypeAdapter[Message | Held | LetGo | Seen] = TypeAdapter(
    Annotated[_Commands | Held | LetGo | Seen, Field(discriminator="kind")]
)


class NotAMessage(ValueError):
    """The received text is not a valid message; the error's text says why."""


def parse_message(text: str) -> Message | Held | LetGo | Seen:
    """The message in a text.

    Raises:
        NotAMessage: It is not a valid message.
    """
    if len(text) > LONGEST:
        raise NotAMessage(f"longer than {LONGEST} characters")
    try:
        return _ANY.validate_json(text)
    except ValidationError as error:
        problems = error.errors(include_url=False, include_context=False, include_input=False)
        raise NotAMessage("; ".join(str(problem["msg"]) for problem in problems[:3])) from None


T = TypeVar("T")


class Newest(Generic[T]):
    """Keeps the newest of several values until it is taken."""

    def __init__(self) -> None:
        self.value: T | None = None
        self._is_there = asyncio.Event()

    def put(self, value: T) -> None:
        """Replaces what is not taken yet."""
        self.value = value
        self._is_there.set()

    async def take(self) -> T:
        """Waits for a value."""
        while self.value is None:
            self._is_there.clear()
            await self._is_there.wait()
        value, self.value = self.value, None
        return value


class Inbox:
    """Messages of a page that are not yet executed: bounded, however many it sends.

    Attributes:
        commands: To be executed in order, with the time of arrival, [s] of `CLOCK_BOOTTIME`.
        to_run: The same for commands of `TO_RUN`.
        refused: Refused commands, by number, and why.
        held: The newest report of a press: its number, the message, and when it arrived.
        released: The newest press that is over.
    """

    def __init__(self) -> None:
        self.commands: asyncio.Queue[tuple[Message, float]] = asyncio.Queue(MOST_WAITING)
        self.to_run: asyncio.Queue[tuple[Message, float]] = asyncio.Queue(MOST_WAITING)
        self.refused: asyncio.Queue[tuple[int, str]] = asyncio.Queue(MOST_WAITING)
        self.held = Newest[tuple[int, Held, float]]()
        self.released = Newest[int]()

    def take(self, message: Message) -> None:
        """Queues a command that arrives now, or refuses it if its queue is full."""
        queue = self.to_run if message.command in TO_RUN else self.commands
        try:
            queue.put_nowait((message, time.clock_gettime(time.CLOCK_BOOTTIME)))
        except asyncio.QueueFull:
            self.refuse(message.id, "earlier commands of this page are not finished yet")

    def refuse(self, command: int, why: str) -> None:
        """Queues the answer to a refused message; drops it if the page does not read answers."""
        with suppress(asyncio.QueueFull):
            self.refused.put_nowait((command, why))

    def hold(self, press: int | None, message: Held) -> None:
        """Keeps a report of a press, with the time of its arrival."""
        if press is not None:
            self.held.put((press, message, time.monotonic()))

    def let_go(self, press: int | None) -> None:
        """Keeps a press that is over, and drops its reports."""
        if press is None:
            return
        if self.held.value is not None and self.held.value[0] <= press:
            self.held.value = None
        self.released.put(max(press, self.released.value or 0))


# Which page has control, and the numbers of its jog presses. Pure.


@dataclass(slots=True)
class _Page:
    name: str
    hold: int = 0
    motion: int = 0
    press: int = 0
    over: int = 0
    seq: int = 0


class PageControl:
    """Every page may watch and stop; one page at a time has control."""

    def __init__(self, now_ms: Callable[[], int]) -> None:
        """Starts with no page open.

        Args:
            now_ms: A clock shared by all consoles of this computer, [ms]. Press numbers come from
                it, so no console continues a press of another or of an earlier one.
        """
        self._pages: dict[int, _Page] = {}
        self._now_ms = now_ms
        self._next_page, self._last_press = 1, 0
        self.holder: int | None = None
        """The page that has control."""
        self.is_service = False
        """Whether that page is in service mode."""
        self.elsewhere: str | None = None
        """Holder of control at another console of this robot."""

    def join(self, host: str) -> int:
        """Registers a page opened on a host; returns its number."""
        number, self._next_page = self._next_page, self._next_page + 1
        self._pages[number] = _Page(f"page {number} on {host}")
        return number

    def leave(self, page: int) -> int | None:
        """Removes a page and its control; returns the press that it held, if any."""
        held = self.give(page)
        del self._pages[page]
        return held

    def take(self, page: int, *, moving: bool, force: bool = False) -> str:
        """Gives a page control; returns the reason if refused, else an empty text.

        Args:
            page: Number of the page; one that has left while it waited is refused.
            moving: Whether a motion is in progress.
            force: Take control from another page; only at rest.
        """
        if page not in self._pages:
            return "the page has left"
        if self.holder not in (None, page):
            assert self.holder is not None
            if moving or not force:
                holder = self._pages[self.holder].name
                when = " while the robot moves" if moving and force else ""
                return f"{holder} has control, and keeps it{when}"
            self.let_go(self.holder)
            self._free()
        self.holder = page
        return ""

    def give(self, page: int) -> int | None:
        """Returns a page's control, and the press that it held, if any."""
        held = self.let_go(page)
        if self.holder == page:
            self._free()
        return held

    def _free(self) -> None:
        self.holder, self.is_service = None, False

    def set_service(self, page: int, on: bool) -> int | None:
        """Enters or leaves service mode; returns the press that the page held, if any."""
        held = self.let_go(page)
        if self.holder == page:
            self.is_service = on
        return held

    def mode(self, page: int) -> str:
        """A page's mode: ``observe``, ``operate`` or ``service``."""
        if self.holder != page:
            return "observe"
        return "service" if self.is_service else "operate"

    def holder_name(self) -> str | None:
        """Name of the page that has control, here or at another console."""
        page = self._pages.get(self.holder or 0)  # read once: other threads change it
        return self.elsewhere if page is None else page.name

    def name(self, page: int) -> str:
        """Name of a page."""
        return self._pages[page].name

    def as_dict(self, page: int) -> dict[str, object]:
        """Data for a page."""
        yours, held_by = self.holder == page, self.holder_name()
        return {"yours": yours, "held_by": held_by, "mode": self.mode(page)}

    def hold(self, page: int, hold: int, seq: int, motion: int) -> int | None:
        """The press number for a held control of a page; None if refused or over.

        A press reported while the page has no control is over: after gaining control, the operator
        has to press again, and no earlier message moves anything.

        Args:
            page: Number of the page.
            hold: The page's number of the press, rising from 1.
            seq: Number of the report, rising with each; a repeated report counts for nothing.
            motion: Number of the jog session; a press ends with the session in which it began,
                and at once without a session (0).
        """
        state = self._pages[page]
        if seq <= state.seq or hold <= state.over or hold < state.hold:
            return None
        state.seq = seq
        if self.holder != page or motion == 0 or (hold == state.hold and motion != state.motion):
            state.over = hold
            return None
        if hold > state.hold:
            self._last_press = max(self._last_press + 1, self._now_ms())
            state.hold, state.press, state.motion = hold, self._last_press, motion
        return state.press

    def let_go(self, page: int, hold: int | None = None) -> int | None:
        """Ends a press of a page, by its number or the one held; returns its press number."""
        state = self._pages[page]
        if hold is None:
            hold = state.hold
        state.over = max(state.over, hold)
        return state.press if hold >= state.hold > 0 else None
