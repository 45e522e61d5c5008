"""The still picture of the scene (paper, Fig. 8), for print and for pages without scripts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cdpr.cables import cables_to
from cdpr.poses import Array, matrix_from_quaternion
from executor.report.figure_style import STAND_IN, as_svg, new_figure, settings
from executor.report.run_data import RunData
from executor.report.scene_view import SceneView
from executor.solids import Solid

if TYPE_CHECKING:
    from matplotlib.axes import Axes

AZIMUTH, ELEVATION = -58.0, 30.0
"""Where the camera stands at first, [deg]; the viewer on the page starts there too."""


@dataclass(frozen=True, slots=True, eq=False)
class Eye:
    """A perspective view; pictures have x to the right and y up.

    Attributes:
        centre: Point in the middle of the picture, shape (3,), [m].
        distance: From the eye to it, [m].
        axes: Rows: right, up, toward the eye; shape (3, 3).
    """

    centre: Array
    distance: float
    axes: Array

    def see(self, points: Array) -> Array:
        """Points, shape (..., 3), [m], as (x, y, depth), shape (..., 3)."""
        turned = (points - self.centre) @ self.axes.T
        depth = self.distance - turned[..., 2]
        scale = self.distance / depth
        seen: Array = np.stack([turned[..., 0] * scale, turned[..., 1] * scale, depth], axis=-1)
        return seen


def eye_for(view: SceneView) -> Eye:
    """The view that holds the whole frame."""
    low, high = view.frame.vertices.min(axis=0), view.frame.vertices.max(axis=0)
    a, e = np.radians([AZIMUTH, ELEVATION])
    toward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    axes = np.array([right, np.cross(toward, right), toward])
    return Eye((low + high) / 2.0, 2.2 * float(np.linalg.norm(high - low)), axes)


def scene_picture(run: RunData, view: SceneView) -> str:
    """The scene with the platform at the end of the run; an SVG element."""
    eye = eye_for(view)
    with settings():
        figure = new_figure(6.2)
        axes = figure.subplots()
        axes.set_axis_off()
        axes.set_aspect("equal")
        _edges(axes, eye, view.frame, "frame", 1.6)
        _edges(axes, eye, view.workspace, "muted", 0.7, (0, (3, 3)))
        _branches(axes, eye, view.tree)
        for name, solid in view.obstacles:
            _surface(axes, eye, solid, "obstacle", 0.55)
            _name(axes, eye, name, solid)
        _track(axes, eye, view.raw, color=STAND_IN["raw"], linewidth=1.2, label="raw path")
        _track(axes, eye, view.path, color=STAND_IN["ink"], linewidth=3.2, label="final path")
        _track(
            axes, eye, view.seen, color=STAND_IN["tag"], linewidth=5.0, alpha=0.35, label="camera"
        )
        _track(
            axes, eye, view.driven, color=STAND_IN["encoder"], linewidth=1.2, label="driven path"
        )
        if len(view.moments):
            _robot(axes, eye, run, view)
        axes.autoscale_view()
        axes.legend(loc="upper left", fontsize=8.5)
        return as_svg(figure, "scene", _alternative(run))


def _near_first(depth: float) -> float:
    return 100.0 - depth


def _surface(axes: Axes, eye: Eye, solid: Solid, role: str, alpha: float) -> None:
    seen = eye.see(solid.vertices)
    for face in solid.faces:
        corners = seen[list(face)]
        axes.fill(
            corners[:, 0],
            corners[:, 1],
            facecolor=STAND_IN[role],
            alpha=alpha,
            linewidth=0,
            zorder=_near_first(float(corners[:, 2].mean())),
        )
    _edges(axes, eye, solid, role, 0.9)


def _edges(
    axes: Axes, eye: Eye, solid: Solid, role: str, width: float, style: Any = "solid"
) -> None:
    seen = eye.see(solid.vertices)
    for start, end in solid.edges:
        ends = seen[[start, end]]
        axes.plot(
            ends[:, 0],
            ends[:, 1],
            color=STAND_IN[role],
            linewidth=width,
            linestyle=style,
            zorder=_near_first(float(ends[:, 2].mean())),
        )


def _branches(axes: Axes, eye: Eye, tree: Array) -> None:
    """All branches as one path: a line each would make the page several times as large."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    if not len(tree):
        return
    points = eye.see(tree)[..., :2].reshape(-1, 2)
    codes = np.tile([Path.MOVETO, Path.LINETO], len(tree))
    colour = STAND_IN["tree"]
    patch = PathPatch(Path(points, codes), fill=False, edgecolor=colour, linewidth=0.7)
    axes.plot([], [], color=colour, linewidth=0.9, label="search tree")  # for the legend
    patch.set_zorder(50.0)
    axes.add_patch(patch)


def _track(axes: Axes, eye: Eye, points: Array, **style: Any) -> None:
    if len(points):
        seen = eye.see(points)
        axes.plot(seen[:, 0], seen[:, 1], zorder=120.0, **style)


def _name(axes: Axes, eye: Eye, name: str, solid: Solid) -> None:
    top = solid.vertices[:, 2] > solid.vertices[:, 2].max() - 1e-6
    place = eye.see(solid.vertices[top].mean(axis=0))
    axes.text(place[0], place[1], name, fontsize=8, ha="center", va="center", zorder=130.0)


def _robot(axes: Axes, eye: Eye, run: RunData, view: SceneView) -> None:
    row = view.moments[-1]
    turn = matrix_from_quaternion(run.cycles.encoder_rotation[row])
    position = run.cycles.encoder[row]
    cables = cables_to(run.rig, position + run.rig.anchors @ turn.T)
    for start, end in zip(cables.exits, cables.anchors, strict=True):
        pieces = eye.see(start + np.linspace(0.0, 1.0, 9)[:, None] * (end - start))
        for k in range(8):
            depth = float(pieces[k : k + 2, 2].mean())
            axes.plot(
                pieces[k : k + 2, 0],
                pieces[k : k + 2, 1],
                color=STAND_IN["cable"],
                linewidth=1.0,
                zorder=_near_first(depth),
            )
    corners = position + view.platform.vertices @ turn.T
    placed = Solid(corners, view.platform.faces, view.platform.edges)
    _surface(axes, eye, placed, "platform", 0.75)


def _alternative(run: RunData) -> str:
    plan = run.plan
    names = ", ".join(o.name for o in plan.scene.obstacles) or "none"
    start, end = (np.round(p.position * 1e3) for p in (plan.waypoints[0], plan.waypoints[-1]))
    return (
        f"The frame with {run.rig.cable_count} cables, the obstacles ({names}), the search tree and"
        f" the path from {start.tolist()} to {end.tolist()} mm, with the platform where the run"
        " ended."
    )
