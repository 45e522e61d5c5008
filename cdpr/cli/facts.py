"""What the verbs that reach drives show of a motion, a rig and a run: facts for people."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from cdpr.cli.output import err, out, show_facts, show_json
from drivers.can_bus import IN_PROCESS
from executor.cameras.sources import describe_cameras
from executor.hold_to_run.session import CablesProposal, JogProposal
from executor.homing import ForgetProposal, HomeResult, HomingProposal
from executor.interlock.interlock import MotionInterlock
from executor.interlock.reference import HomingReference
from executor.jogging import CableProposal
from executor.recording.verdict import faults_among
from executor.runner import MotionProposal, RunResult
from executor.service import (
    ReleaseProposal,
    ResetProposal,
    StatusResult,
    reference_status,
)
from model.rig import Camera, Rig
from tracking.track import rates

COLOURS = {"PASSED": "green", "STOPPED": "yellow", "FAILED": "red"}

# Before and after a run.


def clearance_fact(proposal: MotionProposal) -> str:
    """What stops the run when it comes too near to an obstacle, or why nothing does."""
    scene = proposal.prepared.scene
    if not proposal.clearance_stop:
        return "off (--no-clearance-stop)"
    if not proposal.cameras:
        return "off (no camera)"
    if not scene.obstacles:
        return "off (no obstacles in the scene)"
    return f"below {scene.obstacle_clearance * 1000:g} mm, measured by the cameras"


def show_prepared(proposal: MotionProposal, on: Console) -> None:
    """The run that is about to move the platform."""
    prepared = proposal.prepared
    rig, bus = prepared.rig, prepared.rig.document.bus
    simulated = ", simulated drives" if bus.interface == IN_PROCESS else ""
    start, goal = prepared.scene.start.position * 1000, prepared.scene.goal.position * 1000
    table = prepared.checked.table
    show_facts(
        "ready to run",
        [
            ("rig, scene", f"{rig.name}, {prepared.scene.name}"),
            ("from", f"{start[0]:z.1f}, {start[1]:z.1f}, {start[2]:z.1f} mm"),
            ("to", f"{goal[0]:z.1f}, {goal[1]:z.1f}, {goal[2]:z.1f} mm"),
            *prepared.scene.stop_facts(),
            (
                "motion",
                f"{prepared.length * 1000:.1f} mm in {prepared.duration:.1f} s,"
                f" at most {rig.motion.speed * 1000:g} mm/s",
            ),
            ("set-points", f"{len(table)} cycles of {table.cycle * 1000:g} ms, all checked"),
            *_reference(rig),
            ("cameras", _cameras(rig, proposal.cameras)),
            ("clearance stop", clearance_fact(proposal)),
            ("bus", f"{bus.interface} {bus.channel}{simulated}"),
        ],
        on,
    )


def _cameras(rig: Rig, used: Mapping[Camera, str]) -> str:
    """Which cameras look, and which of the rig file's do not."""
    names = {camera.name for camera in used}
    unused = [camera.name for camera in rig.cameras if camera.name not in names]
    parts = [describe_cameras(used)] if used else []
    parts += [f"not used: {', '.join(unused)}"] if unused else []
    return "; ".join(parts) or "none"


def _reference(rig: Rig) -> list[tuple[str, str]]:
    """Which reference the drives' counts are read by, where it is not the rig file's own."""
    interlock = MotionInterlock(rig)
    reference = interlock.kept_reference()
    if reference is None:
        return []
    return [("reference", f"{reference.made}, {reference.how}; {interlock.file.path}")]


def show_summary(summary: dict[str, Any], folder: Path, as_json: bool) -> None:
    """How a run ended."""
    if as_json:
        show_json({"run": str(folder), **summary})
        return
    colour = COLOURS[summary["verdict"]]
    sentence = escape(summary["sentence"])
    out.print(f"[bold {colour}]{summary['verdict']}[/] {sentence}", soft_wrap=True)
    for reason in summary["reasons"]:
        out.print(f"  {reason}", markup=False, soft_wrap=True)
    if summary["verdict"] == "FAILED":
        for code in faults_among(event["code"] for event in summary["events"]):
            out.print(f"  details: cdpr explain {code}", markup=False, soft_wrap=True)
        out.print(f"  next: {_step_after(summary)}", markup=False, soft_wrap=True)


