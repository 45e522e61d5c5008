"""Quantities that can be mapped, and their values at many positions at once.

At a pose where a cable has no exit point (its anchor at its outlet or inside its pulley), every map
is NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from model.clearance import SelfModel
from model.kinematics import Cables, cables_exist, cables_to, structure_matrix_of
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Load, Scene, legs_of
from model.statics.feasibility import WrenchBox, capacity_margin, closure_margin
from model.statics.gravity import weight_wrench
from model.statics.wrench_sets import (
    checked_length,
    condition_number,
    force_volume,
    rms_anchor_radius,
)
from planner.space import Lattice, finite_range, scaled

Values = dict[str, Array]
OBSTACLE_CLEARANCE = "obstacle_clearance"
"""Name of the exact distance to the nearest obstacle, [m]."""
_POSES_AT_ONCE = 512


@dataclass(frozen=True, slots=True, eq=False)
class Question:
    """Rig, scene, orientation and quantities of maps.

    Attributes:
        rig: The robot.
        scene: Its obstacles, clearances and loads; without one only the robot's own weight acts.
        rotation: Orientation of the platform, ``world_from_platform``, shape (3, 3).
        length: Divides the moments in the condition number and so in the dexterity cost, [m].
        quantities: Names of those mapped, from `OF_THE_ROBOT` and `OBSTACLE_CLEARANCE`.
    """

    rig: Rig
    scene: Scene | None
    rotation: Array
    length: float
    quantities: tuple[str, ...]

    @classmethod
    def about(
        cls,
        rig: Rig,
        scene: Scene | None = None,
        rotation: Array | None = None,
        length: float | None = None,
    ) -> Question:
        """All quantities of a rig, or of a rig in a scene.

        Args:
            scene: Obstacles, clearances and load.
            rotation: Shape (3, 3); that of the scene's start, else of home, when left out.
            length: [m]; the root mean square radius of the anchors when left out.

        Raises:
            BadInput: The matrix is not a rotation, or the length is not positive.
        """
        if rotation is None:
            rotation = (scene.start if scene else rig.home).rotation
        rotation = Pose(np.zeros(3), rotation).rotation
        names = list(OF_THE_ROBOT)
        if scene is not None and scene.obstacles:
            names.append(OBSTACLE_CLEARANCE)
        used = rms_anchor_radius(rig.anchors) if length is None else checked_length(length)
        return cls(rig, scene, rotation, used, tuple(names))

    @property
    def loads(self) -> tuple[Load | None, ...]:
        """Those of the scene's legs, each once; one that is None without a scene."""
        if self.scene is None:
            return (None,)
        carried = [leg.scene.load for leg in legs_of(self.scene)]
        return tuple({(x.payload_mass, *x.payload_centre.tolist()): x for x in carried}.values())


def values_at(question: Question, positions: Array) -> Values:
    """The values of every quantity requested.

    Args:
        question: Rig, scene, orientation and quantities.
        positions: World frame, shape (k, 3), [m].

    Returns:
        Shape (k,) each, SI, by name; NaN where a cable has no exit point.
    """
    anchors = question.rig.anchors @ question.rotation.T + positions[:, None, :]
    runs = cables_exist(question.rig, anchors)
    values = {name: np.full(len(positions), np.nan) for name in question.quantities}
    numbers = np.flatnonzero(runs)
    for start in range(0, len(numbers), _POSES_AT_ONCE):
        chosen = numbers[start : start + _POSES_AT_ONCE]
        robot = _Robots(question, positions[chosen], cables_to(question.rig, anchors[chosen]))
        for name in values.keys() - {OBSTACLE_CLEARANCE}:
            values[name][chosen] = OF_THE_ROBOT[name](robot)
    if OBSTACLE_CLEARANCE in values:
        values[OBSTACLE_CLEARANCE][numbers] = _obstacle_clearances(question, positions[numbers])
    return values


@dataclass(frozen=True, slots=True, eq=False)
class _Robots:
    """The robot at many poses."""

    question: Question
    positions: Array
    cables: Cables

    @property
    def matrices(self) -> Array:
        return structure_matrix_of(self.cables, self.positions)


