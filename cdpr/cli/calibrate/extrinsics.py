"""`cdpr calibrate extrinsics`: where a camera stands."""

from __future__ import annotations

from math import radians
from pathlib import Path
from typing import Annotated

import typer

from calibration.extrinsics.result import moved_rows
from calibration.extrinsics.surveyed_tags import Survey
from calibration.pictures import pictures_of
from calibration.procedures import USUAL_PICTURES, Destination, locate_camera
from cdpr.cli.calibrate.output import (
    CameraOption,
    FolderOption,
    ForceOption,
    PicturesOption,
    SourceArgument,
    WantedOption,
    show_calibration,
)
from cdpr.cli.options import CalibrationOption, JsonOption, RigArgument, calibrated_rig, finite
from cdpr.cli.output import Terminal
from model.rig import load_rig


def extrinsics(
    rig: RigArgument,
    source: SourceArgument,
    camera: CameraOption = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="use the rig's motion: poses per image (CSV), or a run folder",
            metavar="FILE",
        ),
    ] = None,
    survey_mm: Annotated[
        float,
        typer.Option(
            min=0.0,
            callback=finite,
            help="standard deviation of the surveyed corners of frame tags",
        ),
    ] = 0.5,
    survey_deg: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            callback=finite,
            help="standard deviation of frame tags' rotations; --survey-mm is then of whole"
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
    """Find a camera's pose, from surveyed tags on the frame or from the rig's motion.

    Images must be taken while the camera stands still. Exit code 3 where the result is not good
    enough.

    [dim]Examples:[/dim]

      cdpr calibrate extrinsics rig.yaml pictures/ -o calibration

      cdpr calibrate extrinsics rig.yaml 0 --calibration calibration_camera_front_2026-03-01.yaml

      cdpr calibrate extrinsics rig.yaml runs/first/pictures --poses runs/first
    """
    the_rig = calibrated_rig(load_rig(rig), calibration)
    the_camera = the_rig.camera(camera)
    made = locate_camera(
        the_rig,
        the_camera,
        lambda: pictures_of(source, the_camera, pictures, USUAL_PICTURES),
        poses=poses,
        survey=Survey(survey_mm / 1e3, None if survey_deg is None else radians(survey_deg)),
        wanted=wanted_mm / 1e3,
        to=Destination(output, force),
        listener=Terminal(quiet=as_json),
    )
    found = made.found
    facts = [
        ("by", f"{found.by}, {found.pictures} images"),
        *((f"tag {k}", f"{error:.3f} px") for k, error in found.tag_errors.items()),
        *moved_rows(the_camera.world_from_camera, found.world_from_camera),
    ]
    show_calibration(made, facts, as_json)
