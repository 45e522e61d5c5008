"""Options that the `cdpr calibrate` verbs share, and how each of them ends."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from calibration.procedures import Calibration
from cdpr.cli.options import finite
from cdpr.cli.output import show_facts, show_json

FolderOption = Annotated[
    Path | None, typer.Option("-o", "--output", help="folder for the result and its report")
]
ForceOption = Annotated[
    bool, typer.Option("--force", help="replace a result of the same name and date")
]
WantedOption = Annotated[
    float, typer.Option(min=0.001, callback=finite, help="required accuracy, 95 %")
]
SourceArgument = Annotated[
    str,
    typer.Argument(help="folder of images, video file or camera index", metavar="SOURCE"),
]
PicturesOption = Annotated[
    int | None,
    typer.Option(min=1, help="number of images from a video or camera (default: 20; tags: 40)"),
]
CameraOption = Annotated[
    str | None, typer.Option(help="name of the camera in the rig file (default: the first)")
]


def show_calibration(
    made: Calibration[Any, Any, Any], facts: Sequence[tuple[str, str]], as_json: bool
) -> None:
    """Shows a calibration, and exits with 3 if it is not good enough.

    Args:
        made: Written already.
        facts: More that people want to know.
        as_json: Whether a program reads it.
    """
    result = made.result
    if as_json:
        show_json(result.sealed().model_dump(mode="json"))
    else:
        lines = [("verdict", result.verdict), *(("next", step) for step in result.next_steps)]
        lines += [
            *result.in_words(),
            *facts,
            *(("not used", f"{k} {why}") for k, why in result.unused.items()),
            *zip(("result", "report"), map(str, made.files), strict=False),
        ]
        show_facts(f"{result.kind} {result.name}", lines)
    if not result.good_enough:
        raise typer.Exit(3)
