"""Keys of the terminal: they monitor and control a run, and hold a jog."""

from __future__ import annotations

import errno
import os
import pty
import sys
import termios
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cdpr.cli.operate import jog, monitor
from cdpr.cli.operate.jog import JogKeys
from cdpr.cli.operate.supervision import NAMES, Keys, SignalSupervisor, names_of
from cdpr.cli.output import Terminal, progress_bar
from executor.hold_to_run.line import JogProver
from executor.hold_to_run.presses import TIMEOUT, PressBoard
from executor.hold_to_run.session import jog_session
from executor.remote import client
from executor.remote.client import StopResult, follow_run
from executor.remote.command_server import serving
from executor.remote.command_socket import RunConnection
from executor.remote.protocol import make_line, parse_command
from executor.remote.status import WinchStatus
from executor.state_machine import CycleRecord, State
from executor.supervision import LocalRequests
from model.errors import BadInput, Fault, StoppedByOperator
from model.pose import Pose
from model.rig import load_rig
from tests.cli.plans import RIG
from tests.cli.program import call
from tests.cli.test_monitor import status
from tests.executor import fake_run
from tests.executor.sockets import advertised

SENT = {name: b"\x1b[" + code for code, name in NAMES.items()} | {
    sign: sign.encode() for sign in " hrq+-f"
}


@given(st.lists(st.sampled_from([*SENT, "unknown"])))
def test_keys_are_distinguished_however_many_come_at_once(keys: list[str]) -> None:
    data = b"".join(SENT.get(key, b"\x1b[1;5P") for key in keys)
    assert names_of(data) == [key for key in keys if key != "unknown"]


@given(st.binary(max_size=40))
def test_no_bytes_are_too_odd(data: bytes) -> None:
    assert all(name in NAMES.values() or len(name) == 1 for name in names_of(data))


@contextmanager
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """The other end of a terminal that is standard input."""
    operator, program = pty.openpty()
    with os.fdopen(program) as stream, monkeypatch.context() as patched:
        patched.setattr(sys, "stdin", stream)
        yield operator
    os.close(operator)


def test_keys_come_without_enter_and_the_terminal_is_left_as_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with terminal(monkeypatch) as operator:
        before = termios.tcgetattr(sys.stdin)
        with Keys() as keys:
            assert not termios.tcgetattr(sys.stdin)[3] & (termios.ICANON | termios.ECHO)
            assert keys.pressed() == []
            os.write(operator, b"h\x1b[A")
            assert keys.pressed(wait=10.0) == ["h", "up"]
            os.write(operator, b"rm -rf\n")  # not for the shell
        assert termios.tcgetattr(sys.stdin) == before


def test_a_closed_terminal_does_not_hide_how_its_session_ended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    operator, program = pty.openpty()
    with os.fdopen(program) as stream:
        monkeypatch.setattr(sys, "stdin", stream)
        keys = Keys()
        with pytest.raises(StoppedByOperator), keys:
            raise _stopped_by_closing(operator)


def _stopped_by_closing(terminal: int) -> StoppedByOperator:
    os.close(terminal)
    return StoppedByOperator("stopped; the drives hold")


def test_a_pipe_has_no_keys(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "input").touch()
    with (tmp_path / "input").open() as stream:
        monkeypatch.setattr(sys, "stdin", stream)
        with pytest.raises(BadInput, match="not a terminal"):
            Keys()


class Typed:
    """Keys by simulated time, instead of a terminal."""

    def __init__(self, script: Sequence[tuple[float, float, str]]) -> None:
        self._script, self.now = script, 0.0

    def __enter__(self) -> Typed:
        return self

    def __exit__(self, *_: object) -> None: ...

    def pressed(self, wait: float = 0.0) -> list[str]:
        return [key for begin, end, key in self._script if begin <= self.now < end]


def jogged(script: Sequence[tuple[float, float, str]] | Typed) -> list[tuple[float, Any]]:
    """Time and position of the platform in every cycle once the drives are ready."""
    typed, seen = script if isinstance(script, Typed) else Typed(script), []
    keys = JogKeys(typed, 20.0)  # type: ignore[arg-type]
    begun: list[float] = []

    def on_cycle(record: CycleRecord, presses: PressBoard, prover: JogProver) -> None:
        begun.append(record.at)
        typed.now = record.at - begun[0]
        keys.take_cycle(record, presses, prover)
        seen.append((typed.now, prover.pose.position))

    with keys:
        jog_session(
            load_rig(RIG), None, realtime=False, on_cycle=on_cycle, supervisor=SignalSupervisor()
        )
    return seen


def test_the_platform_moves_while_a_key_repeats_and_rests_soon_after() -> None:
    seen = jogged([(1.0, 2.0, "right"), (4.0, 9.0, "q")])
    times, positions = np.array([t for t, _ in seen]), np.array([p for _, p in seen])
    moved = positions[-1] - positions[0]
    assert moved[0] > 0.010
    assert np.abs(moved[1:]).max() < 1e-9
    rig = load_rig(RIG)
    to_rest = 0.020 / rig.motion.acceleration + rig.motion.acceleration / rig.motion.jerk
    rests = positions[times > 2.0 + TIMEOUT + to_rest + 0.1]
    assert len(rests) > 20
    assert np.ptp(rests, axis=0).max() == 0.0
    assert times[-1] < 5.0, "q ends the session"


