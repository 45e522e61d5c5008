"""Images of maps: slices as colour maps, costs as surfaces, volumes (paper, Figs. 6 and 7)."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from model.files.documents import write_bytes_atomic
from model.kinematics import cables_at
from model.pages.scene import (
    Moment,
    SceneFigure,
    SceneSurface,
    frame_surface,
    grid_floor,
    obstacle_surfaces,
    platform_surface,
    workspace_stroke,
)
from model.pose import Array, Pose
from planner.workspace.compute import VERDICTS, Maps
from planner.workspace.grid import AXES, Grid, zero_surface
from planner.workspace.report import SHOWN, Shown, limit_of, shown_in

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# One style for all images of maps.


CLOSED = "#3f9b6b"
FEASIBLE = "#2f7fb5"
FREE = "#c98500"
FRAME = "#c0392b"
LIMIT = "#d0004f"
VERDICT_COLOURS = ("#dcefe3", "#2f7fb5", "#e08a3c", "#c1465a", "#7a5195")
"""In the order of `planner.workspace.compute.VERDICTS`."""
MUTED = "#5c6675"
DOTS_PER_INCH = 150

SETTINGS: dict[Any, Any] = {  # matplotlib types the keys as a union of every setting's name
    "svg.fonttype": "none",
    "svg.hashsalt": "cdpr",
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "legend.frameon": False,
    "figure.dpi": DOTS_PER_INCH,
    "savefig.dpi": DOTS_PER_INCH,
}
_METADATA: dict[str, dict[str, Any]] = {
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": None},
}
"""By format: nothing that differs between days or versions of matplotlib."""


def new_figure(
    width: float, height: float, layout: Literal["constrained"] | None = "constrained"
) -> Figure:
    """An empty figure, [in], outside of any window system."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout=layout)


def write_figures(
    folder: Path, drawn: Mapping[str, Callable[[], Figure]], settings: Mapping[Any, Any] = SETTINGS
) -> None:
    """Writes each figure as PNG and SVG, the same whatever the user's ``matplotlibrc`` says.

    Args:
        drawn: Functions that draw a figure, by its name without suffix.
        settings: Of matplotlib, where they differ from its defaults.

    Raises:
        BadInput: The folder cannot be written to or is full.
    """
    import matplotlib as mpl

    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(settings)
        for name, draw in drawn.items():
            figure = draw()
            for kind, metadata in _METADATA.items():
                data = io.BytesIO()
                figure.savefig(data, format=kind, metadata=metadata)
                write_bytes_atomic(folder / f"{name}.{kind}", data.getvalue())


_COLUMNS = 3
_BELOW_LABELS = 0.42
"""Distance of the legend below the axes, [in]."""
_COSTS = ("dexterity_cost", "wrench_cost")
_LEAST_SPREAD = 1e-12


