"""Maps over a grid, computed in parts on any number of processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.errors import BadInput
from model.kinematics import axis_distances
from model.pages.page import html_table
from model.pose import Array
from model.progress import SILENT, Listener
from model.rig import Rig
from planner.check import least_axis_distance
from planner.kernels.jit import planner_compilation
from planner.parallel import Count, default_workers, worker_pool
from planner.workspace.grid import Grid, frame_box, slice_through
from planner.workspace.grid import volume as grid_of_volume
from planner.workspace.maps import OBSTACLE_CLEARANCE, Extremes, Question, Values, costs, values_at

POINTS_IN_A_PART = 4096
VERDICTS = (
    "allowed",
    "not wrench feasible",
    "self clearance too small",
    "obstacle clearance too small",
    "too close to a pulley's axis",
)
Progress = Callable[[int], None]


@dataclass(frozen=True, slots=True, eq=False)
class Maps:
    """Values of quantities over a grid.

    Attributes:
        question: Rig, scene, orientation and quantities.
        grid: Positions.
        values: By name, each in the shape of the grid, SI: the quantities requested, and the
            costs (`planner.workspace.maps.costs`).
    """

    question: Question
    grid: Grid
    values: Values

    def __repr__(self) -> str:
        """Name of the grid, number of points, and names of the values."""
        return f"<Maps {self.grid.name}: {self.grid.count} points of {', '.join(self.values)}>"

    def _repr_html_(self) -> str:
        """For notebooks: the share of allowed points, and the finite range of each value."""
        rows = [("points", f"{self.grid.count}, {np.mean(self.verdict == 0) * 100:.1f} % allowed")]
        for name, values in self.values.items():
            known = values[np.isfinite(values)]
            ends = f"{known.min():.5g} to {known.max():.5g}" if known.size else "–"
            rows.append((name.replace("_", " "), ends))
        return html_table(f"Workspace of {self.question.rig.name}: {self.grid.name}", rows)

    @property
    def closed(self) -> NDArray[np.bool_]:
        """Where the cables can balance any wrench."""
        return np.asarray(self.values["closure_margin"] > 0.0)

    @property
    def feasible(self) -> NDArray[np.bool_]:
        """Where the tension limits suffice for weight, every payload and disturbances."""
        return np.asarray(self.values["capacity_margin"] >= 0.0)

    @property
    def collision_free(self) -> NDArray[np.bool_]:
        """Where the scene's clearances are kept; without a scene, where nothing touches."""
        scene = self.question.scene
        own, to_obstacles = 0.0, 0.0
        if scene is not None:
            own, to_obstacles = scene.self_clearance, scene.obstacle_clearance
        free = self.values["self_clearance"] >= own
        if OBSTACLE_CLEARANCE in self.values:
            free &= self.values[OBSTACLE_CLEARANCE] >= to_obstacles
        return np.asarray(free)

    @property
    def verdict(self) -> NDArray[np.int64]:
        """Index in `VERDICTS` of what forbids a pose first; 0 where nothing does.

        As for a plan, wrench closure is not required: suspended robots have none.
        """
        scene = self.question.scene
        own = self.values["self_clearance"] >= (scene.self_clearance if scene else 0.0)
        tests = [self.feasible, own, self.collision_free, self._off_pulley_axes()]
        return np.asarray(np.select([~test for test in tests], range(1, len(tests) + 1), 0))

    def _off_pulley_axes(self) -> NDArray[np.bool_]:
        """Where every anchor is as far from its pulley's swivel axis as a check requires."""
        rig, grid = self.question.rig, self.grid
        least = least_axis_distance(rig)
        if least == 0.0:
            return np.ones(grid.shape, dtype=np.bool_)
        arms = rig.anchors @ self.question.rotation.T
        parts = [grid.points(k, min(k + POINTS_IN_A_PART, grid.count)) for k in _starts(grid)]
        reach = [axis_distances(rig, arms + part[:, None, :]).min(axis=1) for part in parts]
        return np.asarray(np.concatenate(reach).reshape(grid.shape) >= least)


