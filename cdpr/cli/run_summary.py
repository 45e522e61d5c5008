"""What `cdpr run` and `cdpr demo` show before and after a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape

from cdpr.cli.output import out, show_facts, show_json
from cdpr.cli.stop_facts import stop_facts

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import Console

    from cdpr.rig import Camera, Rig
    from executor.prepare import PreparedRun

COLOURS = {"PASSED": "green", "STOPPED": "yellow", "FAILED": "red"}


def clearance_fact(prepared: PreparedRun, eyes: Mapping[Camera, str], wanted: bool) -> str:
    """What stops the run when it comes too near to an obstacle, or why nothing does.

    Args:
        prepared: The run.
        eyes: From `choose_cameras`.
        wanted: Whether the operator wants it stopped.
    """
    if not wanted:
        return "off (--no-clearance-stop)"
    if not eyes:
        return "off (no camera)"
    if not prepared.scene.obstacles:
        return "off (no obstacles in the scene)"
    return f"below {prepared.scene.obstacle_clearance * 1000:g} mm, as the cameras see it"


def show_prepared(
    prepared: PreparedRun,
    eyes: Mapping[Camera, str],
    clearance_stop: str,
    simulated: bool,
    on: Console,
) -> None:
    """What is going to happen.

    Args:
        prepared: The run.
        eyes: From `choose_cameras`.
        clearance_stop: From `clearance_fact`.
        simulated: On simulated drives.
        on: Where it is shown.
    """
    rig, bus = prepared.rig, prepared.rig.document.bus
    start, goal = prepared.scene.start.position * 1000, prepared.scene.goal.position * 1000
    table = prepared.checked.table
    show_facts(
        "ready to run",
        [
            ("rig, scene", f"{rig.name}, {prepared.scene.name}"),
            ("from", f"{start[0]:.1f}, {start[1]:.1f}, {start[2]:.1f} mm"),
            ("to", f"{goal[0]:.1f}, {goal[1]:.1f}, {goal[2]:.1f} mm"),
            *stop_facts(prepared.scene),
            (
                "motion",
                f"{prepared.length * 1000:.1f} mm in {prepared.duration:.1f} s,"
                f" at most {rig.motion.speed * 1000:g} mm/s",
            ),
            ("set-points", f"{len(table)} cycles of {table.cycle * 1000:g} ms, all checked"),
            *_reference(rig),
            ("cameras", _cameras(rig, eyes)),
            ("clearance stop", clearance_stop),
            ("bus", f"{bus.interface} {bus.channel}{', simulated drives' if simulated else ''}"),
        ],
        on,
    )


def show_summary(summary: dict[str, Any], folder: Path, as_json: bool) -> None:
    """What happened."""
    if as_json:
        show_json({"run": str(folder), **summary})
        return
    from executor.fault_pages import pages_of

    colour = COLOURS[summary["verdict"]]
    sentence = escape(summary["sentence"])
    out.print(f"[bold {colour}]{summary['verdict']}[/] {sentence}", soft_wrap=True)
    for reason in summary["reasons"]:
        out.print(f"  {reason}", markup=False, soft_wrap=True)
    for page in pages_of(event["code"] for event in summary["events"]):
        out.print(f"  more about it: {page}", markup=False, soft_wrap=True)
    out.print(f"report: {folder / 'report.html'}", markup=False, soft_wrap=True)


def _cameras(rig: Rig, eyes: Mapping[Camera, str]) -> str:
    """Which cameras look, and which of the rig file's do not."""
    from cdpr.cli.camera_choice import looked_with

    used = {camera.name for camera in eyes}
    unused = [camera.name for camera in rig.cameras if camera.name not in used]
    parts = [looked_with(eyes)] if eyes else []
    parts += [f"not used: {', '.join(unused)}"] if unused else []
    return "; ".join(parts) or "none"


def _reference(rig: Rig) -> list[tuple[str, str]]:
    """Which reference the drives' counts are read by, where it is not the rig file's own."""
    from executor.custody import Custody

    custody = Custody(rig)
    reference = custody.kept_reference()
    if reference is None:
        return []
    return [("reference", f"{reference.made}, {reference.how}; {custody.file.path}")]
