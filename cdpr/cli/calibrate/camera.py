"""`cdpr calibrate camera`, `readout`, `extrinsics`, `tags`: a camera, its pose, and the tags."""

from __future__ import annotations

from math import radians
from pathlib import Path
from typing import Any

from calibration.extrinsics.camera_pairs import locate_camera_by_another
from calibration.extrinsics.surveyed_tags import Survey
from calibration.images import capture_images
from calibration.intrinsics.lens import LensChoice
from calibration.procedures import (
    calibrate_camera,
    calibrate_camera_from_corners,
    locate_camera,
    locate_tags,
    measure_readout,
)
from calibration.results import require_file_name
from cdpr.cli.arguments import argument, option
from cdpr.cli.calibrate.boards import BoardOptions
from cdpr.cli.calibrate.results import CAMERA, PICTURES, SOURCE, ResultOptions, wanted_option
from cdpr.cli.operate.supervision import stop_requests
from cdpr.cli.options import CALIBRATION, RIG, calibrated_rig
from cdpr.cli.output import err, show_line
from executor.cameras.sources import parse_named_source
from executor.supervision import LocalRequests
from model.errors import BadInput
from model.rig import load_rig


def camera(
    *,
    folder: Path = argument(
        "folder of images of the board, a video, or corners (CSV); output of --live", "DIR"
    ),
    printed: BoardOptions,
    live: str | None = option("first capture images from this camera or video into DIR"),
    pictures: int | None = option("with --live: minimum number of images (default: 40)", min=4),
    size_px: tuple[int, int] | None = option(
        "image width and height, of --live (default: 1280 720) or of corners"
    ),
    name: str = option("name of the camera in the rig file", default="camera"),
    wanted_mm: float = wanted_option(1.0),
    distance_m: float | None = option(
        "working distance of the camera (default: the target's)", min=0.01
    ),
    lens: LensChoice = option(
        "lens model; auto: the one that fits held-out images best", default="auto"
    ),
    result: ResultOptions,
) -> None:
    """Calibrate a camera's matrix and lens distortion, and state the accuracy.

    Exit code 3 where the result is not good enough. Files that cannot be used are listed.

    Examples:
      cdpr calibrate camera pictures/ --columns 9 --rows 6 --square-mm 25 -o results
      cdpr calibrate camera pictures/ --board charuco --columns 7 --rows 5 --square-mm 30
          --marker-mm 22 --dictionary 4X4_50
      cdpr calibrate camera corners.csv --size-px 1280 720 -o results
      cdpr calibrate camera pictures/ --live 0 --columns 9 --rows 6 --square-mm 25 -o results
    """
    require_file_name(name, "--name")
    calibrated: dict[str, Any] = {
        "name": name,
        "wanted": wanted_mm / 1e3,
        "distance": distance_m,
        "lens": lens,
        "output": result.to,
    }
    if live is None and folder.suffix.lower() == ".csv":
        if size_px is None:
            raise BadInput(
                "a file of corners needs --size-px",
                where=str(folder),
                next_step="pass the width and height of the images that show the corners",
            )
        if printed != BoardOptions() or pictures is not None:
            raise BadInput(
                "a file of corners takes no board and no --pictures",
                where=str(folder),
                why="board_x_mm and board_y_mm in it are positions on the board",
                next_step="leave these options out, and write the positions in mm",
            )
        result.show(calibrate_camera_from_corners(folder, size_px, **calibrated))
        return
    board = printed.made()
    if live is None and (pictures is not None or size_px is not None):
        raise BadInput(
            "--pictures and --size-px are for capturing images",
            where="calibrate camera",
            next_step="pass --live CAMERA as well, or leave them out",
        )
    if live is not None:
        result.to.require_free("camera", name)
        requests = LocalRequests()
        with stop_requests(requests):
            capture_images(
                live,
                folder,
                board,
                wanted=pictures or 40,
                size=size_px or (1280, 720),
                replace=result.force,
                on_advice=lambda text: show_line(text, err),
                stopped=lambda: requests.read().stop,
            )
        if requests.read().stop:
            err.print("capture stopped; the images so far are used")
    result.show(calibrate_camera(folder, board, listener=result.listener, **calibrated))


