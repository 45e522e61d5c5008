"""Images of volumes: where the robot can be (paper, Fig. 6), and quantities level by level."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from model.pose import Array
from model.rig import Rig
from planner.workspace.compute import Maps
from planner.workspace.grid import Grid, zero_surface
from planner.workspace.report import Shown
from planner.workspace.slices import (
    CLOSED,
    FEASIBLE,
    FRAME,
    FREE,
    MUTED,
    colour_map,
    colour_range,
    height_to_width,
    new_figure,
    title_of,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LIGHT = np.array([0.35, -0.5, 0.79])
_FLAT = np.cos(np.radians(20.0))
LEVELS = 6


def space_figure(maps: Maps) -> Figure:
    """Where wrenches can be balanced, where tensions suffice, and where nothing collides."""
    from matplotlib.ticker import MaxNLocator

    panels = [
        ("wrench closure", maps.values["closure_margin"], CLOSED),
        ("wrench feasible", maps.values["capacity_margin"], FEASIBLE),
    ]
    if maps.question.scene is not None:
        panels.append(("collision free and feasible", _allowed(maps), FREE))
    figure = new_figure(4.4 * len(panels), 4.3, layout=None)
    figure.subplots_adjust(left=0.03, right=0.96, bottom=0.06, top=0.9, wspace=0.12)
    for place, (title, field, colour) in enumerate(panels):
        axes: Any = figure.add_subplot(1, len(panels), place + 1, projection="3d")
        _draw_surface(axes, zero_surface(maps.grid.axes, field) * 1e3, colour)
        _draw_edges(axes, frame_edges(maps.question.rig) * 1e3, FRAME, 1.4)
        _draw_edges(axes, workspace_edges(maps.question.rig) * 1e3, MUTED, 0.8)
        share = float(np.mean(field > 0.0))
        axes.set_title(f"{title}: {share * 100:.1f} % of the region")
        for letter in "xyz":
            getattr(axes, f"set_{letter}label")(f"{letter} [mm]")
            getattr(axes, f"{letter}axis").set_major_locator(MaxNLocator(4))
        axes.set_aspect("equal")
        axes.view_init(elev=24.0, azim=-58.0)
    return figure


def level_figure(maps: Maps, quantity: Shown) -> Figure:
    """One quantity of a volume at levels of z, bottom to top, in the same colours."""
    levels = [_level(maps, number) for number in level_numbers(maps.grid)]
    figure = new_figure(11.0, 2.0 * (3.3 * height_to_width(levels[0].grid) + 0.35) + 0.5)
    figure.suptitle(quantity.label, x=0.01, ha="left", weight="bold")
    low, high = colour_range(levels, quantity)
    cells = np.asarray(figure.subplots(2, LEVELS // 2, sharex=True, sharey=True))
    for axes, level in zip(cells.ravel(), levels, strict=False):
        coloured = colour_map(axes, level, quantity, low, high)
        axes.set_title(title_of(level.grid))
        axes.label_outer()
    for axes in cells.ravel()[len(levels) :]:
        axes.set_axis_off()
    figure.colorbar(coloured, ax=cells, shrink=0.8)
    return figure


def level_numbers(grid: Grid) -> list[int]:
    """Which layers of a volume are shown, bottom to top."""
    layers = grid.shape[2]
    return sorted(set(np.linspace(0, layers - 1, min(LEVELS, layers)).round().astype(int).tolist()))


def _level(maps: Maps, number: int) -> Maps:
    x, y, z = maps.grid.axes
    grid = Grid(maps.grid.name, (x, y, z[number : number + 1]), normal=2)
    values = {name: array[:, :, number : number + 1] for name, array in maps.values.items()}
    return replace(maps, grid=grid, values=values)


def _allowed(maps: Maps) -> Array:
    """Positive where tensions suffice and all clearances are kept; a distance-like field."""
    scene = maps.question.scene
    if scene is None:
        return maps.values["capacity_margin"]
    margin = maps.values["capacity_margin"] / maps.question.rig.max_tension
    fields = [margin, maps.values["self_clearance"] - scene.self_clearance]
    if "obstacle_clearance" in maps.values:
        fields.append(maps.values["obstacle_clearance"] - scene.obstacle_clearance)
    allowed: Array = np.min(fields, axis=0)
    return allowed


def frame_edges(rig: Rig) -> Array:
    """Edges of the frame that the outlets span, shape (k, 2, 3), [m].

    Outlets all at one height are joined to the floor below them.
    """
    from scipy.spatial import ConvexHull, QhullError

    points = rig.outlets
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        points = np.vstack([points, points * [1.0, 1.0, 0.0]])
        hull = ConvexHull(points)
    found: dict[tuple[int, int], list[Array]] = {}
    for triangle, plane in zip(hull.simplices, hull.equations, strict=True):
        a, b, c = sorted(triangle.tolist())
        for edge in ((a, b), (a, c), (b, c)):
            found.setdefault(edge, []).append(plane[:3])
    sharp = [edge for edge, (one, other) in found.items() if one @ other < _FLAT]
    edges: Array = points[np.array(sharp)]
    return edges


def workspace_edges(rig: Rig) -> Array:
    """Edges of the workspace box, shape (12, 2, 3), [m]."""
    ends = np.stack([rig.workspace_lower, rig.workspace_upper])
    numbers = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")).reshape(3, 8).T
    corners = ends[numbers, np.arange(3)]
    pairs = [
        (i, j) for i in range(8) for j in range(i) if np.abs(numbers[i] - numbers[j]).sum() == 1
    ]
    edges: Array = corners[np.array(pairs)]
    return edges


def _draw_surface(axes: Any, triangles: Array, colour: str) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    if not len(triangles):
        return
    faces = Poly3DCollection(triangles, linewidths=0.0, antialiaseds=False)
    faces.set_facecolor(_lit(triangles, colour))
    faces.set_rasterized(True)
    axes.add_collection3d(faces)


def _lit(triangles: Array, colour: str) -> Array:
    from matplotlib.colors import to_rgb

    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    shade = 0.62 + 0.38 * (normals @ _LIGHT) / np.where(lengths > 0.0, lengths, 1.0)
    lit: Array = np.clip(shade[:, None] * np.array(to_rgb(colour)) * 1.15, 0.0, 1.0)
    return lit


def _draw_edges(axes: Any, edges: Array, colour: str, width: float) -> None:
    for start, end in edges:
        axes.plot(*np.stack([start, end], axis=1), color=colour, linewidth=width, zorder=10)
