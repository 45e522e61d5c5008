"""`cdpr calibrate camera`: from images of a board."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from calibration.intrinsics.lens import AUTO
from calibration.intrinsics.quality import FULL_COVERAGE
from calibration.pictures import take_pictures
from calibration.procedures import (
    CameraOutcome,
    Destination,
    calibrate_camera,
    calibrate_camera_from_corners,
)
from calibration.results import require_file_name
from calibration.targets.board import Board
from cdpr.cli.calibrate.board_options import BoardOptions
from cdpr.cli.calibrate.output import FolderOption, ForceOption, WantedOption, show_calibration
from cdpr.cli.operate.supervision import stop_requests
from cdpr.cli.options import JsonOption, with_option_groups
from cdpr.cli.output import Terminal, err
from executor.cameras.sources import require_camera_source
from executor.operator_requests import LocalRequests
from model.errors import BadInput
from model.files.output import make_folder


class LensChoice(StrEnum):
    """Models of lenses, and the choice among them."""

    auto = AUTO
    five = "five"
    rational = "rational"
    thin_prism = "thin-prism"
    fisheye = "fisheye"


@with_option_groups
def camera(
    folder: Annotated[
        Path,
        typer.Argument(
            help="folder of pictures of the board, a video, or corners (CSV); or for --live",
            metavar="DIR",
        ),
    ],
    printed: BoardOptions,
    live: Annotated[
        str | None,
        typer.Option(help="first capture images from this camera or video into DIR"),
    ] = None,
    pictures: Annotated[
        int | None, typer.Option(min=4, help="with --live: minimum number of images (default: 40)")
    ] = None,
    size_px: Annotated[
        tuple[int, int] | None,
        typer.Option(help="image width and height, of --live (default: 1280 720) or of corners"),
    ] = None,
    name: Annotated[str, typer.Option(help="name of the camera in the rig file")] = "camera",
    wanted_mm: WantedOption = 1.0,
    distance_m: Annotated[
        float | None,
        typer.Option(min=0.01, help="working distance of the camera (default: that of the target)"),
    ] = None,
    lens: Annotated[
        LensChoice, typer.Option(help="its model; auto: what fits held-out pictures best")
    ] = LensChoice.auto,
    output: FolderOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Calibrate a camera's matrix and lens distortion, with a verdict on the accuracy.

    Exit code 3 where they are not. Files that cannot be used are named; the others are used.

    [dim]Examples:[/dim]

      cdpr calibrate camera pictures/ --columns 9 --rows 6 --square-mm 25 -o calibration

      cdpr calibrate camera pictures/ --board charuco --columns 7 --rows 5 --square-mm 30
      --marker-mm 22 --dictionary 4X4_50

      cdpr calibrate camera corners.csv --size-px 1280 720 -o calibration

      cdpr calibrate camera pictures/ --live 0 --columns 9 --rows 6 --square-mm 25 -o calibration
    """
    require_file_name(name, "--name")
    to = Destination(output, force)
    if live is None and folder.suffix.lower() == ".csv":
        if size_px is None:
            raise BadInput(
                "a file of corners needs --size-px",
                where=str(folder),
                next_step="pass width and height of the images that they were detected in",
            )
        made = calibrate_camera_from_corners(
            folder,
            size_px,
            name=name,
            wanted=wanted_mm / 1e3,
            distance=distance_m,
            lens=lens.value,
            to=to,
        )
        show_calibration(made, _facts(made), as_json)
        return
    board = printed.made()
    if live is None and (pictures is not None or size_px is not None):
        raise BadInput(
            "--pictures and --size-px are for capturing images",
            where="calibrate camera",
            next_step="pass --live CAMERA as well, or leave them out",
        )
    if live is not None:
        to.require_free("camera", name)
        if not Path(live).is_file():
            require_camera_source(live)
        make_folder(folder, force)
        _take_pictures(live, folder, board, pictures or 40, size_px or (1280, 720))
    made = calibrate_camera(
        folder,
        board,
        name=name,
        wanted=wanted_mm / 1e3,
        distance=distance_m,
        lens=lens.value,
        to=to,
        listener=Terminal(quiet=as_json),
    )
    show_calibration(made, _facts(made), as_json)


def _take_pictures(
    source: str, folder: Path, board: Board, wanted: int, size: tuple[int, int]
) -> None:
    """Takes images until enough are there, the video ends, or Ctrl-C."""
    requests = LocalRequests()
    with stop_requests(requests):
        take_pictures(
            source,
            folder,
            board,
            wanted=wanted,
            size=size,
            on_advice=lambda text: err.print(text, soft_wrap=True),
            stopped=lambda: requests.read().stop,
        )
    if requests.read().stop:
        err.print("capture stopped; the images so far are used")


def _facts(made: CameraOutcome) -> list[tuple[str, str]]:
    """What was found beside the numbers, for people."""
    result, quality = made.found, made.quality
    return [
        ("lens", f"model {result.lens.name}, {len(result.distortion)} coefficients"),
        ("corners", f"{result.error:.3f} px off (RMS) in {len(result.views)} pictures"),
        (
            "boards were",
            f"{quality.nearest:.3g} to {quality.farthest:.3g} m away; if not, the sizes are wrong",
        ),
        ("covered", f"{quality.covered:.0%} of the image; {FULL_COVERAGE:.0%} or more is good"),
        (
            "precision",
            f"{quality.verdict.error * 1e3:.2g} mm at {quality.distance:.2f} m (95 %); two halves"
            f" of the images differ by {quality.halves * 1e3:.2g} mm",
        ),
    ]
