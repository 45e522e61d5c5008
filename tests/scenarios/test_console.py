"""The console with simulated drives on a bus: jog, teach, plan, run, hold, resume, stop.

Tests wait for states of the console, 20 per second, and never count seconds.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from executor.remote.client import stop_runs
from executor.remote.command_socket import find_runs
from tests.cli.plans import CONFIGS
from tests.console.cut import receive
from tests.scenarios.test_processes import program

pytestmark = [pytest.mark.slow, pytest.mark.real_time]

#: Largest number of states to wait for.
PATIENCE = 3000
#: Time-out of programs left by a test, [s].
ENDS_WITHIN_S = 400.0


class Busy(Exception):
    """The computer let a cycle of 100 ms begin late, which a rig answers with a stop, latched."""


class Operator:
    """An operator without a browser."""

    def __init__(self, page: ClientConnection) -> None:
        self._page, self._press, self._reports = page, 0, 0
        self.state: dict[str, Any] = {}
        self.bears_late_cycles = False

    def until(self, holds: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        """The first state that meets a condition."""
        for _ in range(PATIENCE):
            message = receive(self._page)
            if message["kind"] == "state":
                self.state = message
                late = "cycles late" in (message["latched"] or "")
                if late and not self.bears_late_cycles:
                    raise Busy(message["latched"])
                if holds(message):
                    return self.state
        raise AssertionError(f"it did not happen: {self.state}")

    def command(self, command: str, **values: Any) -> dict[str, Any]:
        """The console's answer."""
        self._page.send(json.dumps({"kind": "command", "id": 1, "command": command, **values}))
        while True:
            message = receive(self._page)
            if message["kind"] == "answer":
                return message

    def does(self, command: str, **values: Any) -> dict[str, Any]:
        """Starts a verb and waits for its end."""
        assert self.command(command, **values)["ok"]
        self.until(lambda state: state["busy"] is not None or state["outcome"] is not None)
        return self.until(lambda state: state["busy"] is None)["outcome"]

    def jog(self, axis: int, distance_mm: float) -> None:
        """Holds a control until the platform has moved this far; presses again if a press ends."""
        begin = self.until(lambda state: state["platform"])["platform"]["position_mm"][axis]
        direction = [0.0, 0.0, 0.0]
        direction[axis] = 1.0 if distance_mm > 0.0 else -1.0
        tries = iter(range(PATIENCE))

        def gone(state: dict[str, Any]) -> bool:
            if next(tries) % 40 == 0:
                self.press()
            self.held(direction)
            moved = state["platform"]["position_mm"][axis] - begin
            return bool(moved / distance_mm >= 1.0)

        self.until(gone)
        self._page.send(json.dumps({"kind": "let_go", "hold": self._press}))
        self.until(lambda state: not state["jog"]["moving"])

    def press(self) -> None:
        """Begins a new press."""
        self._press += 1

    def held(self, direction: list[float]) -> None:
        """Sends one report of a press."""
        word = {"kind": "held", "hold": self._press, "direction": direction, "frame": "world"}
        self._reports += 1
        word |= {"step_mm": None, "speed_mm_s": 20.0, "seq": self._reports}
        word["state"] = self.state["seq"]
        self._page.send(json.dumps(word))

    def winds_in(self, cable: int, state: dict[str, Any]) -> float:
        """Keeps holding, with new presses if one ends; returns the length paid out, [mm]."""
        jog = state["cable"]
        self._reports += 1
        if self._reports % 40 == 1:
            self.press()
        word = {"kind": "held", "hold": self._press, "cable": cable, "sense": "wind_in"}
        word |= {"step_mm": None, "speed_mm_s": 2.0, "seq": self._reports}
        word["state"] = self.state["seq"]
        self._page.send(json.dumps(word))
        return float(jog["press_mm"]) if jog["cable"] == cable else 0.0

    def let_go(self) -> None:
        """The press ends."""
        self._page.send(json.dumps({"kind": "let_go", "hold": self._press}))

    def moves(self, direction: list[float], state: dict[str, Any]) -> bool:
        """Keeps holding; returns whether the platform has begun to move."""
        self.held(direction)
        return bool(state["jog"]["moving"])


@contextmanager
def console(
    rig: Path, bus: tuple[str, ...], within: float = ENDS_WITHIN_S
) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """The program, and the address that it prints."""
    scene = CONFIGS / "environment_1.yaml"
    options = ("--scene", scene, *bus, "--port", "0", "--without-real-time")
    with program("console", rig, *options, within=within) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert "http://" in line, process.communicate()
        yield process, "http://" + line.split("http://")[1].strip()


