"""Scenes in which the platform may turn, and an independent judge of the moves in them."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from model.clearance import ClearanceModel
from model.files.documents import PoseDocument
from model.files.scene_file import SceneDocument
from model.kinematics import structure_matrix
from model.pose import Array, Pose, interpolate
from model.rig import Rig, rig_from_document
from model.scene import Scene, load_scene, scene_from_document
from model.statics.feasibility import WrenchBox, capacity_margin
from model.statics.gravity import weight_wrench
from model.statics.wrench_sets import rms_anchor_radius
from planner.anytime_6d.path import rotating_problem
from planner.anytime_6d.problem import RotatingProblem
from planner.costs import KinematicCost
from planner.settings import OBJECTIVES, Weights
from tests.configs import CONFIGS
from tests.planner.collision.sampled_oracle import CoalScene


def turning(name: str, tilt_deg: float, turn_deg: float, **parts: Any) -> Scene:
    """An example scene with rotation limits, and other parts replaced."""
    document = load_scene(CONFIGS / f"{name}.yaml").document.model_dump()
    limits = {"tilt_deg": tilt_deg, "turn_deg": turn_deg}
    return scene_from_document(
        SceneDocument.model_validate(document | {"rotation_limits": limits} | parts)
    )


def problem_of(rig: Rig, scene: Scene, weights: Weights = OBJECTIVES["length"]) -> RotatingProblem:
    """The problem of a scene."""
    return rotating_problem(rig, scene, weights, KinematicCost(rig, scene.start.rotation))


def quaternion(x_deg: float, y_deg: float, z_deg: float = 0.0) -> list[float]:
    """A unit quaternion (w, x, y, z) of rotations about the axes in sequence."""
    turn = Rotation.from_euler("zyx", [z_deg, y_deg, x_deg], degrees=True)
    return [float(q) for q in turn.as_quat(scalar_first=True)]


def random_pose(rng: np.random.Generator, rig: Rig, scene: Scene) -> Pose:
    """A pose of the workspace within the scene's limits."""
    limits = scene.rotation_limits
    assert limits is not None
    about, tilt = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.0, limits.tilt)
    tipped = Rotation.from_rotvec([tilt * np.cos(about), tilt * np.sin(about), 0.0])
    spun = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-limits.turn, limits.turn)])
    position = rng.uniform(rig.workspace_lower, rig.workspace_upper)
    return Pose(position, (tipped * spun).as_matrix())


def upside_down(rig: Rig) -> Rig:
    """The same robot with the platform's frame turned over: z down where it was up."""
    flip = np.diag([1.0, -1.0, -1.0])
    home = rig.home
    document = rig.document
    platform = document.platform.model_copy(
        update={
            "home": PoseDocument.of(Pose(home.position, home.rotation @ flip)),
            "centre_of_mass_mm": (flip @ document.platform.centre_of_mass_mm).tolist(),
        }
    )
    anchors = (np.asarray(document.anchors_mm) @ flip).tolist()
    changes = {"platform": platform, "anchors_mm": anchors, "tags": None, "cameras": []}
    return rig_from_document(document.model_copy(update=changes))


class Judge:
    """Checks dense poses with coal, the model of self clearance and the statics."""

    def __init__(self, rig: Rig, scene: Scene) -> None:
        self.rig, self.scene = rig, scene
        self._obstacles, self._model = CoalScene(scene), ClearanceModel(rig, scene)

    def room(self, pose: Pose) -> float:
        """Least of obstacle and self clearance above what the scene requires, [m]."""
        away = self._obstacles.pose_distance(self.rig, pose) - self.scene.obstacle_clearance
        own = self._model.self_clearance(pose).distance - self.scene.self_clearance
        return min(away, own)

    def margin(self, pose: Pose) -> float:
        """The capacity margin, [N]."""
        load, rig = self.scene.load, self.rig
        box = WrenchBox(weight_wrench(rig, pose, load), np.concatenate([load.force, load.moment]))
        length = rms_anchor_radius(rig.anchors)
        matrix = structure_matrix(rig, pose)
        return float(capacity_margin(matrix, rig.min_tension, rig.max_tension, box, length))

    def fault(self, start: Pose, end: Pose, samples: int) -> str:
        """The violation of a move at samples; empty where none is found."""
        limits = self.scene.rotation_limits
        for share in np.linspace(0.0, 1.0, samples):
            pose = interpolate(start, end, float(share))
            tilt = float(np.arccos(min(pose.rotation[2, 2], 1.0)))
            if limits is not None and tilt > limits.tilt + 1e-6:
                return f"tilted {np.degrees(tilt)}"
            if self.room(pose) < 0.0:
                return f"too near by {-self.room(pose)}"
            if self.margin(pose) < 0.0:
                return f"margin {self.margin(pose)}"
        return ""


def row(pose: Pose) -> Array:
    """A pose as compiled code takes it, shape (7,)."""
    return np.concatenate([pose.position, pose.quaternion])
