"""Runs over a bus between two processes in real time, and a stop from a third one."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from executor.recording.run_folder import RunFolder
from executor.remote.client import ask_all
from executor.remote.command_socket import find_runs
from model.rig import load_rig

ROOT = Path(__file__).parents[2]
PROGRAM = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from cdpr.cli import main; main()"
ENDS_WITHIN_S = 90.0

pytestmark = [pytest.mark.slow, pytest.mark.real_time]


@contextmanager
def program(
    *arguments: str | Path, within: float = ENDS_WITHIN_S
) -> Iterator[subprocess.Popen[str]]:
    """`cdpr ARGUMENTS` in a separate process, which does not outlive the block."""
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *map(str, arguments)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = threading.Timer(within, process.kill)
    deadline.start()
    try:
        yield process
    finally:
        deadline.cancel()
        deadline.join()
        process.kill()
        process.communicate()


def finished(*arguments: str | Path) -> tuple[int, str, str]:
    """Exit code and output of a process that ends on its own."""
    with program(*arguments) as process:
        out, err = process.communicate()
        return process.returncode, out, err


def over_udp(rig: Path, plan: Path, run: Path, port: int) -> tuple[int, dict[str, Any], str]:
    """One run with the drives in another process; exit code, summary, last status words."""
    bus = ("--interface", "udp_multicast", "--channel", f"239.74.163.21:{port}")
    with program("sim", rig, *bus, "--plan", plan) as drives:
        assert drives.stdout is not None
        greeting = drives.stdout.readline()
        assert "8 simulated drives of gachon_8_6" in greeting, drives.communicate()
        second, _, refusal = finished("sim", rig, *bus)
        assert second == 3, refusal
        assert "already answer" in refusal
        code, out, err = finished(
            *(
                "run",
                plan,
                "--rig",
                rig,
                "-o",
                run,
                *bus,
                "--no-camera",
                "--yes",
                "--json",
                "--without-real-time",
            )
        )
        assert err == "" or "remark" in err, err
        drives.send_signal(signal.SIGINT)
        last, trouble = drives.communicate()
        assert drives.returncode == 0, trouble
    return code, json.loads(out), last


def test_a_run_with_the_drives_in_another_process_loses_no_frame(
    slow_rig: Path, short_plan: Path, tmp_path: Path
) -> None:
    rig = tmp_path / "rig.yaml"  # with drives that monitor one other each
    rig.write_text(slow_rig.read_text() + "drives: {type: cia402, profile: nanotec-c5e}\n")
    code, summary, last = over_udp(rig, short_plan, tmp_path / "run", 40000 + os.getpid() % 20000)
    cycle_ms = load_rig(slow_rig).document.bus.cycle_ms
    assert code == 0, summary
    assert summary["verdict"] == "PASSED"
    assert summary["lost_replies"] == 0
    said = any(event["code"] == "simulated" for event in summary["events"])
    assert summary["simulated"] is said
    (remark,) = (event["text"] for event in summary["events"] if event["code"] == "remark")
    assert "1016h has 1 heartbeat entry" in remark
    assert summary["fast"] is False
    assert summary["following_error_mm"]["max"] <= 0.1
    assert summary["lateness_ms"]["p50"] < cycle_ms
    # On a clock of its own, beside the number of the cycle: late cycles make it longer.
    nominal = summary["cycles"] * cycle_ms / 1000.0
    assert nominal - cycle_ms / 1000.0 <= summary["duration_s"] <= 2.0 * nominal
    assert last == "simulation ended\n"


def waited_for(events: Path, code: str, process: subprocess.Popen[str]) -> None:
    """Waits until the run has written an event, or ended."""
    while process.poll() is None:
        if events.is_file() and f'"{code}"' in events.read_text():
            return
        signal.sigtimedwait([], 0.01)
    pytest.fail(f"the run ended before {code!r}: {process.communicate()}")


def send(command: str, percent: int | None = None) -> None:
    """Sends a command from here: another terminal takes longer to start than the path lasts."""
    with find_runs() as runs:
        (answer,) = ask_all(runs, command, percent)
    assert answer.status is not None


def test_stop_from_another_terminal_ends_a_run_along_its_path(
    slow_rig: Path, short_plan: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    with program("run", short_plan, "--rig", slow_rig, "-o", run, "--no-camera") as moving:
        waited_for(run / "events.jsonl", "moving", moving)
        send("speed", 1)
        code, out, err = finished("stop", "--json")
        assert (code, err) == (0, "")
        assert json.loads(out) == {"stopped_processes": [moving.pid], "silent_processes": []}
        said, trouble = moving.communicate()
        assert moving.returncode == 130, trouble
    assert "STOPPED" in said
    summary = RunFolder.open(run).summary()
    assert summary["final_state"] == "stopped"
    assert summary["travelled_mm"] < summary["path_length_mm"] - 1.0
    assert [event["code"] for event in summary["events"]][-2:] == ["stop", "held"]
    code, out, _ = finished("stop", "--json")
    assert code == 1
    assert json.loads(out) == {"stopped_processes": [], "silent_processes": []}


def test_a_terminal_that_is_closed_is_a_stop_too(
    slow_rig: Path, short_plan: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    with program("run", short_plan, "--rig", slow_rig, "-o", run, "--no-camera") as moving:
        waited_for(run / "events.jsonl", "moving", moving)
        moving.send_signal(signal.SIGHUP)
        moving.communicate()
        assert moving.returncode == 130
    assert RunFolder.open(run).summary()["verdict"] == "STOPPED"