def slice_figure(maps: Maps) -> Figure:
    """Every quantity over a slice, with the line where its limit is reached."""
    panels = [quantity for quantity in shown_in(maps) if quantity.name != "condition_number"]
    rows = -(-(1 + len(panels)) // _COLUMNS)
    figure = new_figure(11.0, rows * (2.7 * height_to_width(maps.grid) + 0.8) + 0.4)
    figure.suptitle(title_of(maps.grid), x=0.01, ha="left", weight="bold")
    cells = np.asarray(figure.subplots(rows, _COLUMNS)).ravel()
    _verdict_map(cells[0], maps)
    for axes, quantity in zip(cells[1:], panels, strict=False):
        coloured = colour_map(axes, maps, quantity, *colour_range([maps], quantity))
        figure.colorbar(coloured, ax=axes, shrink=0.86)
        axes.set_title(quantity.label)
    for axes in cells[1 + len(panels) :]:
        axes.set_axis_off()
    return figure


def _verdict_map(axes: Axes, maps: Maps) -> None:
    """Draws the allowed positions, and what forbids the others."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch
    from matplotlib.transforms import ScaledTranslation

    values = _flat(maps.verdict, maps.grid)
    x, y = _coordinates(maps.grid)
    axes.pcolormesh(
        x, y, values, cmap=ListedColormap(VERDICT_COLOURS), vmin=-0.5,
        vmax=len(VERDICTS) - 0.5, shading="nearest", rasterized=True,
    )  # fmt: skip
    present = sorted(set(values.ravel().tolist()))
    patches = [Patch(color=VERDICT_COLOURS[k], label=VERDICTS[k]) for k in present]
    below = axes.transAxes + ScaledTranslation(0.0, -_BELOW_LABELS, axes.figure.dpi_scale_trans)
    axes.legend(
        handles=patches, loc="upper left", bbox_to_anchor=(0.0, 0.0), bbox_transform=below,
        borderaxespad=0.0, fontsize=8.0,
    )  # fmt: skip
    axes.set_title("where the platform may be")
    _label(axes, maps.grid)


def cost_figure(maps: Maps) -> Figure:
    """Dexterity cost (a) and wrench cost (b) over a slice as surfaces, as in the paper's Fig. 7."""
    figure = new_figure(11.0, 4.6)
    across, up = sides_of(maps.grid)
    grid = np.meshgrid(*_coordinates(maps.grid))
    for index, (letter, name) in enumerate(zip("ab", _COSTS, strict=True), start=1):
        quantity = next(q for q in SHOWN if q.name == name)
        axes: Any = figure.add_subplot(1, 2, index, projection="3d")
        values = values_on_slice(maps, quantity)
        low, high = colour_range([maps], quantity)
        surface = axes.plot_surface(
            *grid, values, cmap=quantity.colours, vmin=low, vmax=high, linewidth=0.15,
            edgecolor="#00000030", rcount=60, ccount=60,
        )  # fmt: skip
        axes.set_title(f"{letter}  {quantity.title}, {title_of(maps.grid)}")
        axes.set_xlabel(f"{AXES[across]} [mm]")
        axes.set_ylabel(f"{AXES[up]} [mm]")
        axes.view_init(elev=32.0, azim=-125.0)
        figure.colorbar(surface, ax=axes, shrink=0.6, pad=0.09)
    return figure


def colour_map(axes: Axes, maps: Maps, quantity: Shown, low: float, high: float) -> Any:
    """Draws one quantity over a slice; returns the mappable for a colour bar."""
    x, y = _coordinates(maps.grid)
    values = values_on_slice(maps, quantity)
    coloured = axes.pcolormesh(
        x, y, values, cmap=quantity.colours, vmin=low, vmax=high, shading="nearest", rasterized=True
    )
    limit = limit_of(maps, quantity)
    if limit is not None and np.nanmin(values) < limit < np.nanmax(values):
        bounded = np.nan_to_num(np.clip(values, 2.0 * min(low, limit) - high, high))
        axes.contour(x, y, bounded, levels=[limit], colors=LIMIT, linewidths=1.4)
    _label(axes, maps.grid)
    return coloured


def _label(axes: Axes, grid: Grid) -> None:
    across, up = sides_of(grid)
    axes.set_aspect("equal")
    axes.set_xlabel(f"{AXES[across]} [mm]")
    axes.set_ylabel(f"{AXES[up]} [mm]")


def colour_range(slices: list[Maps], quantity: Shown) -> tuple[float, float]:
    """Values at the ends of the colour scale: the 1st and 99th percentile."""
    values = np.concatenate([(m.values[quantity.name] * quantity.scale).ravel() for m in slices])
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(finite, [1.0, 99.0]))
    return low, max(high, low + _LEAST_SPREAD * max(1.0, abs(low)))


def values_on_slice(maps: Maps, quantity: Shown) -> Array:
    """Values in image order: rows upward, columns to the right, in the unit shown."""
    flat: Array = _flat(maps.values[quantity.name], maps.grid) * quantity.scale
    return flat


def _flat(values: NDArray[Any], grid: Grid) -> NDArray[Any]:
    return np.squeeze(values, axis=_normal(grid)).T


def _coordinates(grid: Grid) -> tuple[Array, Array]:
    """To the right and upward, [mm]."""
    across, up = sides_of(grid)
    return grid.axes[across] * 1e3, grid.axes[up] * 1e3


def sides_of(grid: Grid) -> tuple[int, int]:
    """Indices of the axes that point right and up in an image of a slice."""
    across, up = (axis for axis in range(3) if axis != _normal(grid))
    return across, up


def height_to_width(grid: Grid) -> float:
    """Aspect ratio of an image of a slice, within legible bounds."""
    x, y = _coordinates(grid)
    return float(np.clip(np.ptp(y) / np.ptp(x), 0.35, 2.0))


