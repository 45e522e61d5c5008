"""`cdpr calibrate poses` plans measurement poses; `rig` calibrates from stationary samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import degrees, radians
from pathlib import Path
from shlex import quote
from typing import Any

from calibration.geometry.pose_selection import measurement_poses
from calibration.procedures import calibrate_rig
from cdpr.cli.arguments import T, argument, flag, option
from cdpr.cli.calibrate.results import ResultOptions, wanted_option
from cdpr.cli.options import (
    CALIBRATION,
    JSON,
    PLAN_FILE,
    REPLACE_PLAN,
    RIG,
    SCENE,
    Triple,
    calibrated_rig,
    run_command,
)
from cdpr.cli.output import Terminal, present
from model.files.output import require_new_file
from model.plan import plan_as_dict, plan_facts, save_plan
from model.rig import load_rig
from model.scene import load_scene


def poses(
    *,
    rig: Path = RIG,
    scene: Path = SCENE,
    output: Path = PLAN_FILE,
    count: int = option("number of poses", default=60, min=10, max=500),
    tilt_deg: float = option("largest tilt of the platform", default=15.0, min=0.0, max=45.0),
    turn_deg: float = option(
        "largest rotation about the vertical", default=15.0, min=0.0, max=45.0
    ),
    dwell_s: float = option("time at rest at each pose", default=1.5, min=0.7),
    candidates: int = option("number of candidate poses", default=300, min=10, max=5000),
    reserve_n: float | None = option(
        "distance kept from the tension limits (default: 7.5 % of their range)", min=0.0
    ),
    seed: int = option("random seed of the candidates and paths", default=0, min=0),
    calibration: list[Path] | None = CALIBRATION,
    force: bool = REPLACE_PLAN,
    as_json: bool = JSON,
) -> None:
    """Choose the most informative poses for calibration, and plan a path with stops at them.

    Each pose is wrench-feasible and collision-free, and rotated as far as cables and tensions
    allow. `cdpr run` runs the plan; `cdpr calibrate rig` reads the run folder.

    Example:
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
    sentences = [s for s in plan_facts(made.document) if s[0] not in ("via", "search")]
    text = f"{len(made.poses)}, rotated by up to {max(angles):.1f}°"
    run_it = run_command(output, rig, the_rig, calibration)
    then = f"cdpr calibrate rig {quote(str(rig))} RUNDIR"
    next_step = f"{run_it}, then {then}{'' if the_rig.is_tracked else ' --without-poses'}"
    document = {"plan": str(output), "turned_deg": angles, **plan_as_dict(made.document)}
    facts = [("poses", text), *sentences, ("next", next_step)]
    present(as_json, document, f"plan {output}", facts)


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


def _deviation(of: str, default: T, most: float | None = None) -> T:
    """Declares a standard deviation."""
    return option(f"standard deviation of {of}", default=default, min=1e-6, max=most)


@dataclass(frozen=True, slots=True)
class Deviations:
    """Standard deviations of the rig file's numbers; every field is an option."""

    outlets_mm: float = _deviation("the outlets in the rig file", 4.0)
    anchors_mm: float = _deviation("the anchors", 1.0)
    pulleys_mm: float = _deviation("the pulleys' radius", 0.5)
    drum_scale_percent: float = _deviation("the cable per drum turn", 0.5)
    offsets_mm: float = _deviation("the cable length at home", 2.0)
    stiffness_percent: float = _deviation("the cables' stiffness", 20.0, 1000.0)
    stiffness_per_cable: bool = flag("find each cable's stiffness, from measured tensions")
    swivel_zeros_deg: float = _deviation("the zeros of swivel angles", 1.0)
    imu_mounting_deg: float | None = _deviation(
        "an IMU's mounting, then estimated too (default: its axes are the platform's)", None, 45.0
    )

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

    length_mm: float = _deviation("cable lengths from the encoders", 0.1)
    pose_mm: float = _deviation("positions, which all samples may share, besides their file's", 0.1)
    pose_deg: float = _deviation("the same for orientations", 0.02)
    swivel_deg: float = _deviation("swivel angles", 0.1)
    imu_deg: float = _deviation("the vertical by an IMU", 0.1)

    def in_si(self) -> dict[str, Any]:
        """As arguments of `calibrate_rig`, [m] and [rad]."""
        return {
            "length_deviation": self.length_mm / 1e3,
            "pose_deviations": (self.pose_mm / 1e3, radians(self.pose_deg)),
            "swivel_deviation": radians(self.swivel_deg),
            "imu_deviation": radians(self.imu_deg),
        }


def rig(
    *,
    rig: Path = RIG,
    data: list[Path] = argument(
        "run folders and CSV files of stationary samples (docs/data-formats.md)", "DATA..."
    ),
    without_poses: bool = flag("use drive positions alone, without camera poses"),
    reflector_mm: Triple = option(
        "point whose positions the CSV files contain, in the platform frame",
        default=(0.0, 0.0, 0.0),
    ),
    known: list[GroupName] | None = option("parameters to keep as in the rig file; repeatable"),
    deviations: Deviations,
    accuracies: Accuracies,
    tilt_deg: float = option(
        "largest rotation of the platform in use", default=5.0, min=0.0, max=90.0
    ),
    wanted_mm: float = wanted_option(1.0),
    name: str = option("name of the result", default="rig"),
    result: ResultOptions,
) -> None:
    """Calibrate outlets, anchors, pulleys, drum scales, home lengths and cable stiffness.

    Every number comes with its uncertainty; what cannot be identified keeps the rig file's value,
    and is reported. Exit code 3 where the result is not good enough.

    Examples:
      cdpr calibrate rig rig.yaml runs/measuring -o results
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
