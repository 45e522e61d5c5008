"""One search of the campaign, and its measurements."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.random import Generator

from model.clearance import ClearanceModel
from model.errors import NoSolution
from model.files.rig_file import RigDocument
from model.files.scene_file import SceneDocument
from model.pose import Array
from model.rig import Rig, rig_from_document
from model.scene import Scene, scene_from_document
from planner.bounds import smallest_along
from planner.check import check_path
from planner.costs import KinematicCost
from planner.edge_checks import ExactChecks
from planner.path import PosePath
from planner.rrt.rrt import exact_checks
from planner.rrt.search import PaperPlanner, SearchResult
from planner.rrt.variants import DEFAULT, AlgorithmVariant
from planner.settings import CLEARANCE_RESERVE, CostName, PlannerSettings, SamplerName

# Random starts and goals as far apart as the scene's own (paper, section 5.3).


_TRIES = 100_000


def random_ends(planner: PaperPlanner, distance: float, random: Generator) -> tuple[Array, Array]:
    """A usable start and goal with an obstacle across the straight line.

    The text says "different start and goal points with the same path length"; before a search only
    the straight distance is known, so that is kept equal. Pairs joined by a free straight line are
    left out: neither planner has anything to search there.

    Args:
        planner: Of the scene; decides what is free.
        distance: Between start and goal, [m].

    Returns:
        Start and goal, shape (3,) each, [m].

    Raises:
        NoSolution: No such pair was found.
    """
    lower, upper = planner.space.lower, planner.space.upper
    for _ in range(_TRIES):
        start = random.uniform(lower, upper)
        direction = random.normal(size=len(start))
        goal = start + distance * direction / np.linalg.norm(direction)
        if np.any(goal < lower) or np.any(goal > upper):
            continue
        usable = planner.edge(start, start) and planner.edge(goal, goal)
        if usable and not planner.edge(start, goal):
            return start, goal
    raise NoSolution(
        f"no start and goal {distance * 1e3:.0f} mm apart with an obstacle between them",
        where="random starts and goals",
        next_step="reduce the clearance, or leave out the random ends",
    )


# Workspace boxes: the rig's own, and larger ones to see how a claim depends on the box.


GROWTH_MM = ((-100.0, -100.0, -50.0), (100.0, 100.0, 100.0))
"""From the rig's own box to the wide one; the paper's rig goes from ±250, 150 to 650 mm to ±350,
100 to 750 mm."""

OWN, WIDE = "own", "wide"
SHARES = {OWN: 0.0, "25 %": 0.25, "50 %": 0.5, "75 %": 0.75, WIDE: 1.0}
"""Boxes by name, with the share of `GROWTH_MM` by which they are grown."""


def with_box(rig: Rig, name: str) -> Rig:
    """The same rig with its workspace grown to the box named in `SHARES`."""
    share, box = SHARES[name], rig.document.workspace
    lower, upper = (
        [edge + share * growth for edge, growth in zip(edges, grown, strict=True)]
        for edges, grown in zip((box.lower_mm, box.upper_mm), GROWTH_MM, strict=True)
    )
    changed = box.model_copy(update={"lower_mm": lower, "upper_mm": upper})
    return rig_from_document(rig.document.model_copy(update={"workspace": changed}))


def box_text(rig: Rig) -> str:
    """The box in words, such as "x ±250, y ±250, z 150 to 650 mm"."""
    parts = []
    for axis, low, high in zip(
        "xyz", rig.workspace_lower * 1e3, rig.workspace_upper * 1e3, strict=True
    ):
        symmetric = abs(low + high) < 1e-9
        parts.append(f"{axis} ±{high:g}" if symmetric else f"{axis} {low:g} to {high:g}")
    return ", ".join(parts) + " mm"


Ends = Literal["scene", "random"]

_SPACING = 0.010
_CLEARANCE_TOLERANCE = 0.1e-3
_NAN = float("nan")


@dataclass(frozen=True, slots=True)
class Arm:
    """One planner of a comparison."""

    sampler: SamplerName
    cost: CostName = "length"
    readings: AlgorithmVariant = DEFAULT


@dataclass(frozen=True, slots=True)
class Case:
    """Conditions of a search.

    Attributes:
        box: Name of the workspace box (`planner.campaign.trial`).
        environment: Name of the scene.
        ends: Whether start and goal are the scene's, or random ones as far apart.
    """

    box: str
    environment: str
    ends: Ends = "scene"


@dataclass(frozen=True, slots=True)
class Batch:
    """Searches of one arm in one case, for any process on any machine.

    Attributes:
        study: Name of the study.
        case: Box, environment and ends.
        arm: The planner.
        rig: Rig document, JSON, with its own box.
        scene: Scene document, JSON.
        seeds: One search each.
        measured: Whether path and cost are measured, beyond counts.
        clearance: Whether the true smallest clearance is computed too.
        checked: Whether `planner.check.check_path` checks the path.
    """

    study: str
    case: Case
    arm: Arm
    rig: str
    scene: str
    seeds: tuple[int, ...]
    measured: bool = False
    clearance: bool = False
    checked: bool = False


@dataclass(frozen=True, slots=True)
class PathFigures:
    """Measurements of a path; NaN where not requested.

    Attributes:
        raw_length_mm: Before post-processing.
        length_mm: After Algorithm 3.
        raw_cost: Mean kinematic cost along the path before post-processing.
        cost: Mean kinematic cost after Algorithm 3.
        clearance_mm: Smallest distance to an obstacle along the finished path, by
            `model.clearance`.
        passed: 1 where the finished path passed its check, 0 where it did not.
    """

    raw_length_mm: float = _NAN
    length_mm: float = _NAN
    raw_cost: float = _NAN
    cost: float = _NAN
    clearance_mm: float = _NAN
    passed: float = _NAN


@dataclass(frozen=True, slots=True)
class Trial:
    """Result of one search.

    Attributes:
        study: As in its batch.
        case: As in its batch.
        arm: As in its batch.
        seed: Of its random numbers.
        found: Whether there is a path.
        nodes: Nodes of the tree.
        searches: Samples drawn.
        edge_checks: Edges checked by the search.
        time_ms: Processor time of the search.
        path: Measurements of the path.
    """

    study: str
    case: Case
    arm: Arm
    seed: int
    found: bool
    nodes: int
    searches: int
    edge_checks: int
    time_ms: float
    path: PathFigures

    def value(self, quantity: str) -> float:
        """A figure of the trial or of its path, by name."""
        return float(getattr(self.path if hasattr(self.path, quantity) else self, quantity))


def run_batch(batch: Batch) -> list[Trial]:
    """Runs the searches; the same batch gives the same trials anywhere, except for times."""
    planner = _planner(batch.rig, batch.scene, batch.case.box, batch.arm)
    return [_trial(batch, planner, seed) for seed in batch.seeds]


def _trial(batch: Batch, planner: PaperPlanner, seed: int) -> Trial:
    scene = _scene(batch.scene)
    start, goal = scene.start.position, scene.goal.position
    if batch.case.ends == "random":
        distance = float(np.linalg.norm(goal - start))
        start, goal = random_ends(planner, distance, np.random.default_rng([seed, 1]))
    random = np.random.default_rng(seed)
    began = time.process_time()
    result = planner.search(start, goal, random)
    spent = time.process_time() - began
    return Trial(
        study=batch.study,
        case=batch.case,
        arm=batch.arm,
        seed=seed,
        found=result.path is not None,
        nodes=len(result.points),
        searches=result.iterations,
        edge_checks=result.edge_checks,
        time_ms=spent * 1e3,
        path=_measured(batch, planner, scene, result),
    )


def _measured(
    batch: Batch, planner: PaperPlanner, scene: Scene, result: SearchResult
) -> PathFigures:
    if result.path is None or not batch.measured:
        return PathFigures()
    path, cost = planner.shortcut(result.path), _cost(batch.rig, batch.case.box)
    rig, poses = _rig(batch.rig, batch.case.box), [planner.space.pose(point) for point in path]
    clearance = passed = _NAN
    if batch.clearance and scene.obstacles:
        clearance = _clearance(rig, scene, PosePath(rig, poses)) * 1e3
    if batch.checked:
        passed = float(check_path(rig, scene, poses, ends=False).passed)
    return PathFigures(
        raw_length_mm=_length(result.path) * 1e3,
        length_mm=_length(path) * 1e3,
        raw_cost=cost.mean_along(result.path),
        cost=cost.mean_along(path),
        clearance_mm=clearance,
        passed=passed,
    )


def _length(path: Array) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def _clearance(rig: Rig, scene: Scene, path: PosePath) -> float:
    """The smallest distance to an obstacle anywhere along a path, to 0.1 mm, [m]."""
    model = ClearanceModel(rig, scene)

    def evaluate(positions: Array) -> Array:
        nearest = [model.smallest(path.pose(position)) for position in positions.tolist()]
        return np.array([near.distance for near in nearest if near is not None])

    samples = path.samples(_SPACING)
    found = smallest_along(samples, evaluate, lambda motion: motion, -np.inf, _CLEARANCE_TOLERANCE)
    return found.value


@lru_cache(maxsize=64)
def _planner(rig: str, scene: str, box: str, arm: Arm) -> PaperPlanner:
    settings = PlannerSettings(
        sampler=arm.sampler, cost=arm.cost, mode="paper", readings=arm.readings
    )
    the_rig = _rig(rig, box)
    cost = _cost(rig, box) if arm.cost == "kinematic" else None
    exact = _exact(rig, scene, box)
    planner = PaperPlanner(the_rig, _scene(scene), settings, CLEARANCE_RESERVE, cost, exact)
    # The first search loads or compiles machine code; its time belongs to no trial.
    ends = _scene(scene).start.position, _scene(scene).goal.position
    planner.search(*ends, np.random.default_rng(0))
    return planner


@lru_cache(maxsize=16)
def _exact(rig: str, scene: str, box: str) -> ExactChecks:
    return exact_checks(_rig(rig, box), _scene(scene), np.eye(3), CLEARANCE_RESERVE)


@lru_cache(maxsize=16)
def _cost(rig: str, box: str) -> KinematicCost:
    return KinematicCost(_rig(rig, box), np.eye(3))


@lru_cache(maxsize=16)
def _rig(rig: str, box: str) -> Rig:
    return with_box(rig_from_document(RigDocument.model_validate_json(rig)), box)


@lru_cache(maxsize=16)
def _scene(scene: str) -> Scene:
    return scene_from_document(SceneDocument.model_validate_json(scene))
