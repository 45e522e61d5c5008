"""`cdpr calibrate tags`: where the tags are on the platform."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cdpr.cli.calibrate_extrinsics import CameraOption, PicturesOption, SourceArgument
from cdpr.cli.calibration_output import FolderOption, ForceOption, JsonOption, WantedOption
from cdpr.cli.calibrations import CalibrationOption


def tags(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
    source: SourceArgument,
    camera: CameraOption = None,
    fixed_tag: Annotated[
        int | None,
        typer.Option(min=0, help="this tag is as in the rig file (default: all fit it best)"),
    ] = None,
    pictures: PicturesOption = None,
    calibration: CalibrationOption = None,
    wanted_mm: WantedOption = 0.2,
    output: FolderOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find where the tags are on the platform, from pictures that show two or more at once.

    Turn the platform before the camera, or carry the camera around it: every picture may be taken
    from anywhere. Exit code 3 where the result is not good enough.

    [dim]Examples:[/dim]

      cdpr calibrate tags rig.yaml pictures/ -o calibration

      cdpr calibrate tags rig.yaml pictures/ --calibration calibration_camera_front_2026-03-01.yaml
    """
    from calibration.result_file import require_file_name
    from calibration.tag_layout import measure_layout, require_tags
    from calibration.tag_sights import sights_of
    from calibration.tags_page import change_rows, tags_page
    from calibration.tags_result import tags_result
    from calibration.tags_verdict import judge_layout
    from cdpr.cli.calibration_output import begin, finish
    from cdpr.cli.calibrations import calibrated_rig
    from cdpr.cli.camera_choice import named_camera
    from cdpr.cli.compiling import ready_to_measure
    from cdpr.cli.output import progress_bar
    from cdpr.cli.picture_sources import pictures_of, told
    from cdpr.rig import load_rig

    the_rig = calibrated_rig(load_rig(rig), calibration)
    the_camera = named_camera(the_rig, camera)
    require_file_name(the_rig.name, "name")
    require_tags(the_rig, fixed_tag)
    images = pictures_of(source, the_camera, pictures, usual=40)
    today = begin("tags", the_rig.name, output, force)
    numbers = [tag.id for tag in the_rig.platform_tags]
    ready_to_measure(not as_json)
    with progress_bar("looking for tags", images.count, not as_json) as advance:
        sights = sights_of(told(images, advance), the_rig, the_camera, numbers, images.unused)
    found = measure_layout(the_rig, the_camera, sights, fixed_tag)
    verdict = judge_layout(found, wanted_mm / 1e3)
    document = tags_result(found, verdict, the_rig.document, today)
    facts = [
        ("pictures", f"{len(found.errors)} used, corners {found.reprojection:.3f} px off (RMS)"),
        *(
            (name, f"moved {shift} mm, turned {turn}° against the rig file; {count}")
            for name, shift, turn, _, count in change_rows(found)
        ),
    ]
    finish(document, tags_page(found, document, verdict), facts, output, as_json)
