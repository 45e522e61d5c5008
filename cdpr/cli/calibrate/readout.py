"""`cdpr calibrate readout`: how long a camera takes from its top row to its bottom row."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibration.procedures import Destination, measure_readout
from cdpr.cli.calibrate.output import (
    CameraOption,
    FolderOption,
    ForceOption,
    WantedOption,
    show_calibration,
)
from cdpr.cli.options import CalibrationOption, JsonOption, RigArgument, calibrated_rig, finite
from cdpr.cli.output import Terminal
from model.rig import load_rig


def readout(
    rig: RigArgument,
    source: Annotated[
        Path, typer.Argument(help="video file, or folder of images", metavar="SOURCE")
    ],
    camera: CameraOption = None,
    rate_hz: Annotated[
        float | None,
        typer.Option(
            min=0.1, callback=finite, help="images per second of a folder (default: the camera's)"
        ),
    ] = None,
    speed_mm_s: Annotated[
        float | None,
        typer.Option(
            min=0.1, callback=finite, help="for which the error is stated (default: motion's)"
        ),
    ] = None,
    calibration: CalibrationOption = None,
    wanted_mm: WantedOption = 0.1,
    output: FolderOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Measure a rolling shutter, from images of the platform while it moves.

    The platform goes up and down and sideways before the camera, which stands still. Exit code 3
    where the result is not good enough.

    [dim]Examples:[/dim]

      cdpr calibrate readout rig.yaml moving.mp4 -o calibration

      cdpr calibrate readout rig.yaml runs/first/pictures --rate-hz 10
    """
    the_rig = calibrated_rig(load_rig(rig), calibration)
    made = measure_readout(
        the_rig,
        the_rig.camera(camera),
        source,
        rate=rate_hz,
        speed=None if speed_mm_s is None else speed_mm_s / 1e3,
        wanted=wanted_mm / 1e3,
        to=Destination(output, force),
        listener=Terminal(quiet=as_json),
    )
    found = made.found
    fastest = max(found.speeds.values())
    facts = [
        (
            "pictures",
            f"{len(found.speeds)} used, the platform's speed up to {fastest * 1e3:.0f} mm/s",
        ),
        ("edges", f"{found.before:.2f} standard deviations off before, {found.after:.2f} after"),
    ]
    show_calibration(made, facts, as_json)