def test_a_second_key_ends_the_press_and_moves_from_rest() -> None:
    seen = jogged([(1.0, 2.0, "up"), (2.0, 3.5, "page up"), (5.0, 9.0, "q")])
    steps = np.diff([p for _, p in seen], axis=0)
    assert np.ptp([p for _, p in seen], axis=0)[1:].min() > 0.002
    assert not ((steps[:, 1] != 0.0) & (steps[:, 2] != 0.0)).any(), "along one axis at a time"


def test_any_other_key_ends_the_press() -> None:
    """At once: a key that is merely released counts as held for another `TIMEOUT`."""
    released = jogged([(1.0, 1.3, "right"), (2.5, 9.0, "q")])
    for key in "-fx":
        seen = jogged([(1.0, 1.3, "right"), (1.3, 1.4, key), (2.5, 9.0, "q")])
        assert seen[-1][1][0] < released[-1][1][0], key


def test_a_key_that_waited_while_the_program_paused_begins_no_press(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It may have been released meanwhile: a terminal does not tell."""
    clock, held = [0.0], Mock()
    monkeypatch.setattr(jog, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    record: Any = SimpleNamespace(state=State.MOVING, at=0.0)
    prover: Any = SimpleNamespace(pose=Pose.level([0.0, 0.0, 0.4]), limit="")
    with JogKeys(Typed([(0.0, 9.0, "right")]), 20.0) as keys:  # type: ignore[arg-type]
        counts = []
        for pause in (0.0, 0.01, TIMEOUT + 0.05, 0.01):
            clock[0] += pause
            keys.take_cycle(record, held, prover)
            counts.append(held.hold.call_count)
    assert [counts[0] > 0, *(b > a for a, b in pairwise(counts))] == [True, True, False, True]


def test_a_wall_clock_that_is_set_back_ends_no_later_press(monkeypatch: pytest.MonkeyPatch) -> None:
    """As NTP does; the keys and consoles of one jog session share the numbers."""
    wall = iter([1_800_000_000_000_000_000, 1_799_999_998_000_000_000])
    monkeypatch.setattr(time, "time_ns", lambda: next(wall))
    record: Any = SimpleNamespace(state=State.MOVING, at=0.0)
    prover: Any = SimpleNamespace(pose=Pose.level([0.0, 0.0, 0.4]), limit="")
    held = Mock()
    for _ in range(2):
        with JogKeys(Typed([(0.0, 9.0, "right")]), 20.0) as keys:  # type: ignore[arg-type]
            keys.take_cycle(record, held, prover)
    first, second = (one.args[0] for one in held.hold.call_args_list)
    assert second >= first


@pytest.mark.parametrize(("rigs", "asked", "shown"), [(10, 20, 10.0), (50, 20, 20.0)])
def test_the_speed_that_is_shown_is_that_of_the_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rigs: int, asked: int, shown: float
) -> None:
    rig = tmp_path / "rig.yaml"
    text = RIG.read_text()
    assert text.count(" speed_mm_s: 20") == 1
    rig.write_text(text.replace(" speed_mm_s: 20", f" speed_mm_s: {rigs}"))
    speeds: list[float] = []
    monkeypatch.setattr(jog, "Keys", Mock())
    monkeypatch.setattr(jog, "JogKeys", lambda _keys, speed: speeds.append(speed))
    monkeypatch.setattr(jog, "_hold_to_run", lambda *_: None)
    assert call("jog", rig, "--keys", "--no-scene", "--speed-mm-s", asked).code == 0
    assert speeds == pytest.approx([shown])


def test_space_stops_the_session_while_it_moves() -> None:
    with pytest.raises(StoppedByOperator):
        jogged([(1.0, 9.0, "right"), (1.5, 1.51, " ")])


class Closing(Typed):
    """The terminal is closed at a time: from then on it raises whenever it is used."""

    def pressed(self, wait: float = 0.0) -> list[str]:
        if self.now >= 1.5:
            assert not self.was_closed, "it is not used again"
            self.was_closed = True
            raise OSError(errno.EIO, "Input/output error")
        return super().pressed(wait)

    was_closed = False


def test_a_terminal_that_is_closed_in_a_jog_is_the_operators_stop(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(StoppedByOperator):
        jogged(Closing([(1.0, 9.0, "right")]))


@pytest.mark.parametrize("shown", [False, True])
def test_text_for_a_closed_terminal_ends_no_motion_even_while_a_bar_is_shown(
    monkeypatch: pytest.MonkeyPatch, shown: bool
) -> None:
    closed = Mock(spec=["write", "flush", "isatty", "encoding"], encoding="utf-8")
    closed.isatty.return_value = True
    closed.write.side_effect = OSError(errno.EIO, "Input/output error")
    monkeypatch.setattr(sys, "stderr", closed)
    monkeypatch.setenv("TERM", "xterm")
    with progress_bar("moving", 10.0, shown=True) if shown else nullcontext():
        Terminal().note("stop requested")
    assert closed.write.called


def test_a_closed_terminal_has_no_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    operator, program = pty.openpty()
    with os.fdopen(program) as stream:
        monkeypatch.setattr(sys, "stdin", stream)
        keys = Keys()
        os.close(operator)
        with pytest.raises(OSError, match=r"Input/output error|closed"):
            keys.pressed(wait=10.0)


class Script:
    """Scripted keys, one list per call."""

    def __init__(self, *keys: str) -> None:
        self._keys = list(keys)

    def pressed(self, wait: float = 0.0) -> list[str]:
        return [self._keys.pop(0)] if self._keys else []


def test_the_monitors_keys_ask_what_the_verbs_ask(monkeypatch: pytest.MonkeyPatch) -> None:
    stopped: list[int] = []
    monkeypatch.setattr(monitor, "stop_runs", lambda: stopped.append(1) or StopResult((7,), ()))
    operator = monitor._Operator(Script("h", "r", "+", "+", "-", " ", "x", "q"))  # type: ignore[arg-type]
    operator.status = status()  # wished speed: 50 %
    said = [parse_command(line) for _ in range(5) for line in operator.between(0.0)]
    assert [one.command for one in said] == ["hold", "resume", "speed", "speed", "speed"]
    assert [one.percent for one in said[2:]] == [60, 70, 60]  # type: ignore[union-attr]
    assert list(operator.between(0.0)) == []
    assert stopped == [1]
    assert operator.line == "stop requested"
    assert list(operator.between(0.0)) == []
    with pytest.raises(KeyboardInterrupt):
        operator.between(0.0)


def test_keys_before_a_run_ask_for_nothing() -> None:
    operator = monitor._Operator(Script("h", "+"))  # type: ignore[arg-type]
    assert [*operator.between(0.0), *operator.between(0.0)] == []


def test_a_run_is_waited_for_and_takes_what_it_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    board, looks = LocalRequests(), iter([False, False, True])
    find_runs, passed = client.find_runs, [0.0]

    @contextmanager
    def later() -> Iterator[list[RunConnection]]:
        if not next(looks):
            yield []
            return
        with find_runs() as runs:
            yield [run for run in runs if run.process == os.getpid()]

    def between(seconds: float) -> list[bytes]:
        passed[0] += seconds
        return [make_line("hold")]

    monkeypatch.setattr(client, "find_runs", later)
    run_status = WinchStatus(load_rig(RIG), board, simulated_time=False)
    with advertised() as listeners, serving(listeners, board, run_status):
        following = follow_run(None, 10.0, waits=True, between=between)
        first = next(following)
        assert passed[0] == pytest.approx(2 * client.POLL_INTERVAL)
        assert not first["wished"]["hold"]
        assert next(following)["wished"]["hold"]
        following.close()


def test_a_key_that_a_session_of_jogs_rejects_ends_no_monitor() -> None:
    keys = Script("h", "+", "x", "h")
    operator = monitor._Operator(keys)  # type: ignore[arg-type]
    board, presses = LocalRequests(), PressBoard(lambda: 0.0)
    session = WinchStatus(load_rig(RIG), board, simulated_time=False)
    with advertised() as listeners, serving(listeners, board, session, presses):
        following = follow_run(
            os.getpid(), 10.0, between=operator.between, rejected=operator.rejected
        )
        for _ in range(4):
            operator.status = next(following)
        assert "a session of jogs has no path" in operator.line
        following.close()
        strict = follow_run(os.getpid(), 10.0, between=operator.between)
        next(strict)
        with pytest.raises(Fault, match="has no path"):
            next(strict)


def test_the_monitor_shows_where_the_platform_is_by_the_runs_own_rig(tmp_path: Path) -> None:
    run = fake_run.make(rate_hz=2.0, every=20)
    folder = fake_run.write(run, tmp_path / "run", pictures=False)
    k = len(run.cycles) // 2
    drives = [
        {"node": i + 1, "state": "operation enabled", "torque": "enabled"}
        | {"position_counts": int(counts)}
        | {"set_counts": int(counts), "tension_n": float(run.cycles.planned_tensions[k, i])}
        for i, counts in enumerate(run.cycles.set_counts[k])
    ]
    run_status = status(folder=str(folder.path), drives=drives)
    seen = monitor._Robot().seen(run_status)
    assert seen is not None
    view, robot = seen
    np.testing.assert_allclose(robot.pose.position, run.cycles.planned[k], atol=2e-5)
    assert robot.nearest is not None
    assert view.scene.obstacles, "those of the plan that is run"
    x, y, z = 1e3 * robot.pose.position
    assert f"platform {x:.1f}, {y:.1f}, {z:.1f} mm" in monitor._where(view, robot)


def test_a_run_that_ends_before_it_says_a_word_is_a_message(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(monitor, "follow_run", lambda *_, **__: iter(()))
    answer = call("monitor", "--once", "--wait")
    assert answer.code == 1
    assert "no active run" in answer.err
