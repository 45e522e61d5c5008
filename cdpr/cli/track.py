"""`cdpr track`: measures the platform in pictures."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cdpr.cli.calibrations import CalibrationOption

if TYPE_CHECKING:
    from cdpr.poses import Pose
    from cdpr.rig import Camera, Rig
    from cdpr.scene import Scene
    from tracking.pose_log import LoggedPicture
    from tracking.track import Picture

#: A live camera that shows no tag for so many pictures is given up.
PATIENCE = 50


def track(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
    source: Annotated[
        str,
        typer.Argument(
            help="folder of pictures, video file, camera index, or 'synthetic' with --plan",
            metavar="SOURCE",
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="pose log to write (CSV)", metavar="CSV")
    ],
    camera: Annotated[
        str | None, typer.Option(help="name of the camera in the rig file (default: the first)")
    ] = None,
    calibration: CalibrationOption = None,
    scene: Annotated[
        Path | None, typer.Option(help="also measure the clearance to this scene's obstacles")
    ] = None,
    plan: Annotated[
        Path | None, typer.Option(help="with 'synthetic': the path the platform follows")
    ] = None,
    pictures: Annotated[
        int | None, typer.Option(min=1, help="stop after so many; Ctrl-C also stops")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="replace an existing pose log")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """Measure the platform's pose from its tags, picture by picture.

    [dim]Examples:[/dim]

      cdpr track rig.yaml pictures/ -o poses.csv

      cdpr track rig.yaml 0 -o poses.csv --scene scene.yaml --pictures 100

      cdpr track configs/gachon_8_6.yaml synthetic --plan plan.json -o poses.csv
    """
    from itertools import islice

    from cdpr.cli.calibrations import calibrated_rig
    from cdpr.cli.cameras import named_camera
    from cdpr.cli.output import progress_bar, show_facts, show_json
    from cdpr.cli.plan import check_output
    from cdpr.rig import load_rig
    from executor.running import stop_requests
    from executor.wishes import OwnBoard
    from tracking.pose_log import write_pose_log
    from tracking.track import track as tracked
    from tracking.tracker import Tracker

    check_output(output, force)
    the_rig = calibrated_rig(load_rig(rig), calibration)
    the_camera = named_camera(the_rig, camera)
    the_scene = _scene(scene, plan)
    frames, total = _source(the_rig, the_scene, the_camera, source, plan)
    logged: list[LoggedPicture] = []
    board = OwnBoard()
    with (
        stop_requests(board),
        progress_bar("tracking", pictures or total, not as_json) as show,
    ):
        patience = PATIENCE if total is None else None
        for found in tracked(
            islice(frames, pictures), Tracker(the_rig, the_camera), give_up_after=patience
        ):
            logged.append(found)
            show(len(logged))
            if board.read().stop:
                break
    write_pose_log(output, logged)
    facts = _facts(the_rig, the_scene, logged, output)
    if as_json:
        show_json(facts)
    else:
        show_facts(f"poses in {output}", [(k.replace("_", " "), str(v)) for k, v in facts.items()])


def _scene(scene: Path | None, plan: Path | None) -> Scene | None:
    from cdpr.plan import load_plan
    from cdpr.scene import load_scene

    if scene is not None:
        return load_scene(scene)
    return load_plan(plan).scene if plan is not None else None


def _source(
    rig: Rig, scene: Scene | None, camera: Camera, source: str, plan: Path | None
) -> tuple[Iterable[Picture], int | None]:
    """The pictures, and how many there are where that is known."""
    from cdpr.cli.cameras import SYNTHETIC
    from cdpr.cli.output import err
    from cdpr.cli.picture_sources import require_camera_source
    from cdpr.errors import BadInput
    from drivers.cameras import LiveCamera, VideoFile
    from drivers.picture_folder import ImageFolder

    if source == SYNTHETIC:
        if plan is None or scene is None:
            raise BadInput(
                "the synthetic camera needs a path to look at",
                where="track",
                next_step="pass --plan plan.json",
            )
        rendered = _rendered_times(rig, camera, plan)
        return _rendered(rig, scene, camera, rendered), len(rendered)
    if plan is not None:
        raise BadInput(
            "--plan is for the synthetic camera",
            where="track",
            next_step="name the obstacles with --scene, or the source 'synthetic'",
        )
    path = Path(source)
    if path.is_dir():
        folder = ImageFolder(
            path, camera, on_unreadable=lambda name: err.print(f"skipped, no picture: {name}")
        )
        return folder, len(folder)
    if path.is_file():
        video = VideoFile(path, camera)
        return video, len(video)
    require_camera_source(source)
    return LiveCamera(source, camera), None


def _rendered_times(rig: Rig, camera: Camera, plan: Path) -> list[tuple[float, Pose]]:
    """Times and poses at which the synthetic camera looks: those of a run of the plan."""
    from cdpr.cli.carry_out import prepared_run
    from cdpr.cli.plan_for_rig import require_same_rig
    from cdpr.plan import load_plan

    the_plan = load_plan(plan)
    require_same_rig(the_plan, rig, plan)
    table = prepared_run(the_plan, rig, quiet=True).checked.table
    poses = table.poses()
    every = max(1, round(1.0 / (camera.rate * table.cycle)))
    return [(row * table.cycle, poses[row]) for row in range(0, len(table), every)]


def _rendered(
    rig: Rig, scene: Scene, camera: Camera, looks: list[tuple[float, Pose]]
) -> Iterable[Picture]:
    from drivers.cameras import Frame
    from simulation.simulate import make_synthetic_camera

    synthetic = make_synthetic_camera(rig, scene, camera)
    for number, (time, pose) in enumerate(looks):
        yield Frame(time, synthetic.render(pose, number), f"rendered {number}")


def _facts(
    rig: Rig, scene: Scene | None, logged: list[LoggedPicture], output: Path
) -> dict[str, Any]:
    """What was measured, in numbers."""
    import numpy as np

    from cdpr.clearance import ClearanceModel
    from tracking.measured_clearance import clearance_of
    from tracking.measurement import PoseMeasurement

    poses = [p.observation for p in logged if isinstance(p.observation, PoseMeasurement)]
    deviations = np.array([np.linalg.norm(p.position_deviation) for p in poses])
    facts: dict[str, Any] = {
        "poses_file": str(output),
        "pictures": len(logged),
        "poses": len(poses),
        "position_deviation_mm": round(float(np.median(deviations)) * 1000, 4),
        "reprojection_px": round(float(np.median([p.reprojection for p in poses])), 4),
    }
    if scene is not None and scene.obstacles:
        model = ClearanceModel(rig, scene)
        found = [c for p in poses if (c := clearance_of(model, p)) is not None]
        nearest = min(found, key=lambda c: c.distance)
        facts["smallest_clearance_mm"] = round(nearest.distance * 1000, 3)
        facts["clearance_uncertainty_mm"] = round(nearest.uncertainty * 1000, 3)
    return facts
