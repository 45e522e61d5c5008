"""Pose, tensions and clearance of the robot, and the preview of a plan, as data for the page."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from executor.interlock.interlock import MotionInterlock
from executor.recording.run_folder import RunFolder
from executor.report.page import plan_labels
from executor.service import StatusResult
from executor.trajectory.setpoints import PreparedRun, prepare_plan
from model.clearance import ClearanceModel, Nearest
from model.errors import CdprError, Refused
from model.files.documents import millimetres
from model.kinematics import cable_lengths, cables_at, forward_kinematics
from model.pages.scene import (
    Moment,
    SceneFigure,
    Stroke,
    frame_surface,
    grid_floor,
    obstacle_surfaces,
    platform_surface,
    scene_data,
)
from model.plan import Plan, load_plan, require_same_rig
from model.pose import Pose
from model.rig import Rig
from model.scene import Scene, empty_scene
from model.statics.gravity import working_tensions
from model.winches import WinchMap

#: Shortest period of computing the clearance, [s].
CLEARANCE_EVERY = 0.2
#: Half axes of the 95 % ellipsoid of a normal error in three dimensions, [standard deviations].
ELLIPSOID_SCALE = 2.7955


def scene_figure(rig: Rig, scene: Scene | None, *strokes: Stroke) -> SceneFigure:
    """The rig and its obstacles, without the platform."""
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
    """The initial scene as `model.pages.scene.scene_data`, with the workspace for goals."""
    corners = [rig.workspace_lower, rig.workspace_upper]
    workspace = [(1e3 * corner).round(3).tolist() for corner in corners]
    return {**scene_data(scene_figure(rig, scene)), "workspace_mm": workspace}


def pose_data(rig: Rig, pose: Pose, source: str) -> dict[str, Any]:
    """The platform's pose and the cables' exit points, in mm for the page."""
    return {
        "position_mm": (np.round(pose.position * 1e3, 2) + 0.0).tolist(),
        "tilt_deg": round(math.degrees(pose.tilt), 2) + 0.0,
        "turn_deg": round(math.degrees(pose.turn), 2) + 0.0,
        "rotation": np.round(pose.rotation, 6).reshape(-1).tolist(),
        "exits_mm": np.round(cables_at(rig, pose).exits * 1e3, 2).tolist(),
        "source": source,
    }


def nearest_data(nearest: Nearest, required: float) -> dict[str, Any]:
    """The closest pair and its two closest points, in mm for the page.

    Args:
        nearest: A body of the robot and an obstacle.
        required: Clearance that the scene requires, [m].
    """
    points = np.stack([nearest.first_point, nearest.second_point])
    return {
        "now": round(nearest.distance * 1e3, 6),
        "required": round(required * 1e3, 6),
        "pair": [nearest.first, nearest.second],
        "points_mm": (np.round(points * 1e3, 1) + 0.0).tolist(),
    }


def measured_view(measured: dict[str, Any], age: float) -> dict[str, Any]:
    """The measured pose of a run's status and its 95 % ellipsoid, in mm for the page.

    Args:
        measured: See `executor.remote.status`.
        age: Of its images, [s].
    """
    covariance = np.array(measured["covariance_mm2"]).reshape(3, 3)
    variances, axes = np.linalg.eigh((covariance + covariance.T) / 2.0)
    half = ELLIPSOID_SCALE * np.sqrt(np.maximum(variances, 0.0))
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
    """The robot's present state from its drives.

    Attributes:
        pose: ``world_from_platform``, from the encoders.
        tensions: From the motor torques, [N].
        nearest: The closest pair of a body of the robot and an obstacle; None without obstacles.
    """

    pose: Pose
    tensions: list[float]
    nearest: Nearest | None


@dataclass(frozen=True, slots=True, eq=False)
class RobotReport:
    """What is known of the robot; tensions may be known without a pose.

    Attributes:
        robot: None if no pose is known, or none fits the cables.
        tensions: [N]; None if unknown, as for a drive without torque.
        at: ISO time of these values if nothing watches the drives; None while a run reports.
        why_not: Why some of it is unknown, or older than the last attempt to read it.
        why_lost: Why the drives, as read, must be homed.
        is_unread: None yet, or the last one failed: whether the reference is valid is unknown.
        in_use: Another program commanded or used the drives at the last reading; see ``why_not``.
    """

    robot: RobotNow | None
    tensions: list[float | None] | None
    at: str | None = None
    why_not: str | None = None
    why_lost: str | None = None
    is_unread: bool = False
    in_use: bool = False

    def as_dict(self) -> dict[str, Any] | None:
        """Data for the page on values that are not live or incomplete; None if live."""
        if self.at is None and self.why_not is None:
            return None
        return {"at": self.at, "why_not": self.why_not, "in_use": self.in_use}


class RobotView:
    """Tracks the robot's pose from one status to the next."""

    def __init__(self, rig: Rig, scene: Scene | None) -> None:
        """Starts without a status.

        Args:
            rig: The robot and its bus.
            scene: Surroundings, unless a run has its own.
        """
        self._file_rig, self._file_scene = rig, scene
        self._folder: str | None = None
        self._looked = float("-inf")
        self._nearest: Nearest | None = None
        self._pose = rig.home
        self.waypoints: tuple[Pose, ...] = ()
        """Of the plan being run; empty otherwise."""
        self._set(rig, scene)

    def take(self, status: dict[str, Any]) -> RobotNow | None:
        """The robot from a run's status; None before the first cycle, or if no pose fits."""
        folder = status["folder"]
        if folder != self._folder:
            self._folder = folder
            self._set_by(Path(folder) if folder else None)
        drives = status["drives"]
        if not drives or len(drives) != self.rig.cable_count:
            return None
        counts = np.array([drive["position_counts"] for drive in drives], dtype=np.float64)
        tensions = np.array([drive["tension_n"] for drive in drives])
        unstrained = self._winches.unstrained_from_counts(counts)
        lengths = self._winches.strained(unstrained, np.maximum(tensions, 0.0))
        try:
            found = forward_kinematics(self.rig, lengths, self._pose, tolerance=1e-6)
            planned = working_tensions(self.rig, found.pose, self.scene.load).tensions
        except CdprError:
            return None
        # As recorded: tensions unlike the planned ones stretch cables as no pose does.
        more_stretch = float(np.linalg.norm(lengths - self._winches.strained(unstrained, planned)))
        motion = self.rig.motion
        if not found.worst <= motion.start_tolerance + motion.following_error + more_stretch:
            return None  # the nearest pose is wrong: a cable is slack, slipped, or wound in alone
        self._pose = found.pose
        return RobotNow(self._pose, tensions.tolist(), self._near(self._pose))

    def at_rest(self, status: StatusResult) -> RobotNow | None:
        """The robot from drives read at rest; None if no pose is known."""
        if status.pose is None or status.drives is None:
            return None
        self._pose = status.pose
        self._looked = float("-inf")
        tensions = [drive.tension for drive in status.drives]
        return RobotNow(status.pose, tensions, self._near(status.pose))

    def simulated_at(self, pose: Pose) -> RobotNow:
        """The robot at a pose where simulated drives start."""
        self._pose, self._looked = pose, float("-inf")
        tensions = working_tensions(self.rig, pose, self.scene.load).tensions
        return RobotNow(pose, tensions.tolist(), self._near(pose))

    @property
    def required_clearance(self) -> float:
        """Obstacle clearance required by the scene, [m]."""
        return self.scene.obstacle_clearance

    def _near(self, pose: Pose) -> Nearest | None:
        now = time.monotonic()
        if now - self._looked >= CLEARANCE_EVERY:
            self._looked = now
            self._nearest = self._model.smallest(pose)
        return self._nearest

    def _set_by(self, folder: Path | None) -> None:
        """Takes rig and scene from a run's folder; other motions use the console's files."""
        rig, scene = self._file_rig, self._file_scene
        self.waypoints = ()
        try:
            if folder is not None and (folder / "plan.json").exists():
                run = RunFolder(folder)  # still being written: read only its first files
                plan = run.plan()
                rig, scene, self.waypoints = run.rig(), plan.scene, plan.waypoints
            else:
                rig = MotionInterlock(rig).referenced_rig()
        except CdprError:  # not homed yet, or the folder is incomplete
            pass
        self._set(rig, scene)

    def _set(self, rig: Rig, scene: Scene | None) -> None:
        self.rig = rig
        self.scene = empty_scene(rig) if scene is None else scene
        self._winches = WinchMap(rig)
        self._model = ClearanceModel(rig, self.scene)
        self._pose = rig.home


