"""`cdpr calibrate poses` plans measurement poses; `rig` calibrates from stationary samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import degrees, radians
from pathlib import Path
from typing import Annotated, Any

import typer

from calibration.geometry.pose_selection import measurement_poses
from calibration.procedures import calibrate_rig
from cdpr.cli.calibrate.results import DEFAULT_RESULT, ResultOptions, WantedOption
from cdpr.cli.options import (
    CalibrationOption,
    JsonOption,
    PlanFileOption,
    ReplacePlanOption,
    RigArgument,
    SceneArgument,
    calibrated_rig,
    with_option_groups,
)
from cdpr.cli.output import Terminal, show_facts, show_json
from model.files.output import require_new_file
from model.plan import plan_as_dict, plan_facts, save_plan
from model.rig import load_rig
from model.scene import load_scene


def poses(
    rig: RigArgument,
    scene: SceneArgument,
    output: PlanFileOption,
    count: Annotated[int, typer.Option(min=10, max=500, help="number of poses")] = 60,
    tilt_deg: Annotated[
        float, typer.Option(min=0.0, max=45.0, help="largest tilt of the platform")
    ] = 15.0,
    turn_deg: Annotated[
        float, typer.Option(min=0.0, max=45.0, help="largest rotation about the vertical")
    ] = 15.0,
    dwell_s: Annotated[float, typer.Option(min=0.7, help="time at rest at each pose")] = 1.5,
    candidates: Annotated[
        int, typer.Option(min=10, max=5000, help="number of candidate poses")
    ] = 300,
    reserve_n: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="distance kept from the tension limits (default: 7.5 % of their range)"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="random seed of the candidates and paths")] = 0,
    calibration: CalibrationOption = None,
    force: ReplacePlanOption = False,
    as_json: JsonOption = False,
) -> None:
    """Choose the most informative poses for calibration, and plan a path with stops at them.

    Each pose is wrench-feasible and collision-free, and rotated as far as cables and tensions
    allow. `cdpr run` runs the plan; `cdpr calibrate rig` reads the run folder.

    [dim]Example:[/dim]

      cdpr calibrate poses configs/gachon_8_6_rehearsal.yaml configs/turn.yaml -o measure.json
    """
    require_new_file(output, force)
    the_rig = calibrated_rig(load_rig(rig), calibration)
    made = measurement_poses(
        the_rig,
        load_scene(scene),
        count=count,
        tilt=radians(tilt_deg),
        turn=radians(turn_deg),
        dwell=dwell_s,
        candidates=candidates,
        reserve=reserve_n,
        seed=seed,
        listener=Terminal(quiet=as_json),
    )
    save_plan(made.document, output)
    angles = [degrees(pose.angle_to(the_rig.home)) for pose in made.poses]
    if as_json:
        show_json({"plan": str(output), "turned_deg": angles, **plan_as_dict(made.document)})
        return
    sentences = [s for s in plan_facts(made.document) if s[0] not in ("via", "search")]
    text = f"{len(made.poses)}, rotated by up to {max(angles):.1f}°"
    next_step = f"cdpr run {output} --rig {rig} -o RUNDIR, then cdpr calibrate rig {rig} RUNDIR"
    show_facts(f"plan {output}", [("poses", text), *sentences, ("next", next_step)])


# `cdpr calibrate rig`: outlets, anchors, pulleys, winches, stiffness, from stationary samples.


class GroupName(StrEnum):
    """Groups of rig parameters."""

    outlets = "outlets"
    anchors = "anchors"
    pulleys = "pulleys"
    drum_scale = "drum_scale"
    offsets = "offsets"
    stiffness = "stiffness"
    swivel_zeros = "swivel_zeros"


def _deviation(of: str, most: float | None = None) -> Any:
    """An option that is a standard deviation."""
    return typer.Option(min=1e-6, max=most, help=f"standard deviation of {of}")


@dataclass(frozen=True, slots=True)
class Deviations:
    """Standard deviations of the rig file's numbers; every field is an option."""

    outlets_mm: Annotated[float, _deviation("the outlets in the rig file")] = 4.0
    anchors_mm: Annotated[float, _deviation("the anchors")] = 1.0
    pulleys_mm: Annotated[float, _deviation("the pulleys' radius")] = 0.5
    drum_scale_percent: Annotated[float, _deviation("the cable per drum turn")] = 0.5
    offsets_mm: Annotated[float, _deviation("the cable length at home")] = 2.0
    stiffness_percent: Annotated[float, _deviation("the cables' stiffness", 1000.0)] = 20.0
    stiffness_per_cable: Annotated[
        bool,
        typer.Option(
            "--stiffness-per-cable", help="find each cable's stiffness, from measured tensions"
        ),
    ] = False
    swivel_zeros_deg: Annotated[float, _deviation("the zeros of swivel angles")] = 1.0
    imu_mounting_deg: Annotated[
        float | None,
        _deviation(
            "an IMU's mounting, then estimated too (default: its axes are the platform's)", 45.0
        ),
    ] = None

    def without(self, known: Sequence[GroupName]) -> dict[str, float]:
        """By group, in [m], [rad] or as a fraction, without the known groups."""
        deviations = {
            "outlets": self.outlets_mm / 1e3,
            "anchors": self.anchors_mm / 1e3,
            "pulleys": self.pulleys_mm / 1e3,
            "drum_scale": self.drum_scale_percent / 1e2,
            "offsets": self.offsets_mm / 1e3,
            "stiffness": self.stiffness_percent / 1e2,
            "swivel_zeros": radians(self.swivel_zeros_deg),
        }
        free = {group: size for group, size in deviations.items() if group not in known}
        if self.stiffness_per_cable and "stiffness" in free:
            free["cable_stiffness"] = free.pop("stiffness")
        if self.imu_mounting_deg is not None:
            free["imu_mounting"] = radians(self.imu_mounting_deg)
        return free


