"""`cdpr calibrate extrinsics`: where a camera stands."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cdpr.cli.calibration_output import FolderOption, ForceOption, JsonOption, WantedOption
from cdpr.cli.calibrations import CalibrationOption
from cdpr.cli.finite import finite

if TYPE_CHECKING:
    from calibration.extrinsics import ExtrinsicCalibration
    from calibration.survey import Survey
    from cdpr.cli.picture_sources import Pictures
    from cdpr.poses import Pose
    from cdpr.rig import Camera, Rig

SourceArgument = Annotated[
    str,
    typer.Argument(help="folder of pictures, video file or camera index", metavar="SOURCE"),
]
PicturesOption = Annotated[
    int | None,
    typer.Option(min=1, help="how many to take of a video or of a camera (default: 20; tags: 40)"),
]
CameraOption = Annotated[
    str | None, typer.Option(help="name of the camera in the rig file (default: the first)")
]


def extrinsics(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
    source: SourceArgument,
    camera: CameraOption = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="go by the rig's motion: poses by picture (CSV), or the folder of a run",
            metavar="FILE",
        ),
    ] = None,
    survey_mm: Annotated[
        float,
        typer.Option(
            min=0.0, callback=finite, help="how well corners of frame tags were surveyed, deviation"
        ),
    ] = 0.5,
    survey_deg: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            callback=finite,
            help="how well turns of frame tags are known, deviation; --survey-mm is then of whole"
            " tags (default: each corner was surveyed by itself)",
        ),
    ] = None,
    pictures: PicturesOption = None,
    calibration: CalibrationOption = None,
    wanted_mm: WantedOption = 1.0,
    output: FolderOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find where a camera stands, by surveyed tags on the frame or by the rig's own motion.

    Pictures must be taken while the camera stands still. Exit code 3 where the result is not good
    enough.

    [dim]Examples:[/dim]

      cdpr calibrate extrinsics rig.yaml pictures/ -o calibration

      cdpr calibrate extrinsics rig.yaml 0 --calibration calibration_camera_front_2026-03-01.yaml

      cdpr calibrate extrinsics rig.yaml runs/first/pictures --poses runs/first
    """
    from math import radians

    from calibration.extrinsics import judge_extrinsics
    from calibration.extrinsics_page import extrinsics_page, moved_rows
    from calibration.extrinsics_result import extrinsics_result
    from calibration.result_file import require_file_name
    from calibration.survey import Survey
    from calibration.surveyed_tags import require_frame_tags
    from cdpr.cli.calibration_output import begin, finish
    from cdpr.cli.calibrations import calibrated_rig
    from cdpr.cli.camera_choice import named_camera
    from cdpr.cli.picture_sources import pictures_of
    from cdpr.rig import load_rig

    the_rig = calibrated_rig(load_rig(rig), calibration)
    the_camera = named_camera(the_rig, camera)
    require_file_name(the_camera.name, "cameras")
    known = None if poses is None else _known_poses(poses, the_camera)
    if known is None:
        require_frame_tags(the_rig)
    images = pictures_of(source, the_camera, pictures, usual=20)
    turn = None if survey_deg is None else radians(survey_deg)
    survey = Survey(survey_mm / 1e3, turn)
    today = begin("extrinsics", the_camera.name, output, force)
    found = _located(the_rig, the_camera, images, known, survey, not as_json)
    verdict = judge_extrinsics(found, wanted_mm / 1e3)
    document = extrinsics_result(found, verdict, the_rig.document, today)
    before = the_camera.world_from_camera
    finish(
        document,
        extrinsics_page(found, document, verdict, before),
        [
            ("by", f"{found.by}, {found.pictures} pictures"),
            *((f"tag {k}", f"{error:.3f} px off") for k, error in found.tag_errors.items()),
            *moved_rows(before, found.world_from_camera),
        ],
        output,
        as_json,
    )


def _located(
    rig: Rig,
    camera: Camera,
    images: Pictures,
    poses: dict[str, Pose] | None,
    survey: Survey,
    shown: bool,
) -> ExtrinsicCalibration:
    from calibration.hand_eye import locate_by_motion
    from calibration.surveyed_tags import locate_camera
    from calibration.tag_sights import sights_of
    from cdpr.cli.compiling import ready_to_measure
    from cdpr.cli.output import progress_bar
    from cdpr.cli.picture_sources import told

    tags = rig.frame_tags if poses is None else rig.platform_tags
    ready_to_measure(shown)
    with progress_bar("looking for tags", images.count, shown) as advance:
        sights = sights_of(
            told(images, advance), rig, camera, [tag.id for tag in tags], images.unused
        )
    if poses is None:
        return locate_camera(rig, camera, sights, survey)
    return locate_by_motion(rig, camera, sights, poses)


def _known_poses(path: Path, camera: Camera) -> dict[str, Pose]:
    """The platform's poses by picture, from a file or from the encoders of a run."""
    from calibration.pose_file import read_poses

    return _poses_of_run(path, camera.name) if path.is_dir() else read_poses(path)


def _poses_of_run(folder: Path, camera: str) -> dict[str, Pose]:
    """Poses by the drives' positions when a camera's kept pictures of a run were taken."""
    import numpy as np

    from cdpr.errors import BadInput
    from cdpr.poses import Pose, interpolate
    from executor.run_folder import RunFolder

    run = RunFolder.open(folder)
    cycles, alone = run.cycles(), run.poses_by_camera()
    names = [one["name"] for one in run.summary().get("cameras", [])]
    if camera not in names:
        raise BadInput(
            f"camera {camera!r} took no pictures in this run",
            where=str(folder),
            next_step=f"name one of its cameras with --camera: {', '.join(names)}",
        )
    looks = alone[camera] if alone else run.poses()
    times = cycles.time
    poses = {}
    for time, picture in zip(looks.time, looks.picture, strict=True):
        after = int(np.searchsorted(times, time))
        if not picture or not 0 < after < len(times):
            continue
        ends = [
            Pose.from_quaternion(cycles.encoder[row], cycles.encoder_rotation[row])
            for row in (after - 1, after)
        ]
        share = float((time - times[after - 1]) / (times[after] - times[after - 1]))
        if all(np.isfinite(end.matrix()).all() for end in ends):
            poses[Path(picture).name] = interpolate(ends[0], ends[1], share)
    return poses
