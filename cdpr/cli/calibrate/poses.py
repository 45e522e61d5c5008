"""`cdpr calibrate poses`: plans where to measure, so that `cdpr calibrate rig` learns most."""

from __future__ import annotations

from math import degrees, radians
from typing import Annotated

import typer

from calibration.geometry.pose_selection import measurement_poses
from cdpr.cli.options import (
    CalibrationOption,
    JsonOption,
    PlanFileOption,
    ReplacePlanOption,
    RigArgument,
    SceneArgument,
    calibrated_rig,
)
from cdpr.cli.output import Terminal, show_facts, show_json
from cdpr.cli.plan.facts import facts_of, sentences_of
from model.files.output import require_new_file
from model.plan import save_plan
from model.rig import load_rig
from model.scene import load_scene


def poses(
    rig: RigArgument,
    scene: SceneArgument,
    output: PlanFileOption,
    count: Annotated[int, typer.Option(min=10, max=500, help="number of poses")] = 60,
    tilt_deg: Annotated[
        float, typer.Option(min=0.0, max=45.0, help="largest tilt of the platform")
    ] = 15.0,
    turn_deg: Annotated[
        float, typer.Option(min=0.0, max=45.0, help="largest rotation about the vertical")
    ] = 15.0,
    dwell_s: Annotated[float, typer.Option(min=0.7, help="time at rest at each pose")] = 1.5,
    candidates: Annotated[
        int, typer.Option(min=10, max=5000, help="number of candidate poses")
    ] = 300,
    reserve_n: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="distance kept from the tension limits (default: 7.5 % of their range)"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="random seed of the candidates and paths")] = 0,
    calibration: CalibrationOption = None,
    force: ReplacePlanOption = False,
    as_json: JsonOption = False,
) -> None:
    """Choose the most informative poses for calibration, and plan a path with stops at them.

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
    sentences = [s for s in sentences_of(made.document) if s[0] not in ("via", "search")]
    text = f"{len(made.poses)}, rotated by up to {max(angles):.1f}°"
    next_step = f"cdpr run {output} --rig {rig} -o RUNDIR, then cdpr calibrate rig {rig} RUNDIR"
    show_facts(f"plan {output}", [("poses", text), *sentences, ("next", next_step)])
