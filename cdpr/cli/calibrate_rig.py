"""`cdpr calibrate rig`: outlets, anchors, pulleys, winches, stiffness, from places at rest."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cdpr.cli.calibration_output import FolderOption, ForceOption, JsonOption, WantedOption
from cdpr.cli.finite import finite

if TYPE_CHECKING:
    from calibration.rig_calibration import RigCalibration
    from calibration.rig_measurements import RigMeasurements
    from calibration.rig_verdict import RigQuality
    from cdpr.rig import Rig


class GroupName(StrEnum):
    """Groups of a rig's numbers."""

    outlets = "outlets"
    anchors = "anchors"
    pulleys = "pulleys"
    drum_scale = "drum_scale"
    offsets = "offsets"
    stiffness = "stiffness"


def rig(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
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
    outlets_mm: Annotated[
        float,
        typer.Option(
            min=1e-6, callback=finite, help="how far off outlets may be, one standard deviation"
        ),
    ] = 4.0,
    anchors_mm: Annotated[
        float, typer.Option(min=1e-6, callback=finite, help="likewise anchors")
    ] = 1.0,
    pulleys_mm: Annotated[
        float, typer.Option(min=1e-6, callback=finite, help="the pulleys' radius")
    ] = 0.5,
    drum_scale_percent: Annotated[
        float, typer.Option(min=1e-6, callback=finite, help="cable per turn of each drum")
    ] = 0.5,
    offsets_mm: Annotated[
        float, typer.Option(min=1e-6, callback=finite, help="cable at the reference (home)")
    ] = 2.0,
    stiffness_percent: Annotated[
        float, typer.Option(min=1e-6, max=1000.0, callback=finite, help="of the cables")
    ] = 20.0,
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
    from math import radians

    import numpy as np

    from calibration.result_file import require_file_name
    from calibration.rig_calibration import calibrate_rig
    from calibration.rig_page import rig_page
    from calibration.rig_result import rig_result
    from calibration.rig_verdict import judge_rig
    from cdpr.cli.calibration_output import begin, finish
    from cdpr.cli.output import spinner
    from cdpr.rig import load_rig

    require_file_name(name, "--name")
    deviations = {
        "outlets": outlets_mm / 1e3,
        "anchors": anchors_mm / 1e3,
        "pulleys": pulleys_mm / 1e3,
        "drum_scale": drum_scale_percent / 1e2,
        "offsets": offsets_mm / 1e3,
        "stiffness": stiffness_percent / 1e2,
    }
    wanted = {k: v for k, v in deviations.items() if k not in {g.value for g in known or []}}
    of_poses = np.array([pose_mm / 1e3] * 3 + [radians(pose_deg)] * 3)
    the_rig, measured = _measured(load_rig(rig), data)
    measured = measured.with_doubt(of_poses)
    if without_poses:
        measured = measured.without_poses()
    today = begin("rig", name, output, force)
    with spinner("fitting", not as_json), _told_of(rig, data):
        result = calibrate_rig(the_rig, measured, wanted, length_mm / 1e3)
        quality = judge_rig(result, wanted_mm / 1e3, radians(tilt_deg))
        document = rig_result(result, quality, name, today)
    page = rig_page(result, quality, name, document.date)
    finish(document, page, _facts(result, quality), output, as_json)


@contextmanager
def _told_of(rig: Path, data: list[Path]) -> Iterator[None]:
    """What goes wrong in the mathematics of a rig that no data are of is told of rig and data.

    Raises:
        BadInput: It did.
    """
    from cdpr.cables import NoCable
    from cdpr.errors import BadInput, Fault, Refused

    try:
        yield
    except (Fault, NoCable, Refused) as error:
        raise BadInput(
            f"the measurements do not fit the rig file {rig}",
            where=", ".join(map(str, data)),
            why=error.what,
            next_step="check units, the order of the cables, the reference of the drives and the"
            " rig file",
        ) from error


def _measured(rig: Rig, data: list[Path]) -> tuple[Rig, RigMeasurements]:
    """The rig as the drives counted, and all places.

    Raises:
        BadInput: A file cannot be read, is of another rig, or is named twice.
    """
    from calibration.rig_data_file import read_rig_data
    from calibration.rig_measurements import joined
    from calibration.rig_result import require_one_drawing

    _require_once(data)
    runs = [(str(path), _rig_of(path)) for path in data if path.is_dir()]
    counted = require_one_drawing(rig, runs)
    parts = [
        _places_of(path) if path.is_dir() else read_rig_data(path, rig.cable_count) for path in data
    ]
    return counted, joined(parts)


def _require_once(data: list[Path]) -> None:
    """Places count once.

    Raises:
        BadInput: A file or folder is named twice.
    """
    from cdpr.errors import BadInput

    named: dict[Path, Path] = {}
    for path in data:
        if path.resolve() in named:
            raise BadInput(
                f"{path} is named twice",
                where="DATA",
                why=f"it is the same as {named[path.resolve()]}",
                next_step="name each file and each run once",
            )
        named[path.resolve()] = path


def _rig_of(run: Path) -> Rig:
    from executor.run_folder import RunFolder

    return RunFolder.open(run).rig()


def _places_of(run: Path) -> RigMeasurements:
    """The places at which the platform of a run stood still."""
    import numpy as np

    from calibration.rig_measurements import Recording, at_rest
    from cdpr.poses import matrix_from_quaternion
    from executor.run_folder import RunFolder

    folder = RunFolder.open(run)
    cycles, poses = folder.cycles(), folder.poses()
    good = poses.ok
    turned = [matrix_from_quaternion(q) for q in poses.rotation[good]]
    return at_rest(
        str(run),
        Recording(
            time=cycles.time,
            asked=cycles.set_counts.astype(np.float64),
            counts=cycles.actual_counts.astype(np.float64),
            tensions=cycles.tensions,
            seen=poses.time[good],
            positions=poses.position[good],
            rotations=np.array(turned).reshape(-1, 3, 3),
            covariances=poses.covariance[good],
        ),
    )


def _facts(result: RigCalibration, quality: RigQuality) -> list[tuple[str, str]]:
    """What was found beside the numbers, for people."""
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
