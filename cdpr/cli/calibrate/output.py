"""Options and result output shared by the `cdpr calibrate` verbs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from calibration.results import Calibration, Destination
from cdpr.cli.options import JsonOption, finite
from cdpr.cli.output import Terminal, show_facts, show_json

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


@dataclass(frozen=True, slots=True)
class ResultOptions:
    """Destination and output format of a calibration's result; every field is an option."""

    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="folder for the result and its report")
    ] = None
    force: Annotated[
        bool, typer.Option("--force", help="replace a result with the same name and date")
    ] = False
    as_json: JsonOption = False

    @property
    def to(self) -> Destination:
        """Where the result is written."""
        return Destination(self.output, self.force)

    @property
    def listener(self) -> Terminal:
        """Shows the progress on standard error."""
        return Terminal(quiet=self.as_json)

    def show(self, made: Calibration[Any, Any, Any]) -> None:
        """Shows a calibration, and exits with 3 if it is not good enough."""
        result = made.result
        if self.as_json:
            show_json(result.sealed().model_dump(mode="json"))
        else:
            lines = [("verdict", result.verdict), *(("next", step) for step in result.next_steps)]
            lines += [
                *result.in_words(),
                *made.facts,
                *(("not used", f"{k} {why}") for k, why in result.unused.items()),
                *zip(("result", "report"), map(str, made.files), strict=False),
            ]
            show_facts(f"{result.kind} {result.name}", lines)
        if not result.good_enough:
            raise typer.Exit(3)


DEFAULT_RESULT = ResultOptions()
