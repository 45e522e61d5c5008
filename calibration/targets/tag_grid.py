"""Grids of tags: their corners, in an image that may show a part only."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calibration.targets.board import LEAST_POINTS, Seen, plain_camera, require_board
from model.files.rig_file import FAMILIES, tags_in
from model.pose import Array
from tracking.camera_model import Image
from tracking.detection.detector import TagDetector
from tracking.detection.diagnostics import what_else_is_seen
from tracking.detection.tags import CORNER_SIGNS, modules_across
from tracking.edges.refine import refine


@dataclass(frozen=True)
class TagGrid:
    """A grid of AprilTags, numbered row after row from the top left; parts of it will do.

    Attributes:
        columns: Tags along a row.
        rows: Tags along a column.
        tag: Side of a tag's black square, [m].
        gap: Between neighbouring black squares, [m].
        family: One of `model.files.rig_file.FAMILIES`.
        first: Number of the tag at the top left.
    """

    columns: int
    rows: int
    tag: float
    gap: float
    family: str
    first: int = 0

    def __post_init__(self) -> None:
        """Refuses boards that cannot be.

        Raises:
            BadInput: Too few tags, sizes that are none, an unknown family, or numbers that it
                does not have.
        """
        require_board(self.columns * self.rows >= 4, "a tag grid needs 4 tags")
        require_board(min(self.columns, self.rows) >= 1, "a tag grid needs a row and a column")
        require_board(self.tag > 0.0, "the side of a tag must be above 0 mm")
        require_board(self.gap > 0.0, "the gap between tags must be above 0 mm")
        require_board(
            self.family in FAMILIES,
            f"unknown tag family {self.family!r}",
            f"use one of {', '.join(FAMILIES)}",
        )
        last = self.first + self.columns * self.rows - 1
        require_board(
            self.first >= 0 and last < tags_in(self.family),
            f"{self.family} has the tags 0 to {tags_in(self.family) - 1}; the grid needs"
            f" {self.first} to {last}",
            "choose a smaller first number, fewer tags or a larger family",
        )

    def __str__(self) -> str:
        """Its kind, size and numbers."""
        last = self.first + self.columns * self.rows - 1
        return f"a grid of {self.columns} x {self.rows} tags, {self.family} {self.first} to {last}"

    def find(self, image: Image) -> Seen | None:
        """The corners of its tags, as far as these are to be seen whole."""
        detected = [
            d
            for d in self._detector.detect_all(image)
            if 0 <= d.id - self.first < self.columns * self.rows
        ]
        counts = Counter(d.id for d in detected)
        detected = [d for d in detected if counts[d.id] == 1]
        rough = np.array([d.corners for d in detected]).reshape(-1, 4, 2)
        # An edge is short: its bend by the lens does not count.
        lens = plain_camera((image.shape[1], image.shape[0]))
        squares = refine(image, lens, rough, modules_across(self.family))
        whole = [(d.id, s) for d, s in zip(detected, squares, strict=True) if s and s.whole]
        if 4 * len(whole) < LEAST_POINTS:
            return None
        points = np.concatenate([self._corners_of(number) for number, _ in whole])
        twice = tuple(number for number, count in counts.items() if count > 1)
        return Seen(points, np.concatenate([square.corners for _, square in whole]), twice)

    def instead(self, image: Image) -> str:
        """Tags that the image shows."""
        return what_else_is_seen(image, self.family, [])

    def _corners_of(self, number: int) -> Array:
        """Corners of a tag in the board's plane, y down the rows, shape (4, 3), [m]."""
        row, column = divmod(number - self.first, self.columns)
        step, middle = self.tag + self.gap, self.tag / 2.0
        flat = CORNER_SIGNS * [middle, -middle] + [column * step + middle, row * step + middle]
        return np.column_stack([flat, np.zeros(4)])

    @cached_property
    def _detector(self) -> TagDetector:
        return TagDetector(self.family)