def compute(
    question: Question,
    extremes: Extremes,
    grid: Grid,
    *,
    pool: Executor | None = None,
    progress: Progress = lambda _: None,
) -> Maps:
    """Computes maps.

    Args:
        question: Rig, scene, orientation and quantities.
        pool: Other processes or machines; None for this process. The values do not depend on it.
        progress: Called with the number of points just finished.
    """
    bounds = [(k, min(k + POINTS_IN_A_PART, grid.count)) for k in _starts(grid)]
    values = {name: np.empty(grid.count) for name in question.quantities}
    for (first, last), part in _parts(question, grid, bounds, pool):
        for name, found in part.items():
            values[name][first:last] = found
        progress(last - first)
    shaped = {name: array.reshape(grid.shape) for name, array in values.items()}
    return Maps(question, grid, shaped | costs(shaped, extremes))


def _starts(grid: Grid) -> range:
    return range(0, grid.count, POINTS_IN_A_PART)


def _parts(
    question: Question, grid: Grid, bounds: list[tuple[int, int]], pool: Executor | None
) -> Iterator[tuple[tuple[int, int], Values]]:
    if pool is None or len(bounds) == 1:
        for part in bounds:
            yield part, values_at(question, grid.points(*part))
        return
    tasks = {pool.submit(_part, question, grid, *part): part for part in bounds}
    try:
        for done in as_completed(tasks):
            yield tasks[done], done.result()
    finally:
        for task in tasks:
            task.cancel()


def _part(question: Question, grid: Grid, first: int, last: int) -> Values:
    return values_at(question, grid.points(first, last))


# Maps of a whole workspace.

CELLS_OF_A_SLICE = 50
CELLS_OF_THE_FRAME = 40
POINTS_FOR_ONE_PROCESS = 20000
"""Fewer points are finished before other processes would have started."""


def workspace_grids(
    rig: Rig,
    slices: Sequence[tuple[int, float]] = (),
    *,
    volume: bool | None = None,
    step: float | None = None,
    lower: Array | None = None,
    upper: Array | None = None,
) -> list[Grid]:
    """Grids of slices, and of the volume: the frame around it and the region itself.

    Args:
        slices: Axis (0 to 2) and position [m] of planes; the one at home's height when left out.
        volume: Whether the whole box is mapped too; when left out, only without slices.
        step: Distance of points, [m]; a fiftieth of the longest side when left out.
        lower: Corner of the region, shape (3,), [m]; that of the rig's workspace when left out.

    Raises:
        BadInput: A plane is outside the region, or there are too many points.
    """
    lower = rig.workspace_lower if lower is None else lower
    upper = rig.workspace_upper if upper is None else upper
    if not np.all(lower < upper):
        low, high = (
            f"({', '.join(f'{x * 1e3:g}' for x in corner)}) mm" for corner in (lower, upper)
        )
        raise BadInput(f"the region has no extent from {low} to {high}")
    step = float(np.max(upper - lower)) / CELLS_OF_A_SLICE if step is None else step
    wanted = list(slices)
    if not wanted:
        wanted = [(2, float(np.clip(rig.home.position[2], lower[2], upper[2])))]
    grids = [slice_through(axis, value, lower, upper, step) for axis, value in wanted]
    if volume or (volume is None and not slices):
        around = frame_box(rig)
        coarse = float(np.max(around[1] - around[0])) / CELLS_OF_THE_FRAME
        grids.append(grid_of_volume("frame", *around, coarse))
        grids.append(grid_of_volume("workspace", lower, upper, step))
    return grids


def map_workspace(
    question: Question,
    grids: Sequence[Grid],
    *,
    workers: int | None = None,
    dask: str | None = None,
    listener: Listener = SILENT,
) -> list[Maps]:
    """Workspace maps of a rig; `planner.workspace.files.write_maps` writes them.

    Args:
        question: Rig, scene, orientation and quantities.
        grids: Positions, see `workspace_grids`.
        workers: Processes; one per core when left out, in a child process one.
        dask: Address of a Dask cluster to use instead.

    Raises:
        BadInput: Dask is not installed, no scheduler answers, or no process can be started.
    """
    with planner_compilation("maps", listener):
        extremes = Extremes.over_workspace(question)
        # Compiles once, or every process would.
        values_at(question, question.rig.home.position[None, :])
    total = sum(grid.count for grid in grids)
    usual = 1 if total <= POINTS_FOR_ONE_PROCESS else default_workers()
    with (
        worker_pool(workers or usual, dask) as pool,
        listener.progress("mapping", total) as advance,
    ):
        done = Count(advance)
        return [compute(question, extremes, grid, pool=pool, progress=done.more) for grid in grids]
