"""Time of proofs of rotating moves, and quality of paths after a time.

    python -m benchmarks.planner.turning [--seeds 10]

Times are processor time, so that other programs count less.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from model.files.scene_file import SceneDocument
from model.pose import Array
from model.rig import Rig, load_rig
from model.scene import Scene, load_scene, scene_from_document
from planner.anytime_6d.path import RotatingSearch, rotating_problem
from planner.anytime_6d.problem import (
    RotatingProblem,
    matrix_of,
    move_allowed,
    put_rotated,
    rotation_between,
)
from planner.collision.rotating_edges import rotating_edge_free
from planner.collision.world import self_rotating_edge_free
from planner.costs import KinematicCost
from planner.settings import OBJECTIVES
from planner.space import PoseSpace
from planner.wrench.rotation import rotating_edge_held

CONFIGS = Path(__file__).parents[2] / "configs"
DISTANCE, ANGLE = 0.040, np.radians(2.0)
MARKS = (0.050, 0.500)
REPEATS = 20


def hall() -> tuple[Rig, Scene]:
    """The hall with a goal that is tilted and rotated."""
    document = load_scene(CONFIGS / "hall_pillar.yaml").document.model_dump()
    tilt = [float(np.cos(0.05)), 0.0, float(np.sin(0.05)), 0.0]
    document["goal"]["rotation_wxyz"] = tilt
    document["rotation_limits"] = {"tilt_deg": 8.0, "turn_deg": 4.0}
    scene = scene_from_document(SceneDocument.model_validate(document))
    return load_rig(CONFIGS / "hall_10_6.yaml"), scene


def allowed_moves(problem: RotatingProblem, count: int) -> list[tuple[Array, Array]]:
    """Random moves of `DISTANCE` and `ANGLE` that keep all limits."""
    random, found = np.random.default_rng(0), []
    limits, tallies = problem.world.limits, np.zeros(6, dtype=np.int64)
    while len(found) < count:
        start, end = np.zeros(7), np.zeros(7)
        start[:3], start[3] = random.uniform(*limits), 1.0
        tip, heading, turn = random.normal(size=(3, 3))
        tip *= 0.5 * problem.tilt / np.linalg.norm(tip)
        put_rotated(start.copy(), (tip[0], tip[1], 0.0), start)
        end[:3] = start[:3] + DISTANCE * heading / np.linalg.norm(heading)
        turn *= ANGLE / np.linalg.norm(turn)
        put_rotated(start, (turn[0], turn[1], turn[2]), end)
        if move_allowed(problem, start, end, tallies):
            found.append((start, end))
    return found


def microseconds(check: Callable[[int], object], count: int) -> float:
    """Processor time of a check, [µs]."""
    check(0)
    began = time.process_time()
    for _ in range(REPEATS):
        for k in range(count):
            check(k)
    return (time.process_time() - began) / (REPEATS * count) * 1e6


def edges(problem: RotatingProblem) -> None:
    """Prints the times of the parts of the proof of one allowed move."""
    moves = allowed_moves(problem, 60)
    given = [
        (a[:3], b[:3], matrix_of(a), np.array(rotation_between(a, b))) for a, b in moves
    ]  # what each check reads
    tallies = np.zeros(6, dtype=np.int64)
    world, robot, load, reserve = problem.world, problem.robot, problem.load, problem.reserve
    parts: dict[str, Callable[[int], object]] = {
        "obstacles": lambda k: rotating_edge_free(world, *given[k]),
        "self": lambda k: self_rotating_edge_free(world, robot, *given[k]),
        "wrenches": lambda k: rotating_edge_held(world, load, reserve, *given[k]),
        "all": lambda k: move_allowed(problem, *moves[k], tallies),
    }
    times = ", ".join(f"{name} {microseconds(f, len(moves)):.1f}" for name, f in parts.items())
    move = f"{DISTANCE * 1e3:g} mm and {np.degrees(ANGLE):g} deg"
    print(f"  µs for an allowed move of {move}: {times}")


def searches(rig: Rig, scene: Scene, problem: RotatingProblem, seeds: int) -> None:
    """Prints the time to the first path, and the lengths reached."""
    space = PoseSpace(rig)
    ends = space.coordinates(scene.start), space.coordinates(scene.goal)
    RotatingSearch(problem, *ends, 0).advance()
    firsts, lengths = [], []
    for seed in range(seeds):
        search, began, first = RotatingSearch(problem, *ends, seed), time.process_time(), 0.0
        reached = []
        for mark in MARKS:
            while time.process_time() - began < mark:
                search.advance()
                if not first and search.path is not None:
                    first = time.process_time() - began
            reached.append(search.cost * 1e3)
        firsts.append(first * 1e3)
        lengths.append(reached)
    low, middle, high = np.quantile(firsts, (0.0, 0.5, 1.0))
    print(f"  first path, with one polishing round: median {middle:.1f} ms, {low:.1f}–{high:.1f}")
    for mark, column in zip(MARKS, np.array(lengths).T, strict=True):
        print(
            f"  after {mark * 1e3:g} ms: median {np.median(column):.1f} mm,"
            f" best {column.min():.1f}, worst {column.max():.1f}"
        )


def main() -> None:
    """Prints the table for two scenes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    seeds = parser.parse_args().seeds
    ready = load_rig(CONFIGS / "gachon_8_6.yaml"), load_scene(CONFIGS / "turn.yaml")
    for rig, scene in (ready, hall()):
        print(f"{rig.name}, {scene.name}")
        kinematic = KinematicCost(rig, scene.start.rotation)
        problem = rotating_problem(rig, scene, OBJECTIVES["length"], kinematic)
        edges(problem)
        searches(rig, scene, problem, seeds)


if __name__ == "__main__":
    main()
