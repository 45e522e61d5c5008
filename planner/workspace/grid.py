"""Where maps are computed: regular grids over a box, or over one plane of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cdpr.errors import BadInput
from cdpr.poses import Array, read_only
from cdpr.rig import Rig

AXES = "xyz"
MOST_POINTS = 20_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Positions of the platform's origin, world frame.

    Attributes:
        name: For files and titles, such as ``slice_z_445``.
        axes: Coordinates along x, y and z, increasing, [m].
        normal: For a slice, the number of the axis it is perpendicular to; None for a volume.
    """

    name: str
    axes: tuple[Array, Array, Array]
    normal: int | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of points along each axis."""
        x, y, z = (len(axis) for axis in self.axes)
        return x, y, z

    @property
    def count(self) -> int:
        """Number of points."""
        return int(np.prod(self.shape))

    def points(self, first: int, last: int) -> Array:
        """The points numbered from ``first`` to ``last - 1``, z fastest; shape (k, 3), [m]."""
        index = np.unravel_index(np.arange(first, last), self.shape)
        return np.stack([a[i] for a, i in zip(self.axes, index, strict=True)], axis=-1)


def volume(name: str, lower: Array, upper: Array, step: float) -> Grid:
    """A grid over a box, both ends of every side included.

    Args:
        name: Of the grid.
        lower: Corner, world frame, shape (3,), [m].
        upper: Opposite corner.
        step: Largest distance between neighbours along an axis, [m].

    Raises:
        BadInput: The step is not positive, or so small that no computer would finish.
    """
    x, y, z = (_axis(low, high, step) for low, high in zip(lower, upper, strict=True))
    return _of_bearable_size(Grid(name, (x, y, z)), step)


def slice_through(axis: int, value: float, lower: Array, upper: Array, step: float) -> Grid:
    """A grid over the plane of a box where a coordinate has a value [m].

    Raises:
        BadInput: As for `volume`, or the plane does not meet the box.
    """
    letter = AXES[axis]
    if not lower[axis] - 1e-9 <= value <= upper[axis] + 1e-9:
        low, high = lower[axis] * 1e3, upper[axis] * 1e3
        raise BadInput(
            f"the slice {letter}={value * 1e3:g} is outside the region"
            f" ({letter} from {low:g} to {high:g} mm)",
            next_step=f"choose a value between {low:g} and {high:g}",
        )
    sides = [_axis(low, high, step) for low, high in zip(lower, upper, strict=True)]
    sides[axis] = read_only([value])
    name = f"slice_{letter}_{value * 1e3:g}".replace("-", "minus_")
    return _of_bearable_size(Grid(name, (sides[0], sides[1], sides[2]), normal=axis), step)


def parsed_slice(text: str) -> tuple[int, float]:
    """Number of the axis and the value [m] of a slice such as ``z=445`` (mm).

    Raises:
        BadInput: The text is not of that form.
    """
    letter, _, number = text.partition("=")
    try:
        value = float(number)
    except ValueError:
        value = np.nan
    if letter.strip() not in tuple(AXES) or not np.isfinite(value):
        raise BadInput(
            f"{text!r} is not a slice",
            next_step="write the axis and its value in mm, such as --slice z=445",
        )
    return AXES.index(letter.strip()), value / 1000.0


def frame_box(rig: Rig) -> tuple[Array, Array]:
    """Corners of the smallest upright box that holds all outlets and the workspace box, [m]."""
    corners = np.vstack([rig.outlets, rig.workspace_lower, rig.workspace_upper])
    return corners.min(axis=0), corners.max(axis=0)


def _axis(low: float, high: float, step: float) -> Array:
    if not 0.0 < step < np.inf:
        raise BadInput(f"the step must be above 0 mm, it is {step * 1e3:g} mm")
    if not low < high:
        raise BadInput(f"the region has no extent from {low * 1e3:g} to {high * 1e3:g} mm")
    cells = (high - low) / step - 1e-9
    if cells > MOST_POINTS:
        raise _too_many(step)
    return read_only(np.linspace(low, high, max(1, int(np.ceil(cells))) + 1))


def _of_bearable_size(grid: Grid, step: float) -> Grid:
    if grid.count > MOST_POINTS:
        raise _too_many(step)
    return grid


def _too_many(step: float) -> BadInput:
    return BadInput(
        f"a step of {step * 1e3:g} mm gives more than {MOST_POINTS} points",
        next_step="choose a larger step or a smaller region",
    )