@dataclass(frozen=True, slots=True)
class Accuracies:
    """Standard deviations of the measurements; every field is an option."""

    length_mm: Annotated[float, _deviation("cable lengths from the encoders")] = 0.1
    pose_mm: Annotated[float, _deviation("positions, added to that of their file")] = 0.1
    pose_deg: Annotated[float, _deviation("orientations, added to that of their file")] = 0.02
    swivel_deg: Annotated[float, _deviation("swivel angles")] = 0.1
    imu_deg: Annotated[float, _deviation("the vertical by an IMU")] = 0.1

    def in_si(self) -> dict[str, Any]:
        """As arguments of `calibrate_rig`, [m] and [rad]."""
        return {
            "length_deviation": self.length_mm / 1e3,
            "pose_deviations": (self.pose_mm / 1e3, radians(self.pose_deg)),
            "swivel_deviation": radians(self.swivel_deg),
            "imu_deviation": radians(self.imu_deg),
        }


DEFAULT_DEVIATIONS, DEFAULT_ACCURACIES = Deviations(), Accuracies()


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
            help="point whose positions a file without rotations contains, in the platform frame"
        ),
    ] = (0.0, 0.0, 0.0),
    known: Annotated[
        list[GroupName] | None,
        typer.Option(help="parameters to keep as in the rig file; repeatable"),
    ] = None,
    deviations: Deviations = DEFAULT_DEVIATIONS,
    accuracies: Accuracies = DEFAULT_ACCURACIES,
    tilt_deg: Annotated[
        float,
        typer.Option(min=0.0, max=90.0, help="largest rotation of the platform in use"),
    ] = 5.0,
    wanted_mm: WantedOption = 1.0,
    name: Annotated[str, typer.Option(help="name of the result")] = "rig",
    result: ResultOptions = DEFAULT_RESULT,
) -> None:
    """Calibrate outlets, anchors, pulleys, drum scales, home lengths and cable stiffness.

    Every number comes with its uncertainty; what cannot be identified keeps the rig file's value,
    and is reported. Exit code 3 where the result is not good enough.

    [dim]Examples:[/dim]

      cdpr calibrate rig rig.yaml runs/measuring -o calibration

      cdpr calibrate rig rig.yaml lengths.csv --without-poses --known drum_scale
    """
    made = calibrate_rig(
        load_rig(rig),
        data,
        deviations=deviations.without(known or []),
        **accuracies.in_si(),
        without_poses=without_poses,
        reflector=[x / 1e3 for x in reflector_mm],
        tilt=radians(tilt_deg),
        wanted=wanted_mm / 1e3,
        name=name,
        rig_file=rig,
        output=result.to,
        listener=result.listener,
    )
    result.show(made)