def commanded_pose(rig: Rig, jog: dict[str, Any], robot: RobotNow) -> Pose:
    """The commanded pose of a jog session, exactly: jogs do not rotate the platform.

    Args:
        jog: See `executor.remote.status`.
        robot: From the encoders.

    Raises:
        Refused: A cable's length from the encoders is not the commanded one, beyond the tolerance
            at the start of a run.
    """
    pose = Pose.from_quaternion(millimetres(jog["position_mm"]), jog["quaternion"])
    off = float(np.max(np.abs(cable_lengths(rig, pose) - cable_lengths(rig, robot.pose))))
    if off <= rig.motion.start_tolerance:
        return pose
    raise Refused(
        f"the drives are not where the jog commanded them: a cable is {1e3 * off:.1f} mm off,"
        f" at most {1e3 * rig.motion.start_tolerance:g} mm are allowed",
        where="console",
        why="the platform still moves, or a drive does not follow",
        next_step="release the control and try again; if that fails, end jogging",
    )


# Preview of a plan: path, checks, clearance and tensions along it.
#: Number of poses that are drawn, and at which clearance is computed.
POSES = 200


class LoadedPlan:
    """The plan that a run would follow, and another to compare it with."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self.preview: dict[str, Any] | None = None
        self.compared: dict[str, Any] | None = None
        self.start: Pose | None = None
        self.loading: str | None = None
        """File that is being read and checked, which can take minutes."""

    def load(self, path: Path) -> None:
        """Loads a plan for preview.

        Raises:
            BadInput: It cannot be read, or is for another rig.
        """
        self.forget()
        self.preview, self.start = self._read(path)

    def forget(self) -> None:
        """No plan is loaded; another takes its place."""
        self.preview = self.start = None

    def compare(self, path: Path | None) -> None:
        """Shows another plan beside the loaded one; None ends the comparison.

        Raises:
            BadInput: It cannot be read, or is for another rig.
        """
        self.compared = None if path is None else self._read(path)[0]

    def _read(self, path: Path) -> tuple[dict[str, Any], Pose]:
        """The preview of a plan, and its start."""
        self.loading = str(path)
        try:
            plan = load_plan(path)
            require_same_rig(plan, self._rig, path)
            return preview(path, plan, self._rig), plan.waypoints[0]
        finally:
            self.loading = None

    def off_mm(self, pose: Pose | None) -> float | None:
        """Distance of a pose from the plan's start, [mm]; None if one is unknown."""
        start = self.start
        return None if start is None or pose is None else round(1e3 * pose.distance_to(start), 1)

    def off_start(self, pose: Pose) -> str:
        """How far a pose is from the plan's start; empty if every cable has the same length."""
        if self.start is None:
            return ""
        off = cable_lengths(self._rig, pose) - cable_lengths(self._rig, self.start)
        if np.max(np.abs(off)) <= self._rig.motion.start_tolerance:
            return ""
        return f"{self.off_mm(pose)} mm and {math.degrees(pose.angle_to(self.start)):.1f}°"