# `cdpr calibrate readout`: readout time of a rolling shutter, top row to bottom row.


def readout(
    *,
    rig: Path = RIG,
    source: Path = argument("video file, or folder of images", "SOURCE"),
    camera: str | None = CAMERA,
    rate_hz: float | None = option(
        "images per second of a folder, or of a video without times (default: the camera's)",
        min=0.1,
    ),
    speed_mm_s: float | None = option("speed for the error bound (default: the motion's)", min=0.1),
    calibration: list[Path] | None = CALIBRATION,
    wanted_mm: float = wanted_option(0.1),
    result: ResultOptions,
) -> None:
    """Measure a rolling shutter, from images of the platform while it moves.

    Move the platform up, down and sideways in front of the stationary camera. Exit code 3 where the
    result is not good enough.

    Examples:
      cdpr calibrate readout rig.yaml moving.mp4 -o results
      cdpr calibrate readout rig.yaml moving/ --rate-hz 30
    """
    the_rig = calibrated_rig(load_rig(rig), calibration)
    made = measure_readout(
        the_rig,
        source,
        camera=camera,
        rate=rate_hz,
        speed=None if speed_mm_s is None else speed_mm_s / 1e3,
        wanted=wanted_mm / 1e3,
        output=result.to,
        listener=result.listener,
    )
    result.show(made)


# `cdpr calibrate extrinsics`: pose of a camera.


def extrinsics(
    *,
    rig: Path = RIG,
    source: str = SOURCE,
    camera: str | None = CAMERA,
    poses: Path | None = option(
        "use the rig's motion: poses per image (CSV), or a run folder", metavar="FILE"
    ),
    beside: str | None = option(
        "use another camera of known pose, and its images taken at the same times",
        metavar="NAME=SOURCE",
    ),
    survey_mm: float = option(
        "standard deviation of the surveyed corners of frame tags", default=0.5, min=0.0
    ),
    survey_deg: float | None = option(
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
      cdpr calibrate extrinsics rig.yaml pictures/ -o results
      cdpr calibrate extrinsics rig.yaml 0 --calibration calibration_camera_front_2026-03-01.yaml
      cdpr calibrate extrinsics rig.yaml runs/first/pictures --poses runs/first
      cdpr calibrate extrinsics rig.yaml side/ --camera side --beside front=front/
    """
    the_rig = calibrated_rig(load_rig(rig), calibration)
    if beside is not None:
        if poses is not None:
            raise BadInput(
                "--beside and --poses contradict each other",
                where="calibrate extrinsics",
                next_step="pass --poses for the rig's motion, or --beside for another camera",
            )
        another, other = parse_named_source(the_rig, beside, "--beside")
        made = locate_camera_by_another(
            the_rig,
            source,
            other,
            camera=camera,
            reference=another.name,
            board=printed.made() if printed != BoardOptions() else None,
            pictures=pictures,
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
        source,
        camera=camera,
        poses=poses,
        survey=Survey(survey_mm / 1e3, None if survey_deg is None else radians(survey_deg)),
        pictures=pictures,
        wanted=wanted_mm / 1e3,
        output=result.to,
        listener=result.listener,
    )
    result.show(made)


# `cdpr calibrate tags`: poses of the tags on the platform.


def tags(
    *,
    rig: Path = RIG,
    source: str = SOURCE,
    camera: str | None = CAMERA,
    fixed_tag: int | None = option(
        "keep this tag's pose from the rig file (default: best fit of all tags)", min=0
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
      cdpr calibrate tags rig.yaml pictures/ -o results
      cdpr calibrate tags rig.yaml pictures/ --calibration calibration_camera_front_2026-03-01.yaml
    """
    made = locate_tags(
        calibrated_rig(load_rig(rig), calibration),
        source,
        camera=camera,
        fixed_tag=fixed_tag,
        pictures=pictures,
        wanted=wanted_mm / 1e3,
        output=result.to,
        listener=result.listener,
    )
    result.show(made)