def _step_after(summary: dict[str, Any]) -> str:
    """What to do after a run that failed."""
    if summary["final_state"] in ("finished", "stopped"):
        return "check the report for exceeded limits before the next run"
    if summary.get("interface") == IN_PROCESS:
        return "find the cause, then run again into a new folder"
    return "find the cause and check the platform, then run `cdpr reset RIG`"


def show_missing(result: RunResult) -> None:
    """Files of a run that could not be written; nothing where all were."""
    missing, folder = result.missing, result.folder
    if not missing:
        return
    lines = [f"error: {folder}: some files of the run could not be written"]
    for why in dict.fromkeys(missing.values()):
        names = [name for name, reason in missing.items() if reason == why]
        lines.append(f"  why: {', '.join(names)}: {why}")
    removed = "the folder was removed during the run, and its record with it"
    again = f"free some disk space if it is full, then `cdpr report {folder}`"
    then = f"{again} to write the missing files" if folder.is_dir() else removed
    lines.append(f"  next: the verdict and the exit code are valid; {then}")
    for line in lines:
        err.print(line, markup=False, soft_wrap=True)


# Before and after homing and jogging.


def show_homing(proposal: HomingProposal, on: Console) -> None:
    """The homing that is about to wind cables in."""
    rig, eye = proposal.rig, proposal.camera
    fastest, reach = proposal.fastest * 1000.0, proposal.reach * 1000.0
    bus = rig.document.bus
    measured = f"measured, camera {eye[0].name} ({eye[1]})" if eye else "stated, held by a jig"
    show_facts(
        "ready to pretension",
        [
            ("rig", rig.name),
            ("pretension", f"{proposal.target:g} N per cable, at most {proposal.limit:g} N"),
            ("winches", f"all together, at most {fastest:.2f} mm/s and {reach:g} mm each"),
            ("pose", measured),
            ("bus", f"{bus.interface} {bus.channel}".strip()),
        ],
        on,
    )


def show_home(result: HomeResult) -> None:
    """The reference that a homing made."""
    reference = result.reference
    x, y, z = reference.pose.position_mm
    tensions = reference.tensions_n
    kept = result.file or "not saved: simulated drives end with this process"
    show_facts(
        "drives homed; they hold",
        [
            ("platform", f"{x:z.2f}, {y:z.2f}, {z:z.2f} mm, {reference.how}"),
            ("uncertainty", _uncertainty(reference)),
            ("tensions", f"{min(tensions):.1f} to {max(tensions):.1f} N"),
            ("reference", str(kept)),
        ],
    )
    out.print(
        "next: `cdpr jog RIG --to-home` or `--by-mm X Y Z`, then `cdpr plan` and `cdpr run`",
        soft_wrap=True,
    )


def _uncertainty(reference: HomingReference) -> str:
    """How well the pose is known; it is not measured how well a jig holds it."""
    if reference.uncertainty_mm == 0.0:
        return "that of the jig (not measured)"
    return f"{reference.uncertainty_mm:.3f} mm (one standard deviation)"


def show_forgotten(proposal: ForgetProposal, on: Console) -> None:
    """The reference that is about to be given up."""
    text = reference_status(proposal.interlock)
    line = f"the present homing reference, which is discarded: {text}"
    on.print(line, soft_wrap=True, markup=False)


def show_cable(proposal: CableProposal, on: Console) -> None:
    """The cable that is about to move."""
    rig, mm = proposal.rig, proposal.length * 1000.0
    winch, speed = rig.winches[proposal.cable - 1], proposal.speed * 1000.0
    limit = f"at most {proposal.limit:g} N in any cable; no taut cable may go slack"
    show_facts(
        "ready to move one cable",
        [
            ("rig", rig.name),
            ("cable", rig.drive_names[winch.node_id]),
            ("motion", f"{abs(mm):g} mm {'out' if mm > 0 else 'in'}, at most {speed:g} mm/s"),
            ("tension", limit),
        ],
        on,
    )


