"""Drives without absolute encoders: no run before homing, none after a power cycle."""

from __future__ import annotations

import csv
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from drivers.can_bus import BusSettings
from executor.control.path_runs import run_along_path
from executor.interlock.fault_latch import FaultLatch
from executor.interlock.interlock import MotionInterlock
from executor.interlock.reference import ReferenceFile
from executor.trajectory.setpoints import PreparedRun, prepare
from model.errors import Refused
from model.rig import rig_from_document
from simulation.ground_truth import PowerLoss
from tests.cli.program import call
from tests.scenarios.test_real_time import drives_on


@pytest.fixture
def rig(slow_rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A rig without absolute encoders, whose records are written into the test's folder."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "rig.yaml"
    path.write_text(slow_rig.read_text().replace("encoder: absolute, ", ""))
    return path


@dataclass(frozen=True)
class Channel:
    """A bus between processes: its settings, and the options of a verb with it."""

    name: str

    @property
    def settings(self) -> BusSettings:
        return BusSettings("udp_multicast", self.name)

    @property
    def options(self) -> tuple[str, ...]:
        bus = ("--interface", "udp_multicast", "--channel", self.name)
        return (*bus, "--yes", "--without-real-time")


@pytest.fixture
def channel() -> Channel:
    return Channel(f"239.74.163.26:{20000 + (os.getpid() * 19) % 20000}")


def _start(run: PreparedRun) -> list[str]:
    """Coordinates of a run's start as typed, [mm]."""
    return [f"{x:.6f}" for x in run.scene.start.position * 1000.0]


# Two tests with few motions each: the longer the motions of a test, the likelier a busy computer
# holds one of them up.


@pytest.mark.slow
@pytest.mark.real_time
def test_homing_gives_drives_that_lost_their_position_a_reference(
    slow_run: PreparedRun, rig: Path, short_plan: Path, tmp_path: Path, channel: Channel
) -> None:
    kept = ReferenceFile(channel.settings).path
    with drives_on(channel.name, slow_run) as rehearsal:
        loss = PowerLoss.drawn(slow_run.rig, 4, 0.0001, on_a_stand=True)
        loss.apply_to(slow_run.rig, rehearsal.plant, [d.motor for d in rehearsal.drives])
        run = ("run", short_plan, "--rig", rig, "--no-camera", *channel.options)
        first = call(*run, "-o", tmp_path / "first")
        assert first.code == 3
        assert "never homed" in first.err
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text("{")
        more = ("--limit-n", "60", *channel.options, "--json")
        homed = call("home", rig, "--pose-mm", *_start(slow_run), *more)
        assert homed.code == 0, homed
    result = json.loads(homed.out)
    events = (tmp_path / "runs/home/events.jsonl").read_text().splitlines()
    assert json.loads(events[-1])["code"] == "held"
    with (tmp_path / "runs/home/winches.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    moved = [int(rows[-1][f"counts_{k}"]) - int(rows[0][f"counts_{k}"]) for k in range(1, 9)]
    assert any(moved)
    assert all(int(rows[-1][f"torque_per_mille_{k}"]) > 0 for k in range(1, 9))
    assert Path(result["file"]) == kept
    assert result["home_counts"] != [0] * 8
    assert json.loads(kept.read_text())["lost"] == ""


@pytest.mark.slow
@pytest.mark.real_time
def test_a_run_needs_a_reference_that_was_made_since_the_drives_were_switched_on(
    slow_run: PreparedRun, rig: Path, short_plan: Path, tmp_path: Path, channel: Channel
) -> None:
    run = ("run", short_plan, "--rig", rig, "--no-camera", *channel.options)
    with drives_on(channel.name, slow_run) as rehearsal:
        # The cables are taut already.
        homed = call("home", rig, "--pose-mm", *_start(slow_run), *channel.options)
        assert homed.code == 0, homed
        file = ReferenceFile(channel.settings)
        second = call(*run, "-o", tmp_path / "second")
        assert second.code == 0, second
        assert str(file.path) in second.out.replace("\n", "").replace("  ", "")
        assert rehearsal.pose.distance_to(slow_run.scene.goal) < 0.1e-3
        stood = [drive.motor.position for drive in rehearsal.drives]
        # A killed program recorded nothing; a reset does, if all drives held.
        kept = json.loads(file.path.read_text())
        elsewhere = {**kept, "stands_at": [count + 10**6 for count in kept["stands_at"]]}
        file.path.write_text(json.dumps(elsewhere))
        killed = call(*run, "-o", tmp_path / "killed")
        assert (killed.code, "from its last known position" in killed.err) == (3, True)
        reset = call("reset", rig, *channel.options[:5], "--json")
        assert reset.code == 0
        after = json.loads(reset.out)
        assert (after["restarted"], after["reference"]["counts"]) == ([], True)
        assert after["reference"]["made"] == kept["made"]
        assert json.loads(file.path.read_text()) == kept
        rehearsal.drives[5].power_on()
        third = call(*run, "-o", tmp_path / "third")
        assert third.code == 3
        assert "cable 6 (drive 6) is lost: it was power-cycled" in third.err
        again = call(*run, "-o", tmp_path / "again")
        assert again.code == 3
        assert "homing reference is lost" in again.err
        reset = call("reset", rig, *channel.options[:5])
        assert reset.code == 0
        assert "reference: not valid" in reset.out
        assert "cable 6 (drive 6): power-cycled" in reset.out.replace("\n", " ")
        jogged = call("jog", rig, "--by-mm", "0", "0", "1", "--no-scene", *channel.options)
        assert jogged.code == 3
        assert "cable 6 (drive 6): power-cycled" in jogged.err.replace("\n", " ").replace("  ", "")
        assert [drive.motor.position for drive in rehearsal.drives] == stood


@pytest.mark.slow
@pytest.mark.real_time
def test_a_run_whose_end_cannot_be_kept_leaves_its_whole_record(
    slow_run: PreparedRun,
    slow_rig: Path,
    short_plan: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*_args: object, **_more: object) -> None:
        raise Refused("the latch cannot be written", where="latched.json", why="disk full")

    monkeypatch.setattr(MotionInterlock, "end", full)
    channel = f"239.74.163.27:{20000 + (os.getpid() * 19) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel, "--yes", "--without-real-time")
    folder = tmp_path / "run"
    with drives_on(channel, slow_run):
        answer = call("run", short_plan, "--rig", slow_rig, "--no-camera", *bus, "-o", folder)
    assert answer.code == 1, answer
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["passed"] is False
    assert "disk full" in json.dumps(summary)
    assert (folder / "report.html").is_file()


def test_the_executor_itself_refuses_a_latched_bus(prepared: PreparedRun, tmp_path: Path) -> None:
    """For any caller: nothing is started, no drive is read."""
    settings = BusSettings("socketcan", "can7")
    document = prepared.rig.document.bus.model_copy(
        update={"interface": settings.interface, "channel": settings.channel}
    )
    rig = rig_from_document(prepared.rig.document.model_copy(update={"bus": document}))
    on_bus = prepare(prepared.plan, rig)
    FaultLatch(settings).engage("rig", tmp_path, "cable 4 is slack")
    nothing: Any = None
    with pytest.raises(Refused, match="cable 4 is slack"):
        run_along_path(
            on_bus,
            nothing,
            nothing,
            before_motion=lambda _denied: pytest.fail("it was about to move"),
        )
