"""Growth of the time of exact edge checks and planning with the number of obstacles and cables.

    python benchmarks/planner/growth.py -o results

Random edges of 40 mm: on the paper's rig around the pillar of environment 1 and an increasing
number of small boxes; and around the pillar alone on robots whose 6 to 16 cables leave two rings of
outlets. A plan is 30 rounds of the search between the free positions nearest to the scene's start
and goal, the median of five seeds. Written as a table and a plot; the slope is that of the last
half of the log-log curve (1 is linear growth). Last, the capacity margin at one position, by the
planner and by the check, on such robots with up to 24 cables. Processor time of this process.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import ours
from figures import growth_figure
from numpy.typing import NDArray
from rich.progress import track

from model.files.scene_file import SceneDocument
from model.kinematics import structure_matrix
from model.pose import Array, Pose, read_only
from model.rig import Rig, load_rig
from model.scene import Scene, load_scene, scene_from_document
from model.statics.feasibility import capacity_margin
from model.statics.wrench_sets import rms_anchor_radius
from planner.collision.edges import edge_free
from planner.collision.world import build_world
from planner.costs import external_wrenches
from planner.kernels.jit import kernel
from planner.kernels.scene_arrays import World
from planner.wrench.capacity import build_load, margins

CONFIGS = Path(__file__).parents[2] / "configs"
OBSTACLES = (1, 2, 5, 10, 20, 50, 100)
CABLES = (6, 7, 8, 10, 12, 14, 16)
MANY_CABLES = (8, 10, 12, 14, 16, 20, 24)
EDGES = 20000
EDGE = 0.040
ROUNDS = 30
SEEDS = 5
TWIST = 0.3
"""Angle between an outlet and its anchor, [rad]: without it nothing resists rotation about z."""


@dataclass(frozen=True)
class Cost:
    """Processor time in one world, [µs].

    `open_comparisons` are those of cables with each other and the platform that are not proved for
    the whole workspace at once, so that every edge of a plan checks them.
    """

    size: int
    share_free: float
    free_edge_us: float
    any_edge_us: float
    world_us: float
    plan_us: float
    open_comparisons: int


def main() -> None:
    """Measures, prints and writes."""
    options = _options()
    rig = load_rig(CONFIGS / "gachon_8_6.yaml")
    base = load_scene(CONFIGS / "environment_1.yaml")
    random = np.random.default_rng(options.seed)
    show = sys.stderr.isatty()
    by_obstacles = [
        cost(rig, crowded(base, n, random), random, n, options.repeats)
        for n in track(OBSTACLES, "obstacles", disable=not show)
    ]
    by_cables = [
        cost(with_cables(rig, m), base, random, m, options.repeats)
        for m in track(CABLES, "cables", disable=not show)
    ]
    tables = {"obstacles": by_obstacles, "cables": by_cables}
    for name, costs in tables.items():
        print(f"{name}: free edge, any edge, world, plan [µs]; share free; open self comparisons")
        for c in costs:
            print(f"  {c.size:4d}  {c.free_edge_us:8.3f}  {c.any_edge_us:8.3f}"
                  f"  {c.world_us:10.0f}  {c.plan_us:10.0f}  {c.share_free:6.2f}"
                  f"  {c.open_comparisons:4d}")  # fmt: skip
        for what in ("free_edge_us", "any_edge_us", "world_us", "plan_us"):
            print(f"  slope of {what}: {slope(costs, what):.2f}")
    print("capacity margin at one position, by cables: planner [µs], check of a path [ms]")
    for m in track(MANY_CABLES, "margins", disable=not show):
        planner_us, check_ms = margin_times(with_cables(rig, m), base, random, options.repeats)
        print(f"  {m:4d}  {planner_us:8.1f}  {check_ms:8.2f}")
    if options.output:
        write(options.output, tables)


def margin_times(
    rig: Rig, scene: Scene, random: np.random.Generator, repeats: int
) -> tuple[float, float]:
    """Processor time of a capacity margin, the best of some repetitions.

    Returns:
        By the planner's compiled code, [µs], and by the check's, [ms].
    """
    rotation = rig.home.rotation
    world = build_world(rig, scene, rotation, scene.obstacle_clearance)
    load = build_load(rig, scene, rotation)
    points = random.uniform(rig.workspace_lower, rig.workspace_upper, (200, 3))
    wrenches = external_wrenches(rig, scene, rotation)
    length = rms_anchor_radius(rig.anchors)
    matrices = [structure_matrix(rig, Pose(point, rotation)) for point in points[:5]]

    def by_check() -> None:
        for matrix in matrices:
            capacity_margin(matrix, rig.min_tension, rig.max_tension, wrenches, length)

    margins(world, load, points[:1])  # compiles
    fast = _best(lambda: margins(world, load, points), repeats) / len(points)
    return fast * 1e6, _best(by_check, repeats) / len(matrices) * 1e3


def _best(work: Callable[[], object], repeats: int) -> float:
    """Least processor time, [s]."""
    spent = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        spent.append(time.process_time() - begin)
    return min(spent)


def cost(rig: Rig, scene: Scene, random: np.random.Generator, size: int, repeats: int) -> Cost:
    """Measures one world, the best of some repetitions."""

    def build() -> World:
        return build_world(rig, scene, rig.home.rotation, scene.obstacle_clearance)

    built, world = _best(build, repeats), build()
    starts = random.uniform(rig.workspace_lower, rig.workspace_upper, (EDGES, 3))
    directions = random.normal(size=(EDGES, 3))
    ends = starts + EDGE * directions / np.linalg.norm(directions, axis=1)[:, None]
    ends = np.clip(ends, rig.workspace_lower, rig.workspace_upper)
    free = _edges_free(world, starts, ends)
    some = np.flatnonzero(free)
    chosen = np.resize(some, EDGES) if len(some) else np.zeros(0, dtype=np.int64)
    free_edge = _time(world, starts[chosen], ends[chosen], repeats)
    any_edge = _time(world, starts, ends, repeats)
    ends = [_nearest(starts[some], pose.position) for pose in (scene.start, scene.goal)]
    level = [Pose(position, rig.home.rotation) for position in ends]
    contestant = ours.Contestant(rig, scene.changed(start=level[0], goal=level[1]))
    plan = float(np.median([contestant.rounds_us(ROUNDS, seed) for seed in range(SEEDS)]))
    return Cost(size, float(free.mean()), free_edge, any_edge, built * 1e6, plan,
                contestant.open_comparisons)  # fmt: skip


@kernel
def _edges_free(world: World, starts: Array, ends: Array) -> NDArray[np.bool_]:
    """Whether edges, shape (k, 3) each, [m], are free; compiled, so that no call is timed."""
    free = np.empty(len(starts), dtype=np.bool_)
    for i in range(len(starts)):
        free[i] = edge_free(world, starts[i], ends[i])
    return free


def _nearest(points: Array, wanted: Array) -> Array:
    nearest: Array = points[np.argmin(np.linalg.norm(points - wanted, axis=1))]
    return nearest


def _time(world: World, starts: Array, ends: Array, repeats: int) -> float:
    """Processor time of one edge, [µs]."""
    if not len(starts):
        return float("nan")
    return _best(lambda: _edges_free(world, starts, ends), repeats) / len(starts) * 1e6


def crowded(base: Scene, count: int, random: np.random.Generator) -> Scene:
    """The base scene with small boxes added near the floor, where cables hardly pass."""
    document = base.document.model_dump(mode="json", exclude_none=True)
    for number in range(1, count):
        angle = random.uniform(0.0, 2.0 * np.pi)
        size = random.uniform(20.0, 60.0, 3)
        position = [430.0 * np.cos(angle), 430.0 * np.sin(angle), random.uniform(40.0, 120.0)]
        box = {"name": f"box {number}", "box": {"size_mm": size.tolist()}, "position_mm": position}
        document["obstacles"].append(box)
    return scene_from_document(SceneDocument.model_validate(document))


def with_cables(rig: Rig, count: int) -> Rig:
    """The rig with ``count`` cables: upper ring to low anchors, lower ring to high ones."""
    upper = np.arange(count) % 2 == 0
    angle = 2.0 * np.pi * (np.arange(count) + 0.25) / count
    rotated = angle + np.where(np.arange(count) // 2 % 2 == 0, TWIST, -TWIST)
    around, near = (np.column_stack([np.cos(a), np.sin(a)]) for a in (angle, rotated))
    side = np.max(np.abs(near), axis=1)[:, None]
    height = float(rig.half_size[2])
    anchors = np.column_stack([near / side * rig.half_size[:2], np.where(upper, -height, height)])
    outlets = np.column_stack([0.7 * around, np.where(upper, 0.86, 0.08)])
    feeds = np.tile([0.0, 0.0, 1.0], (count, 1))
    return replace(
        rig,
        outlets=read_only(outlets),
        anchors=read_only(anchors),
        feed_directions=read_only(feeds),
    )


def slope(costs: Sequence[Cost], what: str) -> float:
    """Growth between the middle and the largest size: 1 is linear, 2 is quadratic."""
    middle, last = costs[len(costs) // 2], costs[-1]
    values = [getattr(c, what) for c in (middle, last)]
    return float(np.log(values[1] / values[0]) / np.log(last.size / middle.size))


def write(folder: Path, tables: dict[str, list[Cost]]) -> None:
    """Tables and plot as files."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, costs in tables.items():
        with (folder / f"growth_{name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            columns = [entry.name for entry in fields(Cost)][1:]
            writer.writerow([name, *columns])
            writer.writerows([c.size, *(getattr(c, key) for key in columns)] for c in costs)
    labels = {
        "free edge": "free_edge_us",
        "any edge": "any_edge_us",
        "making the world": "world_us",
        f"{ROUNDS} rounds of planning": "plan_us",
    }
    panels = [
        (
            f"exact edges, more {name}",
            f"number of {name}",
            {text: [(c.size, getattr(c, key)) for c in costs if np.isfinite(getattr(c, key))]
             for text, key in labels.items()},
        )
        for name, costs in tables.items()
    ]  # fmt: skip
    figure = growth_figure(panels)
    for ending in ("png", "svg"):
        figure.savefig(folder / f"growth.{ending}", dpi=150)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--repeats", type=int, default=5, help="of each measurement; best counts")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path, help="folder for table and plot")
    return parser.parse_args()


if __name__ == "__main__":
    main()
