"""`cdpr calibrate poses`: plans where to measure, so that `cdpr calibrate rig` learns most."""

from __future__ import annotations

from math import degrees, radians
from typing import Annotated

import typer

from calibration.geometry.pose_selection import measurement_poses
from cdpr.cli.calibrations import CalibrationOption, calibrated_rig
from cdpr.cli.options import (
    JsonOption,
    PlanFileOption,
    ReplacePlanOption,
    RigArgument,
    SceneArgument,
)
from cdpr.cli.output import Terminal, show_facts, show_json
from cdpr.cli.plan_facts import facts_of, sentences_of
from model.files.output import require_new_file
from model.plan import save_plan
from model.rig import load_rig
from model.scene import load_scene


def poses(
    rig: RigArgument,
    scene: SceneArgument,
    output: PlanFileOption,
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
    force: ReplacePlanOption = False,
    as_json: JsonOption = False,
) -> None:
    """Choose the poses that tell most about the rig, and plan a way through them with stops.

    Each can be held, is free, and is turned as far as cables and tensions allow. `cdpr run` runs
    the plan; `cdpr calibrate rig` reads the run folder.

    [dim]Example:[/dim]

      cdpr calibrate poses configs/gachon_8_6_rehearsal.yaml configs/turn.yaml -o measure.json
    """
    require_new_file(output, force)
    the_rig = calibrated_rig(load_rig(rig), calibration)
    made = measurement_poses(
        the_rig,
        load_scene(scene),
        count=count,
        tilt=radians(tilt_deg),
        turn=radians(turn_deg),
        dwell=dwell_s,
        candidates=candidates,
        reserve=reserve_n,
        seed=seed,
        listener=Terminal(quiet=as_json),
    )
    save_plan(made.document, output)
    angles = [degrees(pose.angle_to(the_rig.home)) for pose in made.poses]
    if as_json:
        show_json({"plan": str(output), "turned_deg": angles, **facts_of(made.document)})
        return
    sentences = [s for s in sentences_of(made.document) if s[0] not in ("by way of", "search")]
    text = f"{len(made.poses)}, turned by up to {max(angles):.1f}°"
    next_step = f"cdpr run {output} --rig {rig} -o RUNDIR, then cdpr calibrate rig {rig} RUNDIR"
    show_facts(f"plan {output}", [("poses", text), *sentences, ("next", next_step)])
