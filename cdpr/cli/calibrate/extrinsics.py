"""`cdpr calibrate extrinsics` and `tags`: poses of a camera and of the platform's tags."""

from __future__ import annotations

from collections.abc import Callable
from math import radians
from pathlib import Path

from calibration.extrinsics.camera_pairs import locate_camera_by_another
from calibration.extrinsics.surveyed_tags import Survey
from calibration.pictures import DEFAULT_IMAGES, DEFAULT_TAG_IMAGES, ImageSet, open_source
from calibration.procedures import locate_camera, locate_tags
from cdpr.cli.arguments import option
from cdpr.cli.calibrate.boards import BoardOptions
from cdpr.cli.calibrate.results import CAMERA, PICTURES, SOURCE, ResultOptions, wanted_option
from cdpr.cli.options import CALIBRATION, RIG, calibrated_rig
from model.errors import BadInput
from model.rig import Camera, load_rig


def extrinsics(
    *,
    rig: Path = RIG,
    source: str = SOURCE,
    camera: str | None = CAMERA,
    poses: Path | None = option(
        None, "use the rig's motion: poses per image (CSV), or a run folder", metavar="FILE"
    ),
    beside: str | None = option(
        None,
        "use another camera of known pose, and its images taken at the same times",
        metavar="NAME=SOURCE",
    ),
    survey_mm: float = option(
        0.5, "standard deviation of the surveyed corners of frame tags", min=0.0
    ),
    survey_deg: float | None = option(
        None,
        "standard deviation of frame tags' rotations; --survey-mm then applies to whole tags"
        " (default: each corner was surveyed separately)",
        min=0.0,
    ),
    printed: BoardOptions,
    pictures: int | None = PICTURES,
    calibration: list[Path] | None = CALIBRATION,
    wanted_mm: float = wanted_option(1.0),
    result: ResultOptions,
) -> None:
    """Find a camera's pose: from surveyed tags, the rig's motion, or another camera.

    The camera must not move between images. Exit code 3 where the result is not good enough.

    Examples:
      cdpr calibrate extrinsics rig.yaml pictures/ -o calibration
      cdpr calibrate extrinsics rig.yaml 0 --calibration calibration_camera_front_2026-03-01.yaml
      cdpr calibrate extrinsics rig.yaml runs/first/pictures --poses runs/first
      cdpr calibrate extrinsics rig.yaml side/ --camera side --beside front=front/
    """
    the_rig = calibrated_rig(load_rig(rig), calibration)
    the_camera = the_rig.camera(camera)
    if beside is not None:
        if poses is not None:
            raise BadInput(
                "--beside and --poses exclude each other",
                where="calibrate extrinsics",
                next_step="pass --poses for the rig's motion, or --beside for another camera",
            )
        name, _, other = beside.partition("=")
        made = locate_camera_by_another(
            the_rig,
            the_camera,
            the_rig.camera(name),
            (_opener(source, the_camera, pictures), _opener(other, the_rig.camera(name), pictures)),
            board=printed.made() if printed != BoardOptions() else None,
            wanted=wanted_mm / 1e3,
            output=result.to,
            listener=result.listener,
        )
        result.show(made)
        return
    if printed != BoardOptions():
        raise BadInput(
            "a board is only for --beside, where both cameras see it",
            where="calibrate extrinsics",
            next_step="leave the board's options out, or pass --beside NAME=SOURCE",
        )
    made = locate_camera(
        the_rig,
        _opener(source, the_camera, pictures),
        camera=the_camera.name,
        poses=poses,
        survey=Survey(survey_mm / 1e3, None if survey_deg is None else radians(survey_deg)),
        wanted=wanted_mm / 1e3,
        output=result.to,
        listener=result.listener,
    )
    result.show(made)


def _opener(
    source: str, camera: Camera, pictures: int | None, usual: int = DEFAULT_IMAGES
) -> Callable[[], ImageSet]:
    return lambda: open_source(source, camera, pictures, usual)


# `cdpr calibrate tags`: poses of the tags on the platform.


def tags(
    *,
    rig: Path = RIG,
    source: str = SOURCE,
    camera: str | None = CAMERA,
    fixed_tag: int | None = option(
        None, "keep this tag's pose from the rig file (default: best fit of all tags)", min=0
    ),
    pictures: int | None = PICTURES,
    calibration: list[Path] | None = CALIBRATION,
    wanted_mm: float = wanted_option(0.2),
    result: ResultOptions,
) -> None:
    """Find the tags' poses on the platform, from images that each show two or more.

    Rotate the platform in front of the camera, or carry the camera around it. Exit code 3 where the
    result is not good enough.

    Examples:
      cdpr calibrate tags rig.yaml pictures/ -o calibration
      cdpr calibrate tags rig.yaml pictures/ --calibration calibration_camera_front_2026-03-01.yaml
    """
    the_rig = calibrated_rig(load_rig(rig), calibration)
    the_camera = the_rig.camera(camera)
    made = locate_tags(
        the_rig,
        _opener(source, the_camera, pictures, DEFAULT_TAG_IMAGES),
        camera=the_camera.name,
        fixed_tag=fixed_tag,
        wanted=wanted_mm / 1e3,
        output=result.to,
        listener=result.listener,
    )
    result.show(made)
