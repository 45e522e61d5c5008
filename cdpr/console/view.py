"""What the page shows of the robot, from what its drives say: pose, tensions, clearance."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from executor.interlock.interlock import MotionInterlock
from executor.recording.run_folder import RunFolder
from executor.service import StatusResult
from model.clearance import ClearanceModel, Nearest
from model.errors import CdprError
from model.kinematics import cables_at, forward_kinematics
from model.pages.scene import (
    SceneFigure,
    Stroke,
    frame_surface,
    grid_floor,
    obstacle_surfaces,
    platform_surface,
    scene_data,
)
from model.pose import Pose
from model.rig import Rig
from model.scene import Scene, nothing_in_the_way
from model.statics.gravity import working_tensions
from model.winches import WinchMap

#: Clearance is computed this often at most, [s].
CLEARANCE_EVERY = 0.2
#: Half axes of the ellipsoid that holds 95 % of a normal error in space: in standard deviations.
SURE_IN_SPACE = 2.7955


def scene_figure(rig: Rig, scene: Scene | None, *strokes: Stroke) -> SceneFigure:
    """The rig among its obstacles, without the platform at any moment."""
    surfaces = [frame_surface(rig), *(() if scene is None else obstacle_surfaces(scene))]
    points = [surface.vertices for surface in surfaces]
    points += [stroke.segments.reshape(-1, 3) for stroke in strokes]
    floor, _ = grid_floor(np.concatenate(points))
    return SceneFigure(
        surfaces=tuple(surfaces),
        strokes=(floor, *strokes),
        labels=(),
        anchors=rig.anchors,
        platform=platform_surface(rig),
        moments=(),
    )


def scene_of(rig: Rig, scene: Scene | None) -> dict[str, Any]:
    """What the page draws at first, as `model.pages.scene.scene_data`, and where goals may be."""
    corners = [rig.workspace_lower, rig.workspace_upper]
    workspace = [(1e3 * corner).round(3).tolist() for corner in corners]
    return {**scene_data(scene_figure(rig, scene)), "workspace_mm": workspace}


def pose_data(rig: Rig, pose: Pose, source: str) -> dict[str, Any]:
    """The platform as the page takes it: mm, and where cables leave their pulleys."""
    turn = float(np.degrees(np.arctan2(pose.rotation[1, 0], pose.rotation[0, 0])))
    return {
        "position_mm": (np.round(pose.position * 1e3, 2) + 0.0).tolist(),
        "tilt_deg": round(math.degrees(pose.tilt), 2) + 0.0,
        "turn_deg": round(turn, 2) + 0.0,
        "rotation": np.round(pose.rotation, 6).reshape(-1).tolist(),
        "exits_mm": np.round(cables_at(rig, pose).exits * 1e3, 2).tolist(),
        "source": source,
    }


def nearest_data(nearest: Nearest, required: float) -> dict[str, Any]:
    """The closest pair as the page takes it: mm, and where on both bodies it is closest.

    Args:
        nearest: A body of the robot and an obstacle.
        required: Clearance that the scene asks for, [m].
    """
    points = np.stack([nearest.first_point, nearest.second_point])
    return {
        "now": round(nearest.distance * 1e3, 1),
        "required": round(required * 1e3, 1),
        "pair": [nearest.first, nearest.second],
        "points_mm": (np.round(points * 1e3, 1) + 0.0).tolist(),
    }


def measured_data(measured: dict[str, Any], age: float) -> dict[str, Any]:
    """The measured pose of a run's status as the page takes it: mm, and its 95 % ellipsoid.

    Args:
        measured: See `executor.remote.status`.
        age: Of its images, [s].
    """
    covariance = np.array(measured["covariance_mm2"]).reshape(3, 3)
    variances, axes = np.linalg.eigh((covariance + covariance.T) / 2.0)
    half = SURE_IN_SPACE * np.sqrt(np.maximum(variances, 0.0))
    return {
        "position_mm": [round(v, 2) for v in measured["position_mm"]],
        "half_axes_mm": np.round(axes.T * half[:, None], 4).tolist(),
        "within_mm": round(float(half[-1]), 3),
        "stated": measured["stated"],
        "age_s": round(age, 3),
        "clearance": measured["clearance"],
    }


@dataclass(frozen=True, slots=True, eq=False)
class RobotNow:
    """The robot as its drives have it.

    Attributes:
        pose: ``world_from_platform``; None where their positions fit none.
        tensions: By their torques, [N].
        nearest: The closest pair of a body of the robot and an obstacle; None without obstacles.
    """

    pose: Pose
    tensions: list[float]
    nearest: Nearest | None


class RobotView:
    """Where the robot is, from one status to the next."""

    def __init__(self, rig: Rig, scene: Scene | None) -> None:
        """Not seen yet.

        Args:
            rig: The robot and its bus.
            scene: What is around, unless a run says otherwise.
        """
        self._file_rig, self._file_scene = rig, scene
        self._folder: str | None = None
        self._looked = float("-inf")
        self._nearest: Nearest | None = None
        self._pose = rig.home
        self.waypoints: tuple[Pose, ...] = ()
        """Of the plan that is run; none otherwise."""
        self._set(rig, scene)

    def take(self, status: dict[str, Any]) -> RobotNow | None:
        """The robot by a run's status; None before its first cycle."""
        folder = status["folder"]
        if folder != self._folder:
            self._folder = folder
            self._set_by(Path(folder) if folder else None)
        drives = status["drives"]
        if not drives or len(drives) != self.rig.cable_count:
            return None
        counts = np.array([drive["position_counts"] for drive in drives], dtype=np.float64)
        tensions = np.array([drive["tension_n"] for drive in drives])
        lengths = self._winches.strained(
            self._winches.unstrained_from_counts(counts), np.maximum(tensions, 0.0)
        )
        try:
            self._pose = forward_kinematics(self.rig, lengths, self._pose, tolerance=1e-6).pose
        except CdprError:  # while cables hang slack, no pose fits
            return None
        return RobotNow(self._pose, tensions.tolist(), self._near(self._pose))

    def at_rest(self, status: StatusResult) -> RobotNow | None:
        """The robot as its drives were read while nothing moves; None where no pose is known."""
        if status.pose is None or status.drives is None:
            return None
        self._pose = status.pose
        self._looked = float("-inf")
        tensions = [drive.tension for drive in status.drives]
        return RobotNow(status.pose, tensions, self._near(status.pose))

    def at_home(self) -> RobotNow:
        """The robot at its home pose: where drives that a verb simulates begin."""
        tensions = working_tensions(self.rig, self.rig.home, self.scene.load).tensions
        return RobotNow(self.rig.home, tensions.tolist(), self._near(self.rig.home))

    @property
    def required_clearance(self) -> float:
        """Of the scene, [m]."""
        return self.scene.obstacle_clearance

    def _near(self, pose: Pose) -> Nearest | None:
        now = time.monotonic()
        if now - self._looked >= CLEARANCE_EVERY:
            self._looked = now
            self._nearest = self._model.smallest(pose)
        return self._nearest

    def _set_by(self, folder: Path | None) -> None:
        """A run's folder says for which rig and scene it is; other motions go by the files."""
        rig, scene = self._file_rig, self._file_scene
        self.waypoints = ()
        try:
            if folder is not None and (folder / "plan.json").exists():
                run = RunFolder(folder)  # it is under way: only what was written first is read
                plan = run.plan()
                rig, scene, self.waypoints = run.rig(), plan.scene, plan.waypoints
            else:
                rig = MotionInterlock(rig).referenced_rig()
        except CdprError:  # not homed yet, or the folder is not whole
            pass
        self._set(rig, scene)

    def _set(self, rig: Rig, scene: Scene | None) -> None:
        self.rig = rig
        self.scene = nothing_in_the_way(rig) if scene is None else scene
        self._winches = WinchMap(rig)
        self._model = ClearanceModel(rig, self.scene)
        self._pose = rig.home