def page_at(address: str) -> ClientConnection:
    """The socket of a page, at the address that the console printed."""
    host, _, token = address.removeprefix("http://").partition("/?token=")
    return connect(f"ws://{host}/ws?token={token}", origin=f"http://{host}")  # type: ignore[arg-type]


@contextmanager
def operator(address: str) -> Iterator[Operator]:
    with page_at(address) as page:
        found = Operator(page)
        found.until(lambda _: True)
        assert found.command("take_control")["ok"]
        yield found


@contextmanager
def drives(slow_rig: Path, number: int, within: float = ENDS_WITHIN_S) -> Iterator[tuple[str, ...]]:
    """Simulated ones in a process of their own; the options of their bus."""
    channel = f"239.74.163.{22 + number}:{40000 + os.getpid() % 20000}"
    options = ("--interface", "udp_multicast", "--channel", channel)
    with program("sim", slow_rig, *options, within=within) as simulated:
        assert simulated.stdout is not None
        assert "8 simulated drives" in simulated.stdout.readline()
        yield options


Day = Callable[[Path, tuple[str, ...], Path], None]


@pytest.fixture
def on_a_day(
    slow_rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[Day], None]:
    """Runs a scenario with its own drives; repeats it if the computer was too busy."""

    def run(day: Day) -> None:
        for number in range(3):
            folder = tmp_path / str(number)
            folder.mkdir()
            monkeypatch.chdir(folder)
            with drives(slow_rig, number) as bus:
                try:
                    return day(slow_rig, bus, folder)
                except Busy as busy:
                    late = busy
        raise AssertionError(f"three times in a row: {late}")

    return run


def test_a_taught_path_is_planned_run_held_continued_and_stopped(
    on_a_day: Callable[[Day], None],
) -> None:
    on_a_day(taught_and_run)


def taught_and_run(slow_rig: Path, bus: tuple[str, ...], folder: Path) -> None:
    with console(slow_rig, bus) as (process, address), operator(address) as me:
        at_rest = me.until(lambda state: state["platform"])
        assert at_rest["motion"] is None, "the drives are asked at first, too"
        assert at_rest["platform"]["position_mm"] == pytest.approx([0.0, 0.0, 445.0], abs=0.1)
        assert me.command("jog_begin")["ok"]
        me.until(lambda state: state["jog"]["ready"])
        assert me.command("teach", name="low")["ok"]
        me.jog(2, 12.0)
        assert me.command("teach", name="high")["ok"]
        me.jog(0, 12.0)
        assert me.command("teach", name="beside")["ok"]
        assert me.command("jog_end")["ok"]
        ended = me.until(lambda state: state["busy"] is None)["outcome"]
        assert ended["ok"], ended["text"]
        assert [pose["name"] for pose in me.state["poses"]] == ["low", "high", "beside"]
        assert me.command("move", pose="beside", to=0)["ok"]

        planned = me.does("plan")
        assert planned["ok"], planned["text"]
        loaded = me.until(lambda state: state["preview"])
        name, _, shown = loaded["preview"].partition(" ")
        assert name == "console/taught.plan.json"
        assert loaded["plan_start_off_mm"] < 0.2
        assert me.command("run", plan=shown)["ok"]
        me.until(lambda state: state["motion"] and state["motion"]["state"] == "moving")
        assert me.command("hold")["ok"]
        held = me.until(lambda state: state["motion"] and state["motion"]["feed_percent"] == 0.0)
        assert held["motion"]["state"] == "holding"
        assert held["motion"]["next_stop"]["name"] in ("low", "goal")
        assert me.command("resume")["ok"]
        me.until(lambda state: state["motion"] and state["motion"]["feed_percent"] > 50.0)
        stop = urllib.request.Request(f"{address.split('/?')[0]}/stop", method="POST")
        with urllib.request.urlopen(stop, timeout=30) as answer:
            assert json.load(answer) == {"ok": True, "what": ""}
        ended = me.until(lambda state: state["outcome"] and state["busy"] is None)["outcome"]
        assert not ended["ok"]
        assert ended["stopped"]
        assert "STOPPED" in ended["text"]
        assert me.state["plan_start_off_mm"] > 1.0
        assert "plan from its current pose" in me.command("run", plan=shown)["what"]
        assert me.command("plan", scene=None, pose="beside")["ok"]
        me.until(lambda state: state["plan_start_off_mm"] is not None)
        assert me.state["plan_start_off_mm"] < 0.2, "the path begins where the platform stopped"
        assert ended["report"].startswith("/runs/")
        assert process.poll() is None
    assert list((folder / "runs").glob("*/report.html"))


def test_no_press_and_no_session_of_jogs_continues_without_the_console(
    on_a_day: Callable[[Day], None],
) -> None:
    on_a_day(console_killed)