def title_of(grid: Grid) -> str:
    """Where the slice is."""
    normal = _normal(grid)
    return f"{AXES[normal]} = {round(float(grid.axes[normal][0]) * 1e3, 1):g} mm"


def _normal(grid: Grid) -> int:
    return 2 if grid.normal is None else grid.normal


# Images of volumes: the reachable space (paper, Fig. 6), and quantities level by level.


_LIGHT = np.array([0.35, -0.5, 0.79])
LEVELS = 6
#: Of the scene: layer, name on the page, the colour's role, whether it is shown at first.
SPACE_LAYERS = (
    ("closed", "Wrench closure", "series3", False),
    ("feasible", "Wrench feasible", "series1", True),
    ("free", "Collision free and feasible", "series5", True),
    ("obstacles", "Obstacles", "obstacle", True),
    ("robot", "Platform and cables at home", "platform", True),
    ("numbers", "Cable numbers", "ink", False),
    ("frame", "Frame of outlets", "frame", True),
    ("workspace", "Workspace box", "muted", True),
    ("floor", "Floor", "line", True),
)


def space_figure(maps: Maps) -> Figure:
    """Where wrenches can be balanced, where tensions suffice, and where nothing collides."""
    from matplotlib.ticker import MaxNLocator

    panels = _regions(maps)
    figure = new_figure(4.4 * len(panels), 4.3, layout=None)
    figure.subplots_adjust(left=0.03, right=0.96, bottom=0.06, top=0.9, wspace=0.12)
    for index, (title, field, colour) in enumerate(panels, start=1):
        axes: Any = figure.add_subplot(1, len(panels), index, projection="3d")
        _draw_surface(axes, zero_surface(maps.grid.axes, field) * 1e3, colour)
        frame, box = frame_surface(maps.question.rig), workspace_stroke(maps.question.rig)
        _draw_edges(axes, frame.vertices[np.array(frame.edges)] * 1e3, FRAME, 1.4)
        _draw_edges(axes, box.segments * 1e3, MUTED, 0.8)
        share = float(np.mean(field > 0.0))
        axes.set_title(f"{title}: {share * 100:.1f} % of the region")
        for letter in "xyz":
            getattr(axes, f"set_{letter}label")(f"{letter} [mm]")
            getattr(axes, f"{letter}axis").set_major_locator(MaxNLocator(4))
        axes.set_aspect("equal")
        axes.view_init(elev=24.0, azim=-58.0)
    return figure


def _regions(maps: Maps) -> list[tuple[str, Array, str]]:
    """Title, field that is positive within, and colour; the largest region first."""
    regions = [
        ("wrench closure", maps.values["closure_margin"], CLOSED),
        ("wrench feasible", maps.values["capacity_margin"], FEASIBLE),
    ]
    if maps.question.scene is not None:
        regions.append(("collision free and feasible", _allowed(maps), FREE))
    return regions


def space_scene(maps: Maps) -> SceneFigure:
    """The same in the scene of pages, every other point of the grid; `SPACE_LAYERS` are its."""
    rig, scene = maps.question.rig, maps.question.scene
    numbers = [np.union1d(np.arange(0, n, 2), n - 1) for n in maps.grid.shape]
    x, y, z = (axis[k] for axis, k in zip(maps.grid.axes, numbers, strict=True))
    surfaces = [frame_surface(rig), *(obstacle_surfaces(scene) if scene else ())]
    for (layer, _, role, _), (_, field, _) in zip(SPACE_LAYERS, _regions(maps), strict=False):
        triangles = zero_surface((x, y, z), field[np.ix_(*numbers)])
        points, corners = np.unique(triangles.reshape(-1, 3).round(4), axis=0, return_inverse=True)
        faces = corners.reshape(-1, 3).tolist()
        surfaces.append(SceneSurface(layer, role, points, faces, (), 0.3))
    home = Pose(rig.home.position, maps.question.rotation)
    moment = Moment(0.0, home.position, home.rotation, cables_at(rig, home).exits)
    floor, _ = grid_floor(np.concatenate([surface.vertices for surface in surfaces]))
    strokes = (floor, workspace_stroke(rig))
    platform = platform_surface(rig)
    return SceneFigure(tuple(surfaces), strokes, (), rig.anchors, platform, (moment,))


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
