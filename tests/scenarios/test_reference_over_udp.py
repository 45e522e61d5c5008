"""Drives without absolute encoders: no run before homing, none after a power cycle."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path
from typing import Any

import pytest

from drivers.can_bus import BusSettings
from executor.control.path_runs import run_in_real_time
from executor.interlock.fault_latch import FaultLatch
from executor.interlock.interlock import MotionInterlock
from executor.trajectory.setpoints import PreparedRun, prepare
from model.errors import Refused
from model.rig import rig_from_document
from simulation.ground_truth import PowerLoss
from tests.cli.program import call
from tests.scenarios.test_real_time import drives_on


@pytest.mark.slow
@pytest.mark.real_time
def test_a_run_needs_a_reference_that_was_made_since_the_drives_were_switched_on(
    slow_run: PreparedRun,
    slow_rig: Path,
    short_plan: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    rig = tmp_path / "rig.yaml"
    rig.write_text(slow_rig.read_text().replace("encoder: absolute, ", ""))
    channel = f"239.74.163.26:{20000 + (os.getpid() * 19) % 20000}"
    bus = ("--interface", "udp_multicast", "--channel", channel, "--yes", "--without-real-time")
    run = ("run", short_plan, "--rig", rig, "--no-camera", *bus)
    with drives_on(channel, slow_run) as rehearsal:
        loss = PowerLoss.drawn(slow_run.rig, 4, 0.0005, on_a_stand=True)
        loss.apply_to(slow_run.rig, rehearsal.plant, [d.motor for d in rehearsal.drives])
        first = call(*run, "-o", tmp_path / "first")
        assert first.code == 3
        assert "never homed" in first.err
        start = [f"{x:.6f}" for x in slow_run.scene.start.position * 1000.0]
        homed = call("home", rig, "--pose-mm", *start, *bus, "--json")
        assert homed.code == 0, homed
        result = json.loads(homed.out)
        events = (tmp_path / "runs/home/events.jsonl").read_text().splitlines()
        assert json.loads(events[-1])["code"] == "held"
        with (tmp_path / "runs/home/winches.csv").open() as stream:
            rows = list(csv.DictReader(stream))
        moved = [int(rows[-1][f"counts_{k}"]) - int(rows[0][f"counts_{k}"]) for k in range(1, 9)]
        assert any(moved)
        assert all(int(rows[-1][f"torque_per_mille_{k}"]) > 0 for k in range(1, 9))
        assert Path(result["file"]).is_file()
        assert result["home_counts"] != [0] * 8
        second = call(*run, "-o", tmp_path / "second")
        assert second.code == 0, second
        assert result["file"] in second.out.replace("\n", "").replace("  ", "")
        assert rehearsal.pose.distance_to(slow_run.scene.goal) < 0.1e-3
        stood = [drive.motor.position for drive in rehearsal.drives]
        # A killed program recorded nothing; a reset does, if all drives held.
        kept = json.loads(Path(result["file"]).read_text())
        elsewhere = {**kept, "stands_at": [count + 10**6 for count in kept["stands_at"]]}
        Path(result["file"]).write_text(json.dumps(elsewhere))
        killed = call(*run, "-o", tmp_path / "killed")
        assert (killed.code, "from its last known position" in killed.err) == (3, True)
        reset = call("reset", rig, *bus[:5], "--json")
        assert reset.code == 0
        after = json.loads(reset.out)
        assert (after["restarted"], after["reference"]["counts"]) == ([], True)
        assert after["reference"]["made"] == kept["made"]
        assert json.loads(Path(result["file"]).read_text()) == kept
        rehearsal.drives[5].power_on()
        third = call(*run, "-o", tmp_path / "third")
        assert third.code == 3
        assert "cable 6 (drive 6) is lost: it was power-cycled" in third.err
        again = call(*run, "-o", tmp_path / "again")
        assert again.code == 3
        assert "homing reference is lost" in again.err
        reset = call("reset", rig, *bus[:5])
        assert reset.code == 0
        assert "reference: not valid" in reset.out
        assert "cable 6 (drive 6): power-cycled" in reset.out.replace("\n", " ")
        jogged = call("jog", rig, "--by-mm", "0", "0", "1", "--no-scene", *bus)
        assert jogged.code == 3
        assert "cable 6 (drive 6): power-cycled" in jogged.err.replace("\n", " ").replace("  ", "")
        assert [drive.motor.position for drive in rehearsal.drives] == stood
        Path(result["file"]).write_text("{")
        rehomed = call("home", rig, "--pose-mm", *start, *bus, "--json")
        assert rehomed.code == 0, rehomed
        assert json.loads(Path(result["file"]).read_text())["lost"] == ""


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
        run_in_real_time(
            on_bus,
            nothing,
            nothing,
            nothing,
            pose_every=0,
            need_real_time=False,
            check_drives=nothing,
            before_motion=lambda _denied: pytest.fail("it was about to move"),
        )
