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
            min=1e-6, callback=finite, help="standard deviation of the outlets in the rig file"
        ),
    ] = 4.0
    anchors_mm: Annotated[
        float, typer.Option(min=1e-6, callback=finite, help="standard deviation of the anchors")
    ] = 1.0
    pulleys_mm: Annotated[
        float,
        typer.Option(min=1e-6, callback=finite, help="standard deviation of the pulleys' radius"),
    ] = 0.5
    drum_scale_percent: Annotated[
        float,
        typer.Option(
            min=1e-6, callback=finite, help="standard deviation of the cable per drum turn"
        ),
    ] = 0.5
    offsets_mm: Annotated[
        float,
        typer.Option(
            min=1e-6, callback=finite, help="standard deviation of the cable length at home"
        ),
    ] = 2.0
    stiffness_percent: Annotated[
        float,
        typer.Option(
            min=1e-6,
            max=1000.0,
            callback=finite,
            help="standard deviation of the cables' stiffness",
        ),
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
            help="run folders and CSV files of stationary samples (docs/data-formats.md)",
            metavar="DATA...",
        ),
    ],
    without_poses: Annotated[
        bool,
        typer.Option("--without-poses", help="use drive positions alone, without camera poses"),
    ] = False,
    reflector_mm: Annotated[
        tuple[float, float, float],
        typer.Option(
            help="point of the platform whose positions a file without rotations holds, platform"
            " frame"
        ),
    ] = (0.0, 0.0, 0.0),
    known: Annotated[
        list[GroupName] | None,
        typer.Option(help="parameters to keep as in the rig file; repeatable"),
    ] = None,
    deviations: Deviations = DRAWING,
    length_mm: Annotated[
        float,
        typer.Option(
            min=1e-6, callback=finite, help="standard deviation of cable lengths from the encoders"
        ),
    ] = 0.1,
    pose_mm: Annotated[
        float,
        typer.Option(
            min=1e-6,
            callback=finite,
            help="standard deviation of positions, added to that of their file",
        ),
    ] = 0.1,
    pose_deg: Annotated[
        float,
        typer.Option(
            min=1e-6,
            callback=finite,
            help="standard deviation of orientations, added to that of their file",
        ),
    ] = 0.02,
    tilt_deg: Annotated[
        float,
        typer.Option(
            min=0.0, max=90.0, callback=finite, help="largest rotation of the platform in use"
        ),
    ] = 5.0,
    wanted_mm: WantedOption = 1.0,
    name: Annotated[str, typer.Option(help="name of the result")] = "rig",
    output: FolderOption = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Calibrate outlets, anchors, pulleys, drum scales, home lengths and cable stiffness.

    Each is given with its uncertainty.

    Exit code 3 where they are not good enough. What cannot be identified stays as in the rig file,
    and is reported.

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
        reflector=[x / 1e3 for x in reflector_mm],
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
            f"{what} RMS error at held-out samples {quality.held_out * 1e3:.3f} mm;"
            f" with the rig file {quality.before * 1e3:.3f} mm; {len(result.measured)} samples",
        ),
        (
            "in the workspace",
            f"within {quality.level * 1e3:.2g} mm, rotated within {quality.turned * 1e3:.2g} mm"
            " (95 %)",
        ),
    ]
    return facts + [("not identified", line) for line in result.not_identified]