def show_jogging(proposal: JogProposal, on: Console) -> None:
    """The drives that are about to be enabled for jogging."""
    rig, scene = proposal.rig, proposal.scene
    x, y, z = proposal.start.position * 1000.0
    obstacles = ", ".join(one.name for one in scene.obstacles) or "none"
    show_facts(
        "ready to enable the drives for jogging",
        [
            ("rig", rig.name),
            ("platform", f"at {x:.1f}, {y:.1f}, {z:.1f} mm"),
            ("obstacles", obstacles),
            ("motion", f"at most {rig.motion.speed * 1000:g} mm/s, as long as a control is held"),
        ],
        on,
    )


def show_cables(proposal: CablesProposal, on: Console) -> None:
    """The drives that are about to be enabled for jogs of single cables."""
    rig = proposal.rig
    speed = f"at most {rig.motion.speed * 1000:g} mm/s, as long as a control is held"
    show_facts(
        "ready to enable the drives for jogs of single cables",
        [
            ("rig", rig.name),
            ("cables", f"{rig.cable_count}, one at a time"),
            ("motion", speed),
            ("tension", f"at most {proposal.limit:g} N in any cable; no taut cable may go slack"),
            ("not checked", "obstacles, workspace and the platform's pose"),
            ("reference", "stays as it is; a run begins only where drive positions fit a pose"),
        ],
        on,
    )


# Reference and status of a rig, its reset and its release.


def show_reset(proposal: ResetProposal, on: Console) -> None:
    """The fault that is about to be taken off."""
    latched = proposal.latched
    cause = f"latched since {latched.since}: {latched.cause}" if latched else "no fault latched"
    on.print(f"bus {proposal.bus}: {cause}", soft_wrap=True, markup=False)


def show_release(proposal: ReleaseProposal, on: Console) -> None:
    """The drives that are about to lose their torque."""
    braked, kept = proposal.braked, str(proposal.reference)
    show_facts(
        "ready to release the drives",
        [
            ("rig", proposal.rig.name),
            ("bus", proposal.bus),
            ("afterwards", "the brakes hold the drums" if braked else "nothing holds the cables"),
            ("reference", kept if braked else "discarded: run `cdpr home` before the next motion"),
        ],
        on,
    )


def show_status(rig: Rig, status: StatusResult, next_step: str) -> None:
    """The state of a rig, for people."""
    latched = status.latched or "none"
    if status.run is not None:
        latched = f"none; process {status.run} is moving or resetting the rig, see `cdpr monitor`"
    facts = [
        ("rig", rig.name),
        ("bus", status.bus),
        ("latched fault", latched),
        ("reference", str(status.reference)),
    ]
    if status.being_set_up:
        facts.append(("drives", "not read: another program is preparing a motion or reading them"))
    if status.pose is not None:
        x, y, z = status.pose.position * 1000.0
        place = f"{x:z.2f}, {y:z.2f}, {z:z.2f} mm from the encoders, without a load"
        facts.append(("platform", place))
    elif status.why_no_pose is not None:
        facts.append(("platform", status.why_no_pose))
    if next_step:
        facts.append(("next", next_step))
    show_facts("state of the rig", facts)
    for drive in status.drives or ():
        new = "" if drive.set_up else "  not configured since power-up"
        out.print(
            f"  {rig.drive_names[drive.node]:<19} {drive.state:<24}"
            f" {drive.position:>11} counts {drive.tension:8.2f} N{new}",
            soft_wrap=True,
            markup=False,
        )


def camera_line(camera: Mapping[str, Any]) -> str:
    """One camera while images are measured.

    Args:
        camera: As `executor.remote.status` has it.
    """
    parts = [
        f"{camera['name']} ({camera['source']})",
        rates(camera["pictures_per_second"], camera["measuring_ms"], len(camera["tags"])),
        f"{camera['poses']} of {camera['pictures']} with a pose",
    ]
    if camera["dropped"]:
        parts.append(f"{camera['dropped']} dropped")
    if camera["trouble"]:
        parts.append(camera["trouble"])
    return ", ".join(parts)
