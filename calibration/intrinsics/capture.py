"""Which images to take of a board that is moved before a live camera, and what is still missing.

An image is taken when the board stands still and shows something new: a part of the image or a
tilt that no image shows yet, or a place far from all others.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product

import cv2
import numpy as np

from calibration.targets.board import Board, Seen, plain_camera
from model.pose import Array
from tracking.camera_model import Image

STILL_PX = 0.7
"""RMS motion of the corners from one image to the next, for images of 1000 px."""
ENOUGH_TILT = 18.0
"""Degrees to each side that must be seen."""
_FAR, _FAR_TILT = 0.12, 12.0
"""It is new at this distance from all others, as share of the image width, or rotation [deg]."""
_PARTS = (("left", "middle", "right"), ("top", "middle", "bottom"))
_AWAY = ("lower", "upper", "right", "left")
"""Edges of the board, as seen in the image, that are away from the camera by tilt: − and + about
the image's x axis, then about its y axis."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A board as it was seen.

    Attributes:
        seen: Its corners.
        middle: Mean of the corners, shape (2,), [px].
        tilt: Roughly, of the board's normal, away from the camera, towards the image's y and x
            axes, shape (2,), [deg].
        parts: Parts of the image that it covers, (column, row) of 3 x 3.
    """

    seen: Seen
    middle: Array
    tilt: Array
    parts: frozenset[tuple[int, int]]


@dataclass(frozen=True, slots=True)
class Advice:
    """What to do next.

    Attributes:
        taken: Whether this image is to be kept.
        text: One sentence for the person who moves the board.
        done: Whether enough was taken.
    """

    taken: bool
    text: str
    done: bool


@dataclass(slots=True)
class CaptureGuide:
    """Judges one image after the other.

    Attributes:
        board: What is shown.
        wanted: How many images at least.
        views: Those that were taken.
    """

    board: Board
    wanted: int
    views: list[View] = field(default_factory=list)
    _last: Seen | None = None

    def look(self, image: Image) -> Advice:
        """Judges the next image.

        Args:
            image: Grey, all of one size.
        """
        before, self._last = self._last, self.board.find(image)
        if self._last is None:
            return self._advice(False, "show the board")
        size = (image.shape[1], image.shape[0])
        if before is None or not _still(before, self._last, size):
            return self._advice(False, "hold it still")
        view = _view(self._last, size)
        if not self._is_new(view, size):
            return self._advice(False, self.missing() or "move it to another position and tilt it")
        self.views.append(view)
        return self._advice(True, self.missing() or "move it to another position and tilt it")

    def drawn(self) -> str:
        """What images show so far, in plain characters, as a terminal far away shows it too.

        Parts of the image with the board are ``#``, others ``.``; beside them the tilts that were
        seen: the edge of the board that was away.
        """
        covered = {part for view in self.views for part in view.parts}
        rows = [" ".join("#" if (x, y) in covered else "." for x in range(3)) for y in range(3)]
        tilts = [name if self._is_tilted(k) else "-" for k, name in enumerate(_AWAY)]
        upper, lower, left, right = tilts[1], tilts[0], tilts[3], tilts[2]
        beside = (f"edges away: {upper}", f"            {left} {right}", f"            {lower}")
        return "\n".join(f"  {row}   {text}" for row, text in zip(rows, beside, strict=True))

    def _is_tilted(self, which: int) -> bool:
        """Whether an image shows the edge of `_AWAY` away from the camera."""
        axis, sign = which // 2, (-1.0, 1.0)[which % 2]
        return any(sign * view.tilt[axis] > ENOUGH_TILT for view in self.views)

    def missing(self) -> str:
        """The first thing that no image shows yet; empty when all is there."""
        covered = {part for view in self.views for part in view.parts}
        for part in sorted(product(range(3), range(3)), key=lambda p: (p == (1, 1), p[1], p[0])):
            if part not in covered:
                return f"bring the board to the {_name(part)} of the image"
        for which, name in enumerate(_AWAY):
            if not self._is_tilted(which):
                return f"tilt the board by 20° to 40°, its {name} edge away from the camera"
        return ""

    def _is_new(self, view: View, size: tuple[int, int]) -> bool:
        covered = {part for other in self.views for part in other.parts}
        if view.parts - covered:
            return True
        return all(
            np.linalg.norm(view.middle - other.middle) > _FAR * size[0]
            or np.abs(view.tilt - other.tilt).max() > _FAR_TILT
            for other in self.views
        )

    def _advice(self, taken: bool, text: str) -> Advice:
        done = len(self.views) >= self.wanted and not self.missing()
        count = f"{len(self.views)} of {self.wanted} images"
        return Advice(taken, f"{count}: {'enough' if done else text}", done)


def _name(part: tuple[int, int]) -> str:
    """Such as ``top left``, ``left`` or ``middle``."""
    column, row = _PARTS[0][part[0]], _PARTS[1][part[1]]
    words = [word for word in (row, column) if word != "middle"]
    return " ".join(words) or "middle"


def _still(before: Seen, now: Seen, size: tuple[int, int]) -> bool:
    """Whether corners that both images show have not moved."""
    earlier = {tuple(p): c for p, c in zip(before.points.tolist(), before.corners, strict=True)}
    pairs = [
        corner - earlier[tuple(point)]
        for point, corner in zip(now.points.tolist(), now.corners, strict=True)
        if tuple(point) in earlier
    ]
    if len(pairs) < len(now.points) / 2:
        return False
    motion = float(np.sqrt(np.mean(np.sum(np.square(pairs), axis=1))))
    return motion < STILL_PX * size[0] / 1000.0


def _view(seen: Seen, size: tuple[int, int]) -> View:
    cells = np.clip((seen.corners / size * 3.0).astype(int), 0, 2)
    return View(
        seen,
        np.asarray(seen.corners.mean(axis=0)),
        _tilt(seen, size),
        frozenset((int(column), int(row)) for column, row in cells),
    )


def _tilt(seen: Seen, size: tuple[int, int]) -> Array:
    """Tilt by a camera as most are: it need not be known well, shape (2,), [deg]."""
    camera = plain_camera(size)
    _, turn, _ = cv2.solvePnP(seen.points, seen.corners, camera.matrix, camera.distortion)
    normal = cv2.Rodrigues(turn)[0][:, 2]
    normal = normal * (-1.0 if normal[2] < 0.0 else 1.0)
    return np.asarray(np.degrees(np.arctan2(normal[[1, 0]], normal[2])), dtype=np.float64)
