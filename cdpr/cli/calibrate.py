"""`cdpr calibrate`: cameras, from pictures of a board."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cdpr.cli.board_options import BoardOptions, with_board_options
from cdpr.cli.calibration_output import FolderOption, ForceOption, JsonOption, WantedOption

if TYPE_CHECKING:
    from calibration.camera import CameraCalibration
    from calibration.camera_verdict import CameraQuality


@with_board_options
def camera(
    folder: Annotated[
        Path, typer.Argument(help="folder of pictures of the board, or for --live", metavar="DIR")
    ],
    printed: BoardOptions,
    live: Annotated[
        str | None,
        typer.Option(help="take the pictures with this camera (or of a video) into DIR first"),
    ] = None,
    pictures: Annotated[
        int | None, typer.Option(min=4, help="with --live: how many at least (default: 40)")
    ] = None,
    size_px: Annotated[
        tuple[int, int] | None,
        typer.Option(help="with --live: width and height (default: 1280 720)"),
    ] = None,
    name: Annotated[str, typer.Option(help="of the camera in the rig file")] = "camera",
    wanted_mm: WantedOption = 1.0,
    distance_m: Annotated[
        float | None,
        typer.Option(min=0.01, help="from which the camera measures, else the boards'"),
    ] = None,
    output: FolderOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find a camera's matrix and lens distortion, and say whether they are good enough.

    Exit code 3 where they are not. Files that cannot be used are named; the others are used.

    [dim]Examples:[/dim]

      cdpr calibrate camera pictures/ --columns 9 --rows 6 --square-mm 25 -o calibration

      cdpr calibrate camera pictures/ --board charuco --columns 7 --rows 5 --square-mm 30
      --marker-mm 22 --dictionary 4X4_50

      cdpr calibrate camera pictures/ --live 0 --columns 9 --rows 6 --square-mm 25 -o calibration
    """
    from calibration.camera import calibrate_camera
    from calibration.camera_page import camera_page
    from calibration.camera_result import camera_result
    from calibration.camera_verdict import judge_camera
    from calibration.result_file import require_file_name
    from cdpr.cli.calibrate_live import require_source, take_pictures
    from cdpr.cli.calibration_output import begin, finish
    from cdpr.cli.output import progress_bar
    from cdpr.cli.picture_sources import Pictures, told
    from cdpr.cli.workers import make_folder
    from cdpr.errors import BadInput
    from drivers.picture_folder import OneCamerasPictures

    require_file_name(name, "--name")
    the_board = printed.made()
    if live is None and (pictures is not None or size_px is not None):
        raise BadInput(
            "--pictures and --size-px are for taking pictures",
            where="calibrate camera",
            next_step="pass --live CAMERA too, or leave them out: a folder's pictures are all used",
        )
    today = begin("camera", name, output, force)
    if live is not None:
        require_source(live)
        make_folder(folder, force)
        take_pictures(live, folder, the_board, pictures or 40, size_px or (1280, 720))
    images = OneCamerasPictures(folder)
    source = Pictures(images, len(images.names), images.unused)
    with progress_bar("looking for the board", source.count, not as_json) as advance:
        result = calibrate_camera(told(source, advance), the_board, source.unused)
    quality = judge_camera(result, wanted_mm / 1000.0, distance_m)
    document = camera_result(result, quality, name, today)
    page = camera_page(result, quality, name, document.date)
    finish(document, page, _facts(result, quality), output, as_json)


def _facts(result: CameraCalibration, quality: CameraQuality) -> list[tuple[str, str]]:
    """What was found beside the numbers, for people."""
    from calibration.camera_verdict import FULL_COVERAGE

    return [
        ("corners", f"{result.error:.3f} px off (RMS) in {len(result.views)} pictures"),
        (
            "boards were",
            f"{quality.nearest:.3g} to {quality.farthest:.3g} m away; if not, the sizes are wrong",
        ),
        ("covered", f"{quality.covered:.0%} of the picture, {FULL_COVERAGE:.0%} are good"),
        (
            "precision",
            f"{quality.verdict.error * 1e3:.2g} mm at {quality.distance:.2f} m (95 %); two halves"
            f" of the pictures are {quality.halves * 1e3:.2g} mm apart",
        ),
    ]
