"""`cdpr calibrate rig`: outlets, anchors, pulleys, winches, stiffness, from places at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import radians
from pathlib import Path
from typing import Annotated

import typer

from calibration.procedures import Destination, RigOutcome, calibrate_rig
from cdpr.cli.calibrate.output import FolderOption, ForceOption, WantedOption, show_calibration
from cdpr.cli.options import JsonOption, RigArgument, finite, with_option_groups
from cdpr.cli.output import Terminal
from model.rig import load_rig


class GroupName(StrEnum):
    """Groups of a rig's numbers."""

    outlets = "outlets"
    anchors = "anchors"
    pulleys = "pulleys"
    drum_scale = "drum_scale"
    offsets = "offsets"
    stiffness = "stiffness"


@dataclass(frozen=True, slots=True)
class Deviations:
    """How far off the rig file's numbers may be; every field is an option."""

    outlets_mm: Annotated[
        float,
        typer.Option(
            min=1e-6, callback=finite, help="how far off outlets may be, one standard deviation"
        ),
    ] = 4.0
    anchors_mm: Annotated[
        float, typer.Option(min=1e-6, callback=finite, help="likewise anchors")
    ] = 1.0
    pulleys_mm: Annotated[
        float, typer.Option(min=1e-6, callback=finite, help="the pulleys' radius")
    ] = 0.5
    drum_scale_percent: Annotated[
        float, typer.Option(min=1e-6, callback=finite, help="cable per turn of each drum")
    ] = 0.5
    offsets_mm: Annotated[
        float, typer.Option(min=1e-6, callback=finite, help="cable at the reference (home)")
    ] = 2.0
    stiffness_percent: Annotated[
        float, typer.Option(min=1e-6, max=1000.0, callback=finite, help="of the cables")
    ] = 20.0

    def but(self, known: Sequence[GroupName]) -> dict[str, float]:
        """By group, [m] or as a share, without those that are known."""
        deviations = {
            "outlets": self.outlets_mm / 1e3,
            "anchors": self.anchors_mm / 1e3,
            "pulleys": self.pulleys_mm / 1e3,
            "drum_scale": self.drum_scale_percent / 1e2,
            "offsets": self.offsets_mm / 1e3,
            "stiffness": self.stiffness_percent / 1e2,
        }
        fixed = {group.value for group in known}
        return {group: size for group, size in deviations.items() if group not in fixed}


DRAWING = Deviations()


@with_option_groups
def rig(
    rig: RigArgument,
    data: Annotated[
        list[Path],
        typer.Argument(
            help="run folders, and CSV files of places at rest (docs/data-formats.md)",
            metavar="DATA...",
        ),
    ],
    without_poses: Annotated[
        bool, typer.Option("--without-poses", help="use drive positions alone, as without a camera")
    ] = False,
    known: Annotated[
        list[GroupName] | None,
        typer.Option(help="numbers to leave as in the rig file; again for more"),
    ] = None,
    deviations: Deviations = DRAWING,
    length_mm: Annotated[
        float,
        typer.Option(
            min=1e-6, callback=finite, help="how far off lengths by drive positions may be"
        ),
    ] = 0.1,
    pose_mm: Annotated[
        float,
        typer.Option(
            min=1e-6, callback=finite, help="how far off poses may be beside what their file tells"
        ),
    ] = 0.1,
    pose_deg: Annotated[
        float, typer.Option(min=1e-6, callback=finite, help="their turns, likewise")
    ] = 0.02,
    tilt_deg: Annotated[
        float,
        typer.Option(
            min=0.0, max=90.0, callback=finite, help="how far the platform will be turned"
        ),
    ] = 5.0,
    wanted_mm: WantedOption = 1.0,
    name: Annotated[str, typer.Option(help="of the result")] = "rig",
    output: FolderOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find outlets, anchors, pulleys, drum scales, references and the cables' stiffness.

    How well they are known is told with each.

    Exit code 3 where they are not good enough. What cannot be identified stays as in the rig file,
    and is told.

    [dim]Examples:[/dim]

      cdpr calibrate rig rig.yaml runs/measuring -o calibration

      cdpr calibrate rig rig.yaml lengths.csv --without-poses --known drum_scale
    """
    made = calibrate_rig(
        load_rig(rig),
        data,
        deviations=deviations.but(known or []),
        length_deviation=length_mm / 1e3,
        pose_deviations=(pose_mm / 1e3, radians(pose_deg)),
        without_poses=without_poses,
        tilt=radians(tilt_deg),
        wanted=wanted_mm / 1e3,
        name=name,
        rig_file=rig,
        to=Destination(output, force),
        listener=Terminal(quiet=as_json),
    )
    show_calibration(made, _facts(made), as_json)


def _facts(made: RigOutcome) -> list[tuple[str, str]]:
    """What was found beside the numbers, for people."""
    result, quality = made.found, made.quality
    what = "positions" if result.held_out.poses else "cables"
    facts = [
        (
            "held out",
            f"{what} at places left out of the fit are {quality.held_out * 1e3:.3f} mm off (RMS),"
            f" by the rig file {quality.before * 1e3:.3f} mm; {len(result.measured)} places",
        ),
        (
            "in the workspace",
            f"within {quality.level * 1e3:.2g} mm, turned within {quality.turned * 1e3:.2g} mm"
            " (95 %)",
        ),
    ]
    return facts + [("not identified", line) for line in result.not_identified]