def _closure(robots: _Robots) -> Array:
    return closure_margin(robots.matrices, rms_anchor_radius(robots.question.rig.anchors))


def _capacity(robots: _Robots) -> Array:
    """The smallest with any load of the scene."""
    question, matrices = robots.question, robots.matrices
    rig = question.rig
    limits, radius = (rig.min_tension, rig.max_tension), rms_anchor_radius(rig.anchors)
    margins = [
        capacity_margin(matrices, *limits, _external(question, load), radius)
        for load in question.loads
    ]
    return np.asarray(np.min(margins, axis=0))


def _external(question: Question, load: Load | None) -> WrenchBox:
    """Weight, and the load's box of disturbances."""
    rig = question.rig
    weight = weight_wrench(rig, Pose(rig.home.position, question.rotation), load)
    if load is None:
        return WrenchBox.of_one(weight)
    return WrenchBox(weight, np.concatenate([load.force, load.moment]))


def _condition(robots: _Robots) -> Array:
    return condition_number(robots.matrices, robots.question.length)


def _volume(robots: _Robots) -> Array:
    rig = robots.question.rig
    return force_volume(robots.matrices, rig.max_tension - rig.min_tension)


def _own_clearance(robots: _Robots) -> Array:
    question = robots.question
    model = SelfModel(question.rig)
    pairs = model.cable_pairs(robots.cables).distances.min(axis=-1, initial=np.inf)
    platform = model.to_platform(robots.cables, robots.positions, question.rotation).distances
    return np.asarray(np.minimum(pairs, platform.min(axis=-1)))


def _obstacle_clearances(question: Question, positions: Array) -> Array:
    """Exact distances to the nearest obstacle, [m]; 0 or less where something touches."""
    from planner.collision.edges import edge_clearance
    from planner.collision.world import build_world

    if question.scene is None:
        return np.full(len(positions), np.inf)
    clearance = question.scene.obstacle_clearance
    world = build_world(question.rig, question.scene, question.rotation, clearance)
    return np.array([edge_clearance(world, at, at)[0] for at in positions])


OF_THE_ROBOT: Mapping[str, Callable[[_Robots], Array]] = {
    "closure_margin": _closure,
    "capacity_margin": _capacity,
    "condition_number": _condition,
    "force_volume": _volume,
    "self_clearance": _own_clearance,
}
"""Functions by name: ``closure_margin`` [-] (`model.statics.feasibility.closure_margin`),
``capacity_margin`` [N], ``condition_number`` [-], ``force_volume`` [N³], ``self_clearance`` [m]."""


# The paper's indices as costs: each scaled to 0..1 between its extremes over the workspace box.
#
# Source: Xu & Park, Eqs. 4, 5 and 8 and Fig. 7; see docs/paper.md for the corrections.


INDICES = ("condition_number", "force_volume")


@dataclass(frozen=True, slots=True)
class Extremes:
    """Smallest and largest condition number and inverse volume over the workspace box."""

    condition: tuple[float, float]
    inverse_volume: tuple[float, float]

    @classmethod
    def over_workspace(cls, question: Question) -> Extremes:
        """Those on the planner's lattice; the cost is the planner's at the default length."""
        rig = question.rig
        lattice = Lattice.over(rig.workspace_lower, rig.workspace_upper)
        points = lattice.points(np.arange(lattice.count))
        values = values_at(replace(question, quantities=INDICES), points)
        with np.errstate(divide="ignore"):
            inverse = 1.0 / values["force_volume"]
        return cls(finite_range(values["condition_number"]), finite_range(inverse))


def costs(values: Values, extremes: Extremes) -> Values:
    """Dexterity cost γ_d, wrench cost γ_f and their sum, shapes as given, from the two indices."""
    with np.errstate(divide="ignore"):
        inverse = 1.0 / values["force_volume"]
    dexterity = _scaled(values["condition_number"], *extremes.condition)
    wrench = _scaled(inverse, *extremes.inverse_volume)
    return {"dexterity_cost": dexterity, "wrench_cost": wrench, "cost": dexterity + wrench}


def _scaled(values: Array, low: float, high: float) -> Array:
    """As in plans; NaN where the platform cannot be."""
    return np.where(np.isnan(values), np.nan, scaled(values, low, high))
