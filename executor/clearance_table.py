"""How far cables and platform stayed from the obstacles during a run."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from cdpr.poses import Array
from executor.run_csv import TableFile, numbers, texts, write_table

_MM = 1e3


def source_of(camera: str) -> str:
    """The source of what one of several cameras measured alone."""
    return f"tag:{camera}"


def camera_of(source: str) -> str:
    """The camera that a source is of alone; nothing for all cameras and for the drives."""
    return source.partition(":")[2]


@dataclass(frozen=True, slots=True, eq=False)
class ClearanceTable:
    """Distances at n poses to each of k obstacles; no rows for a scene without obstacles.

    Attributes:
        time: Since the start of the run, shape (n,), [s].
        source: Where each pose came from, n texts: ``tag`` (all cameras), ``encoder``, or one of
            several cameras alone (`source_of`).
        distance: Smallest distance, shape (n,), [m].
        uncertainty: How much less than that the smallest true one may be, shape (n,), [m].
        at_most: The smallest true one is no more than this, shape (n,), [m].
        body: Which part of the robot is nearest, n texts.
        obstacle: Which obstacle it is nearest to, n texts.
        planned_distance: Smallest distance of the planned pose at that time, shape (n,), [m].
        obstacles: Names of the scene's obstacles, k texts.
        distances: To each obstacle, shape (n, k), [m].
        planned_distances: Of the planned pose to each obstacle, shape (n, k), [m].
    """

    time: Array
    source: tuple[str, ...]
    distance: Array
    uncertainty: Array
    at_most: Array
    body: tuple[str, ...]
    obstacle: tuple[str, ...]
    planned_distance: Array
    obstacles: tuple[str, ...]
    distances: Array
    planned_distances: Array

    def __post_init__(self) -> None:
        """Refuses arrays of different sizes.

        Raises:
            ValueError: Naming the attribute.
        """
        rows, count = len(self.time), len(self.obstacles)
        for field in fields(self):
            if field.name != "obstacles" and len(getattr(self, field.name)) != rows:
                raise ValueError(f"{field.name} does not have {rows} rows, as time has")
        for name in ("distances", "planned_distances"):
            if getattr(self, name).shape != (rows, count):
                raise ValueError(f"{name} must have shape ({rows}, {count})")

    def __len__(self) -> int:
        return len(self.time)

    def of(self, source: str) -> ClearanceTable:
        """The rows of one source."""
        rows = np.array([name == source for name in self.source], dtype=bool)
        chosen = np.flatnonzero(rows)
        return ClearanceTable(
            time=self.time[rows],
            source=tuple(self.source[i] for i in chosen),
            distance=self.distance[rows],
            uncertainty=self.uncertainty[rows],
            at_most=self.at_most[rows],
            body=tuple(self.body[i] for i in chosen),
            obstacle=tuple(self.obstacle[i] for i in chosen),
            planned_distance=self.planned_distance[rows],
            obstacles=self.obstacles,
            distances=self.distances[rows],
            planned_distances=self.planned_distances[rows],
        )

    def write_csv(self, path: Path) -> None:
        """Writes ``clearance.csv``.

        Raises:
            BadInput: The folder cannot be written to.
        """
        columns = [
            numbers("time_s", self.time),
            texts("source", self.source),
            numbers("distance_mm", self.distance, _MM),
            numbers("uncertainty_mm", self.uncertainty, _MM),
            numbers("at_most_mm", self.at_most, _MM),
            texts("body", self.body),
            texts("obstacle", self.obstacle),
            numbers("planned_distance_mm", self.planned_distance, _MM),
        ]
        for i, name in enumerate(self.obstacles):
            columns.append(numbers(f"{name}_mm", self.distances[:, i], _MM))
            columns.append(numbers(f"planned_{name}_mm", self.planned_distances[:, i], _MM))
        write_table(path, columns)

    @classmethod
    def read_csv(cls, path: Path) -> ClearanceTable:
        """Reads ``clearance.csv``.

        Raises:
            BadInput: The file is missing, cut short or has other columns.
        """
        table = TableFile(path)
        # By place, not by name: one obstacle may be called "x" and another "planned_x".
        own = range(8, len(table.names), 2)
        return cls(
            time=table.floats("time_s"),
            source=table.texts("source"),
            distance=table.floats("distance_mm", _MM),
            uncertainty=table.floats("uncertainty_mm", _MM),
            at_most=table.floats("at_most_mm", _MM),
            body=table.texts("body"),
            obstacle=table.texts("obstacle"),
            planned_distance=table.floats("planned_distance_mm", _MM),
            obstacles=tuple(table.names[i].removesuffix("_mm") for i in own),
            distances=table.matrix_at(own, _MM),
            planned_distances=table.matrix_at(range(9, len(table.names), 2), _MM),
        )


def no_clearance(obstacles: tuple[str, ...] = ()) -> ClearanceTable:
    """A table without rows."""
    nothing, nowhere = np.empty(0), np.empty((0, len(obstacles)))
    return ClearanceTable(
        nothing, (), nothing, nothing, nothing, (), (), nothing, obstacles, nowhere, nowhere
    )