def plan_id(preview: dict[str, Any]) -> str:
    """Identifies what a page shows: another plan in a file of the same name is another one."""
    return f"{preview['name']} {preview['hash']}"


def preview(path: Path, plan: Plan, rig: Rig) -> dict[str, Any]:
    """Preview data of a plan and its file; the verdict says why a plan does not pass."""
    named = {"name": str(path), "hash": plan.document.hash}  # the file may be replaced before a run
    try:
        prepared = prepare_plan(plan, rig)
    except CdprError as error:
        return {
            **named,
            "passed": False,
            "verdict": error.what,
            "checks": [],
            "duration_s": None,
            "length_mm": None,
            "least_clearance_mm": None,
            "largest_tension_n": None,
            **_drawn(rig, plan, []),
            "curves": None,
        }
    report = prepared.checked.report
    rows = _rows(prepared)
    table = prepared.checked.table
    poses = [Pose(table.positions[row], table.rotations[row]) for row in rows]
    times = [round(row * table.cycle, 3) for row in rows]
    return {
        **named,
        "passed": True,
        "verdict": "passed every check",
        "checks": _checks(prepared),
        "duration_s": round(prepared.duration, 1),
        "length_mm": round(prepared.length * 1e3, 1),
        "least_clearance_mm": _in_mm(report.proved_obstacle_clearance),
        "largest_tension_n": round(report.max_tension, 1),
        **_drawn(rig, plan, list(zip(times, poses, strict=True))),
        "curves": {
            "time_s": times,
            "clearance_mm": _clearances(rig, plan, poses),
            "required_mm": round(report.required_obstacle_clearance * 1e3, 2),
            "tensions_n": np.round(table.tensions[rows].T, 2).tolist(),
        },
    }


def _in_mm(distance: float) -> float | None:
    """A distance [m] in mm for the page; None if infinite."""
    return round(distance * 1e3, 1) if np.isfinite(distance) else None


def _rows(prepared: PreparedRun) -> list[int]:
    count = len(prepared.checked.table)
    even = np.linspace(0, count - 1, min(count, POSES))
    return sorted({round(float(row)) for row in even})


def _checks(prepared: PreparedRun) -> list[str]:
    report = prepared.checked.report
    checks = []
    if np.isfinite(report.proved_obstacle_clearance):
        checks.append(
            f"clearance to obstacles at least {report.proved_obstacle_clearance * 1e3:.1f} mm,"
            f" required {report.required_obstacle_clearance * 1e3:.1f} mm"
        )
    checks.append(
        f"clearance between cables and to the platform at least"
        f" {report.proved_self_clearance * 1e3:.1f} mm,"
        f" required {report.required_self_clearance * 1e3:.1f} mm"
    )
    checks.append(f"tensions {report.min_tension:.1f} to {report.max_tension:.1f} N")
    return checks


def _clearances(rig: Rig, plan: Plan, poses: list[Pose]) -> list[float | None] | None:
    if not plan.scene.obstacles:
        return None
    model = ClearanceModel(rig, plan.scene)
    near = [model.smallest(pose) for pose in poses]
    return [None if one is None else round(one.distance * 1e3, 2) for one in near]


def _drawn(rig: Rig, plan: Plan, moments: list[tuple[float, Pose]]) -> dict[str, Any]:
    points = np.array([pose.position for pose in plan.waypoints])
    figure = scene_figure(rig, plan.scene, Stroke.along("path", "ink", points, 4.5))
    drawn = tuple(
        Moment(time, pose.position, pose.rotation, cables_at(rig, pose).exits)
        for time, pose in moments
    )
    return scene_data(replace(figure, labels=plan_labels(plan), moments=drawn))
