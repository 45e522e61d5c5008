"""Which page may operate, and which press of a jog control is meant. Pure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


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

        Args:
            page: Which.
            hold: The page's own number of the press, rising from 1.
            motion: Number of the session that it is to move; a press is over with the session in
                which it began, and at once where there is none (0).
        """
        mine = self._pages[page]
        if self.holder != page or hold <= mine.over or hold < mine.hold:
            return None
        if motion == 0 or (hold == mine.hold and motion != mine.motion):
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
