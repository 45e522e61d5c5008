"""Control and press numbers, for any order of pages, presses and disconnections."""

from __future__ import annotations

import os
import tempfile
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from cdpr.console.commands import PageControl
from cdpr.console.state import BusControl
from drivers.can_bus import BusSettings
from executor.interlock import locks
from executor.interlock.locks import ControlLock, state_file
from model.errors import Refused
from model.rig import load_rig
from tests.cli.plans import CONFIGS


class ControlMachine(RuleBasedStateMachine):
    """Pages join, leave, take and release control, hold and release; the oracle tracks presses."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 1
        self.control = PageControl(lambda: self.now)
        self.pages: set[int] = set()
        self.gone: list[int] = []
        self.motion = 1
        self.begun_in: dict[int, int] = {}
        self.begun: dict[int, tuple[int, int]] = {}
        self.ended: set[int] = set()
        self.named: dict[int, int] = {}
        self.refused: dict[int, int] = {}  # the highest number of a page's presses that were
        self.newest = 0
        self.reports = 0

    @rule(jump=st.integers(-50, 200))
    def clock(self, jump: int) -> None:
        self.now += jump

    @precondition(lambda self: len(self.pages) < 2)
    @rule()
    def join(self) -> None:
        page = self.control.join(f"page {len(self.pages)}")
        assert page not in self.pages
        self.pages.add(page)

    @rule(number=st.integers(0, 1))
    def leave(self, number: int) -> None:
        if page := self._page(number):
            self._end(self.control.leave(page))
            self.pages.discard(page)
            self.gone.append(page)

    @rule(number=st.integers(0, 1), moving=st.booleans(), force=st.booleans())
    def take(self, number: int, moving: bool, force: bool) -> None:
        if page := self._page(number):
            before = self.control.holder
            refused = self.control.take(page, moving=moving, force=force)
            if before not in (None, page) and (moving or not force):
                assert refused
                assert self.control.holder == before
            else:
                assert self.control.holder == page
                if before is not None and before != page:
                    self._end_all_of(before)

    @precondition(lambda self: self.gone)
    @rule(moving=st.booleans(), force=st.booleans())
    def take_after_leaving(self, moving: bool, force: bool) -> None:
        """It waited for another console, and the page was closed meanwhile."""
        before = self.control.holder
        assert self.control.take(self.gone[-1], moving=moving, force=force)
        assert self.control.holder == before

    @rule(number=st.integers(0, 1))
    def give(self, number: int) -> None:
        if page := self._page(number):
            self._end(self.control.give(page))
            assert self.control.holder != page

    @rule(motion=st.integers(0, 2))
    def another_motion(self, motion: int) -> None:
        """The session ended, and another one may have begun."""
        self.motion = motion and self.motion + motion

    @rule(number=st.integers(0, 1), ahead=st.integers(-2, 2))
    def hold(self, number: int, ahead: int) -> None:
        if page := self._page(number):
            hold = self._hold_of(page, ahead)
            press = self.control.hold(page, hold, self._next_report(), self.motion)
            if press is not None:
                again = self.control.hold(page, hold, self.reports, self.motion)
                assert again is None, "a repeated report counts for nothing"
            if press is None:
                self.refused[page] = max(hold, self.refused.get(page, 0))
                return
            assert hold > self.refused.get(page, 0), "what was refused has to be pressed again"
            assert self.motion, "there is something to move"
            begun_in = self.begun_in.setdefault(press, self.motion)
            assert begun_in == self.motion, "a press is over with its session"
            assert self.control.holder == page, "only who has control"
            assert press not in self.ended, "what ended is over"
            assert self.begun.setdefault(press, (page, hold)) == (page, hold)
            assert press >= self.newest, "numbers rise"
            self.newest = press

    @rule(number=st.integers(0, 1), ahead=st.integers(-2, 1))
    def let_go(self, number: int, ahead: int) -> None:
        if page := self._page(number):
            hold = self._hold_of(page, ahead)
            self._end(self.control.let_go(page, hold))
            assert self.control.hold(page, hold, self._next_report(), 1) is None

    @invariant()
    def one_holder(self) -> None:
        assert self.control.holder is None or self.control.holder in self.pages
        assert (self.control.holder_name() is None) == (self.control.holder is None)

    def _page(self, number: int) -> int | None:
        return sorted(self.pages)[number % len(self.pages)] if self.pages else None

    def _next_report(self) -> int:
        self.reports += 1
        return self.reports

    def _hold_of(self, page: int, ahead: int) -> int:
        """A number near the last one that this page named."""
        self.named[page] = max(1, self.named.get(page, 0) + ahead)
        return self.named[page]

    def _end(self, press: int | None) -> None:
        if press is not None:
            self.ended.add(press)

    def _end_all_of(self, page: int) -> None:
        self.ended |= {press for press, (owner, _) in self.begun.items() if owner == page}


TestControl = ControlMachine.TestCase


@given(st.integers(1, 1000))
def test_a_press_that_was_let_go_before_it_arrived_is_over(hold: int) -> None:
    control = PageControl(lambda: 1)
    page = control.join("a")
    control.take(page, moving=False)
    control.let_go(page, hold)
    assert control.hold(page, hold, 1, 1) is None
    assert control.hold(page, hold + 1, 2, 1) is not None


@given(st.lists(st.integers(1, 9), min_size=1))
def test_a_report_that_is_repeated_or_overtaken_counts_for_nothing(numbers: list[int]) -> None:
    control = PageControl(lambda: 1)
    page = control.join("a")
    control.take(page, moving=False)
    counted = [seq for seq in numbers if control.hold(page, 1, seq, 1) is not None]
    assert counted == sorted(set(counted))
    assert max(numbers) in counted


@given(st.integers(1, 1000), st.integers(0, 1000))
def test_a_press_that_began_without_control_is_over(hold: int, earlier: int) -> None:
    """Nor does one before it count: words of old presses may be sent again."""
    control = PageControl(lambda: 1)
    page = control.join("a")
    assert control.hold(page, hold, 1, 1) is None
    control.take(page, moving=False)
    assert control.hold(page, hold, 2, 1) is None
    assert control.hold(page, max(hold - earlier, 1), 3, 1) is None
    assert control.hold(page, hold + 1, 4, 1) is not None


def test_only_who_has_control_operates_and_service_mode_is_asked_for() -> None:
    control = PageControl(lambda: 1)
    first, second = control.join("a"), control.join("b")
    assert first != second
    assert [control.mode(page) for page in (first, second)] == ["observe", "observe"]
    control.set_service(first, True)
    assert control.mode(first) == "observe", "who has no control enters nothing"
    control.take(first, moving=False)
    assert [control.mode(page) for page in (first, second)] == ["operate", "observe"]
    control.set_service(first, True)
    assert [control.mode(page) for page in (first, second)] == ["service", "observe"]
    control.give(first)
    control.take(second, moving=False)
    assert control.mode(second) == "operate", "service mode ends with control"


@pytest.mark.parametrize("moving", [False, True])
def test_a_holder_is_named_when_control_is_refused(moving: bool) -> None:
    control = PageControl(lambda: 1)
    first, second = control.join("10.0.0.1"), control.join("10.0.0.2")
    assert control.take(first, moving=moving) == ""
    assert "10.0.0.1" in control.take(second, moving=moving)
    assert control.holder_name() == "page 1 on 10.0.0.1"


def test_two_consoles_at_once_never_number_a_press_alike() -> None:
    """A restarted or second console continues no press of another."""
    times = iter(range(1_000, 2_000))
    consoles = [PageControl(lambda: next(times)) for _ in range(2)]
    pages = [control.join("a") for control in consoles]
    for control, page in zip(consoles, pages, strict=True):
        control.take(page, moving=False)
    seen: list[int | None] = []
    for hold in range(1, 20):
        seen += [c.hold(p, hold, hold, 1) for c, p in zip(consoles, pages, strict=True)]
    assert len(set(seen)) == len(seen)
    assert None not in seen


# Several consoles of one robot.

BUS = BusSettings("udp_multicast", "239.74.9.12")
RIG = load_rig(CONFIGS / "gachon_8_6.yaml").with_bus(BUS.interface, BUS.channel)


class OneConsole:
    """A console with two pages."""

    def __init__(self) -> None:
        self.pages = PageControl(lambda: 1)
        self.bus = BusControl(RIG, self.pages, threading.Lock())
        self.numbers = [self.pages.join(f"host {n}") for n in range(2)]


class ConsolesMachine(RuleBasedStateMachine):
    """Two consoles take and give control; whichever waits, the other one looks meanwhile."""

    def __init__(self) -> None:
        super().__init__()
        self.folder, self.patch = tempfile.TemporaryDirectory(), pytest.MonkeyPatch()
        self.patch.setenv("XDG_STATE_HOME", self.folder.name)
        self.patch.setattr(locks, "SHARED", Path(self.folder.name) / "none")
        self.patch.setattr(locks, "time", self)
        self.now = 0.0
        self.moving = False
        self.answers = True
        self.consoles = [OneConsole(), OneConsole()]

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        if self.answers:
            self.look()

    @rule()
    def look(self) -> None:
        for console in self.consoles:
            console.bus.update(moving=self.moving)

    @rule(moving=st.booleans(), answers=st.booleans())
    def change(self, moving: bool, answers: bool) -> None:
        self.moving, self.answers = moving, answers

    @rule(here=st.integers(0, 1), page=st.integers(0, 1), force=st.booleans())
    def take(self, here: int, page: int, force: bool) -> None:
        console, other = self.consoles[here], self.consoles[1 - here]
        number, before = console.numbers[page], other.pages.holder
        own = console.pages.holder
        why_not = console.bus.take(number, moving=self.moving, force=force)
        assert bool(why_not) == (console.pages.holder != number)
        if before is not None:
            assert bool(why_not) == (self.moving or not force or not self.answers)
            if why_not:
                assert other.pages.holder == before
                assert "has control, and keeps it" in why_not
        elif own in (None, number) and (self.answers or own == number):
            assert why_not == ""

    @rule(here=st.integers(0, 1), page=st.integers(0, 1))
    def give(self, here: int, page: int) -> None:
        self.consoles[here].pages.give(self.consoles[here].numbers[page])

    @invariant()
    def one_page_has_control(self) -> None:
        holders = [console.pages.holder for console in self.consoles]
        assert None in holders

    @invariant()
    def the_others_know_who(self) -> None:
        for _ in range(2):  # one sees what the other one did last
            self.look()
        names = {console.pages.holder_name() for console in self.consoles}
        if any(console.pages.holder is not None for console in self.consoles):
            assert all("on host" in (name or "") for name in names)
        else:
            assert names == {None}

    def teardown(self) -> None:
        for console in self.consoles:
            console.bus.close()
        self.patch.undo()
        self.folder.cleanup()


TestConsoles = ConsolesMachine.TestCase


@pytest.mark.parametrize("file", ["control", "control-wanted"])
def test_a_lock_of_control_that_cannot_be_made_gives_no_control(
    file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    path = state_file(file, BUS).with_suffix(".lock")
    path.mkdir(parents=True)
    console = OneConsole()
    with pytest.raises(Refused, match="it is a folder"):
        console.bus.take(console.numbers[0], moving=False, force=True)
    assert console.pages.holder is None


def test_a_page_that_left_while_it_waited_for_another_console_gets_no_control(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    one, other = OneConsole(), OneConsole()
    (page, _), (rival, _) = one.numbers, other.numbers
    assert other.bus.take(rival, moving=False, force=False) == ""

    class Meanwhile:
        now = 0.0

        def monotonic(self) -> float:
            return self.now

        def sleep(self, seconds: float) -> None:
            self.now += seconds
            if page in one.pages._pages:
                one.pages.leave(page)
            other.bus.update(moving=False)

    monkeypatch.setattr(locks, "time", Meanwhile())
    assert one.bus.take(page, moving=False, force=True) == "the page has left"
    one.bus.update(moving=False)
    assert (one.pages.holder, one.pages.holder_name()) == (None, None)
    assert other.bus.take(rival, moving=False, force=False) == "", "the lock is free again"
    for console in (one, other):
        console.bus.close()


def test_control_of_a_console_that_was_killed_is_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    lock, killed = ControlLock(BUS), ControlLock(BUS)
    assert killed.take("page 1", force=False) == ""
    assert lock.holder() == "page 1"
    assert killed._held is not None
    os.close(killed._held)  # as the system does
    assert lock.holder() is None
    assert lock.take("page 2", force=False) == ""
    lock.release()
