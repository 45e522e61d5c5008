"""Two users of one computer and one bus, as their own users of the system."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from drivers.can_bus import BusSettings
from executor.interlock import locks as state_folder
from executor.interlock.fault_latch import FaultLatch
from model.errors import Refused

BUS = BusSettings("socketcan", "can0")
ANN, BEN, GROUP = 60001, 60002, 60000

pytestmark = pytest.mark.root


class User:
    """A user's program that executes actions in sequence."""

    def __init__(self, number: int) -> None:
        context = multiprocessing.get_context("fork")
        self._link, far_end = context.Pipe()
        self.process = context.Process(target=_serve, args=(number, far_end))
        self.process.start()

    def does(self, what: Callable[[FaultLatch], object]) -> str:
        """Its output: empty if all went well."""
        self._link.send(what)
        return str(self._link.recv())

    def killed(self) -> None:
        self.process.kill()
        self.process.join()

    def close(self) -> None:
        self.killed()
        self._link.close()
        self.process.close()


def _serve(number: int, link: Connection) -> None:
    os.setgroups([])
    os.setgid(GROUP)
    os.setuid(number)
    latch = FaultLatch(BUS)
    while True:
        what = link.recv()
        try:
            what(latch)
            link.send("")
        except Refused as error:
            link.send(f"{error.what} | {error.next_step}")


def moves(latch: FaultLatch) -> None:
    latch.engage("rig", latch.path.parent)


def would_move(latch: FaultLatch) -> None:
    latch.require_disengaged()


def would_reset(latch: FaultLatch) -> None:
    latch.require_no_run()


def resets(latch: FaultLatch) -> None:
    with latch.held_for_reset("rig", latch.read()):
        pass


@pytest.fixture
def users(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[User, User]]:
    """Ann and Ben share the folder described in `docs/safety.md`."""
    shared = Path(tempfile.mkdtemp(dir="/tmp"))  # not below a folder that is closed to others
    os.chown(shared, 0, GROUP)
    shared.chmod(0o2775)
    monkeypatch.setattr(state_folder, "SHARED", shared)
    both = User(ANN), User(BEN)
    yield both
    for user in both:
        user.close()
    shutil.rmtree(shared)


def test_what_one_user_moves_the_other_leaves_alone_and_what_is_left_of_it_he_may_reset(
    users: tuple[User, User],
) -> None:
    ann, ben = users
    assert ben.does(would_move) == ""
    assert ann.does(moves) == ""
    for act in (would_move, would_reset, moves):
        assert f"(process {ann.process.pid}) is in progress" in ben.does(act)
    ann.killed()
    message = ben.does(would_move)
    assert "did not finish" in message
    assert "cdpr reset RIG" in message
    assert ben.does(would_reset) == ""
    assert ben.does(resets) == ""
    assert ben.does(would_move) == ""
    assert ben.does(moves) == ""