def console_killed(slow_rig: Path, bus: tuple[str, ...], folder: Path) -> None:
    with console(slow_rig, bus) as (process, address), operator(address) as me:
        assert me.command("jog_begin")["ok"]
        me.until(lambda state: state["jog"]["ready"])
        me.jog(2, 2.0)
        me._press += 1
        me.until(lambda state: me.moves([1.0, 0.0, 0.0], state))
        process.send_signal(signal.SIGKILL)
        process.wait()
        # Its record is whole when the session has ended; nothing moves in its last cycles.
        rows: list[str] = []
        record = folder / "runs" / "jog-session"
        until_nothing_is_active()
        rows = (record / "winches.csv").read_text().splitlines()
        events = (record / "events.jsonl").read_text()
        assert '"code": "held"' in events
        assert "stop" not in events, "it ends by itself, in order"
        targets = [row.split(",")[3:11] for row in rows[-10:]]
        assert all(target == targets[0] for target in targets)


def test_jogging_ends_with_the_console(on_a_day: Callable[[Day], None]) -> None:
    on_a_day(console_ended)


def console_ended(slow_rig: Path, bus: tuple[str, ...], folder: Path) -> None:
    with console(slow_rig, bus) as (process, address), operator(address) as me:
        assert me.command("jog_begin")["ok"]
        me.until(lambda state: state["jog"]["ready"])
        process.send_signal(signal.SIGINT)
        assert process.wait() == 0
        until_nothing_is_active()
    events = (folder / "runs" / "jog-session" / "events.jsonl").read_text()
    assert "stop" not in events


def until_nothing_is_active() -> None:
    """Waits until no motion is there any longer."""
    while True:
        with find_runs() as runs:
            if not runs:
                return
        signal.sigtimedwait([], 0.02)


def test_one_cable_moves_in_service_mode_as_long_as_a_page_holds_it(
    on_a_day: Callable[[Day], None],
) -> None:
    on_a_day(one_cable)


def one_cable(slow_rig: Path, bus: tuple[str, ...], folder: Path) -> None:
    with console(slow_rig, bus) as (process, address), operator(address) as me:
        reference = me.until(lambda state: state["platform"])["reference"]
        assert "service mode" in me.command("cable_begin")["what"]
        assert me.command("service_begin")["ok"]
        assert me.command("cable_begin")["ok"]
        me.until(lambda state: state["cable"]["ready"])
        me.until(lambda state: me.winds_in(3, state) < -0.002)
        me.let_go()
        me.until(lambda state: not state["cable"]["moving"])
        assert me.state["cable"]["cable"] == 3
        assert me.state["cable"]["session_mm"][2] == me.state["cable"]["press_mm"]
        assert me.command("jog_end")["ok"]
        ended = me.until(lambda state: state["busy"] is None)["outcome"]
        assert ended["ok"], ended["text"]
        assert me.state["reference"] == reference, "single cables change nothing of it"

        assert me.command("cable_begin")["ok"]
        me.until(lambda state: state["cable"]["ready"])
        me.until(lambda state: me.winds_in(5, state) < 0.0)
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert stop_runs().stopped
        until_nothing_is_active()
    for name, cable in (("jog-cables", 3), ("jog-cables-2", 5)):
        rows = (folder / "runs" / name / "winches.csv").read_text().splitlines()[1:]
        moving = [row.split(",") for row in rows if row.split(",")[2] in ("moving", "stopping")]
        targets = [[int(v) for v in row[3:11]] for row in moving]
        moved = {k for row in targets for k in range(8) if row[k] != targets[0][k]}
        assert moved == {cable - 1}, name
        last = [row.split(",")[3:11] for row in rows[-10:]]
        assert all(target == last[0] for target in last)


def test_bad_requests_never_block_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody reads its standard error here, as where it is started by another program."""
    monkeypatch.chdir(tmp_path)
    with console(CONFIGS / "gachon_8_6.yaml", ()) as (_, address):
        host, port = address.removeprefix("http://").split("/")[0].split(":")
        for _ in range(2500):
            with socket.create_connection((host, int(port)), timeout=30) as connection:
                connection.sendall(b"\x00garbage\r\n\r\n")
                assert b"400" in connection.recv(100)
        with operator(address) as me:
            assert me.command("stop")["what"] == "nothing moves"


def test_a_stop_without_a_run_reports_it(on_a_day: Callable[[Day], None]) -> None:
    on_a_day(nothing_to_stop)


def nothing_to_stop(slow_rig: Path, bus: tuple[str, ...], folder: Path) -> None:
    with console(slow_rig, bus) as (_, address), operator(address) as me:
        none_found = "no motion of this user was found: press the emergency stop if the robot moves"
        assert me.command("stop")["what"] == none_found
        assert "no motion of this user" in me.command("hold")["what"]
        assert "plan" in me.command("run", plan="")["what"]
