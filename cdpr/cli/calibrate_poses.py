"""`cdpr calibrate poses`: plans where to measure, so that `cdpr calibrate rig` learns most."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cdpr.cli.calibrations import CalibrationOption

if TYPE_CHECKING:
    from cdpr.poses import Pose
    from cdpr.scene import Scene

RESERVE_SHARE = 0.075
"""Of the tension range, kept from its ends: more leaves only the middle of the workspace."""
ROUNDS = 3
"""Of shortening each way: measuring is not about speed."""


def poses(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
    scene: Annotated[Path, typer.Argument(help="scene file (YAML)", metavar="SCENE")],
    output: Annotated[Path, typer.Option("-o", "--output", help="plan file to write (JSON)")],
    count: Annotated[int, typer.Option(min=10, max=500, help="how many poses")] = 60,
    tilt_deg: Annotated[
        float, typer.Option(min=0.0, max=45.0, help="tilt the platform up to so much")
    ] = 15.0,
    turn_deg: Annotated[
        float, typer.Option(min=0.0, max=45.0, help="turn it about the vertical up to so much")
    ] = 15.0,
    dwell_s: Annotated[float, typer.Option(min=0.7, help="how long it stands at each")] = 1.5,
    candidates: Annotated[
        int, typer.Option(min=10, max=5000, help="places that they are chosen from")
    ] = 300,
    reserve_n: Annotated[
        float | None,
        typer.Option(min=0.0, help="kept from the tension limits (default: 7.5 % of their range)"),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="of the candidates and of the ways")] = 0,
    calibration: CalibrationOption = None,
    force: Annotated[bool, typer.Option("--force", help="replace an existing plan file")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """Choose the poses that tell most about the rig, and plan a way through them with stops.

    Each can be held, is free, and is turned as far as cables and tensions allow. `cdpr run` runs
    the plan; `cdpr calibrate rig` reads the run folder.

    [dim]Example:[/dim]

      cdpr calibrate poses configs/gachon_8_6_rehearsal.yaml configs/turn.yaml -o measure.json
    """
    from math import degrees, radians

    from calibration.rig_parameters import DEFAULT_DEVIATIONS, Parameters
    from calibration.rig_poses import Wish, chosen_poses
    from cdpr.cli.calibrations import calibrated_rig
    from cdpr.cli.output import show_facts, show_json, spinner
    from cdpr.cli.plan import check_output, facts_of, planned, sentences_of
    from cdpr.plan import save_plan
    from cdpr.rig import load_rig
    from cdpr.scene import load_scene
    from planner.turning.settings import TurningSettings
    from planner.weights import OBJECTIVES

    check_output(output, force)
    the_rig, the_scene = calibrated_rig(load_rig(rig), calibration), load_scene(scene)
    of_poses = (0.3e-3,) * 3 + (radians(0.05),) * 3
    span = the_rig.max_tension - the_rig.min_tension
    room = RESERVE_SHARE * span if reserve_n is None else reserve_n
    wish = Wish(count, radians(tilt_deg), radians(turn_deg), candidates, room, 0.1e-3, of_poses)
    parameters = Parameters.of(the_rig, DEFAULT_DEVIATIONS)
    with spinner("choosing poses", not as_json):
        chosen = chosen_poses(the_rig, the_scene, wish, parameters, seed)
    settings = TurningSettings(weights=OBJECTIVES["length"], seed=seed, rounds=ROUNDS)
    document = planned(the_rig, _with_stops(the_scene, chosen, dwell_s), settings, not as_json)
    save_plan(document, output)
    angles = [degrees(pose.angle_to(the_rig.home)) for pose in chosen]
    if as_json:
        show_json({"plan": str(output), "turned_deg": angles, **facts_of(document)})
        return
    sentences = [s for s in sentences_of(document) if s[0] not in ("by way of", "search")]
    told = f"{len(chosen)}, turned by up to {max(angles):.1f}°"
    next_step = f"cdpr run {output} --rig {rig} -o RUNDIR, then cdpr calibrate rig {rig} RUNDIR"
    show_facts(f"plan {output}", [("poses", told), *sentences, ("next", next_step)])


def _with_stops(scene: Scene, chosen: list[Pose], dwell: float) -> Scene:
    """The scene with the poses as its stops, ending where it begins, and limits that allow them."""
    from math import ceil, degrees

    from cdpr.document_types import PoseDocument
    from cdpr.rotation_limits import largest_rotations
    from cdpr.scene import scene_from_document
    from cdpr.scene_file import RotationLimitsDocument
    from cdpr.scene_stops import StopDocument

    stops = [
        StopDocument(name=f"pose {number}", dwell_s=dwell, **PoseDocument.of(pose).model_dump())
        for number, pose in enumerate(chosen, start=1)
    ]
    ends = [scene.start, *chosen]
    found = [largest_rotations(pose.quaternion, pose.quaternion) for pose in ends]
    tilt, turn = (ceil(degrees(max(values))) for values in zip(*found, strict=True))
    changes = {
        "stops": stops,
        "goal": scene.document.start,
        "rotation_limits": RotationLimitsDocument(
            tilt_deg=float(min(tilt, 90)), turn_deg=float(min(turn, 180))
        ),
    }
    return scene_from_document(scene.document.model_copy(update=changes))
