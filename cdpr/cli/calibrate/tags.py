"""`cdpr calibrate tags`: where the tags are on the platform."""

from __future__ import annotations

from typing import Annotated

import typer

from calibration.pictures import pictures_of
from calibration.procedures import USUAL_TAG_PICTURES, Destination, locate_tags
from calibration.tag_map.result import change_rows
from cdpr.cli.calibrate.output import (
    CameraOption,
    FolderOption,
    ForceOption,
    PicturesOption,
    SourceArgument,
    WantedOption,
    show_calibration,
)
from cdpr.cli.options import CalibrationOption, JsonOption, RigArgument, calibrated_rig
from cdpr.cli.output import Terminal
from model.rig import load_rig


def tags(
    rig: RigArgument,
    source: SourceArgument,
    camera: CameraOption = None,
    fixed_tag: Annotated[
        int | None,
        typer.Option(
            min=0, help="keep this tag as in the rig file (default: best fit of all tags)"
        ),
    ] = None,
    pictures: PicturesOption = None,
    calibration: CalibrationOption = None,
    wanted_mm: WantedOption = 0.2,
    output: FolderOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find the tags' poses on the platform, from images that show two or more at once.

    Turn the platform before the camera, or carry the camera around it: every image may be taken
    from anywhere. Exit code 3 where the result is not good enough.

    [dim]Examples:[/dim]

      cdpr calibrate tags rig.yaml pictures/ -o calibration

      cdpr calibrate tags rig.yaml pictures/ --calibration calibration_camera_front_2026-03-01.yaml
    """
    the_rig = calibrated_rig(load_rig(rig), calibration)
    the_camera = the_rig.camera(camera)
    made = locate_tags(
        the_rig,
        the_camera,
        lambda: pictures_of(source, the_camera, pictures, USUAL_TAG_PICTURES),
        fixed_tag=fixed_tag,
        wanted=wanted_mm / 1e3,
        to=Destination(output, force),
        listener=Terminal(quiet=as_json),
    )
    found = made.found
    facts = [
        (
            "pictures",
            f"{len(found.errors)} used, reprojection error {found.reprojection:.3f} px RMS",
        ),
        *(
            (name, f"moved {shift} mm, rotated {turn}° from the rig file; {count}")
            for name, shift, turn, _, count in change_rows(found)
        ),
    ]
    show_calibration(made, facts, as_json)
