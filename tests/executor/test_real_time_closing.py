"""The requests of a run after the real-time process is closed."""

from __future__ import annotations

from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import Any

import pytest

from executor.realtime import process as real_time_process
from executor.realtime.child import Armed, Ended
from executor.realtime.shared_memory import SharedRequests
from executor.state_machine import State


class Still:
    """A motion that does nothing."""

    cables, cycle = 8, 0.004

    def close(self) -> None:
        pass


def arms_and_ends(_job: Any, link: Connection, _supervisor: int) -> None:
    link.send(Armed("", None))  # type: ignore[arg-type]  # nobody asks where
    try:
        link.recv()
    except EOFError:
        return
    link.send(Ended(State.FINISHED, "", holding=True, true_pose=None))


@pytest.mark.parametrize("goes", [True, False])
def test_a_motion_that_is_over_leaves_no_stop_behind_on_the_board(
    monkeypatch: pytest.MonkeyPatch, goes: bool
) -> None:
    """The last images are then waited for, briefly only if the operator stopped."""
    monkeypatch.setattr(real_time_process, "serve", arms_and_ends)
    board, nobody_listens = SharedRequests(), SimpleNamespace()
    motion_on_board: Any = (Still(), print, board)
    try:
        with real_time_process.real_time_process(
            *motion_on_board, need_real_time=False, check_drives=str
        ) as process:
            process.arm(nobody_listens)  # type: ignore[arg-type]
            if goes:
                assert process.run().state is State.FINISHED
        assert board.read().stop is not goes
    finally:
        board.close()
