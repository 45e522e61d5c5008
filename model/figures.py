"""Matplotlib figures of rigs and paths; imported only when a figure is requested.

Axes are in millimetres, world frame. Figures come from `matplotlib.pyplot`, so a notebook shows
them and a script can call `matplotlib.pyplot.show`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from model.pose import Array, Pose
from model.shapes import Obstacle, Solid, box_solid, solid_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from model.plan import Plan
    from model.rig import Rig
    from model.scene import Scene

_MM = 1e3
#: Okabe and Ito's palette, distinguishable with any colour vision.
_PLATFORM, _PATH, _RAW, _OBSTACLE, _FRAME = "#0072B2", "#D55E00", "#999999", "#56606B", "#BBBBBB"


def rig_figure(rig: Rig, pose: Pose, scene: Scene | None = None) -> Figure:
    """The rig at a pose, among the obstacles of a scene.

    Args:
        pose: ``world_from_platform``.
        scene: Its obstacles are drawn.
    """
    figure, axes = _new(f"{rig.name} at {np.round(pose.position * _MM, 1).tolist()} mm")
    _draw_scene(axes, rig, scene.obstacles if scene else ())
    _draw_robot(axes, rig, pose)
    return _finished(figure, axes)


def plan_figure(plan: Plan) -> Figure:
    """A planned path among its obstacles, with the robot at the start."""
    figure, axes = _new(f"{plan.scene.name}: {plan.document.quality.length_mm:.0f} mm")
    _draw_scene(axes, plan.rig, plan.scene.obstacles)
    _draw_robot(axes, plan.rig, plan.waypoints[0])
    _draw_path(axes, plan.raw_path, "as found", color=_RAW, linewidth=1.0)
    _draw_path(axes, plan.waypoints, "path", color=_PATH, linewidth=2.0, marker="o", markersize=3)
    axes.legend(loc="upper left", frameon=False)
    return _finished(figure, axes)


def _new(title: str) -> tuple[Figure, Any]:
    figure = plt.figure(figsize=(7.0, 6.0), layout="constrained")
    engine = figure.get_layout_engine()
    assert engine is not None
    engine.set(rect=(0.0, 0.0, 0.93, 1.0))  # type: ignore[call-arg]  # else the label of z is cut
    axes = figure.add_subplot(projection="3d")
    axes.set_title(title)
    return figure, axes


def _finished(figure: Figure, axes: Any) -> Figure:
    axes.set_xlabel("x [mm]")
    axes.set_ylabel("y [mm]")
    axes.set_zlabel("z [mm]")
    axes.set_aspect("equal")
    return figure


def _draw_scene(axes: Any, rig: Rig, obstacles: Sequence[Obstacle]) -> None:
    """Outlets, workspace box and obstacles."""
    axes.scatter(*(rig.outlets * _MM).T, color=_FRAME, s=18)
    centre = (rig.workspace_upper + rig.workspace_lower) / 2.0
    half = (rig.workspace_upper - rig.workspace_lower) / 2.0
    _draw_edges(axes, box_solid(half, Pose.level(centre)), color=_FRAME, linestyle=":")
    for obstacle in obstacles:
        solid = solid_of(obstacle)
        _draw_faces(axes, solid, _OBSTACLE, 0.25)
        _draw_edges(axes, solid, color=_OBSTACLE, linewidth=0.8)


def _draw_robot(axes: Any, rig: Rig, pose: Pose) -> None:
    """Platform and cables."""
    posed = rig.at(pose)
    for ends in np.stack([posed.exits, posed.anchors], axis=1):
        axes.plot(*(ends * _MM).T, color="black", linewidth=0.8)
    platform = box_solid(rig.half_size, pose)
    _draw_faces(axes, platform, _PLATFORM, 0.6)
    _draw_edges(axes, platform, color=_PLATFORM, linewidth=0.8)


def _draw_path(axes: Any, poses: Sequence[Pose], label: str, **style: Any) -> None:
    points: Array = np.array([pose.position for pose in poses])
    axes.plot(*(points * _MM).T, label=label, **style)


def _draw_faces(axes: Any, solid: Solid, color: str, alpha: float) -> None:
    # Matplotlib scales the axes by uninitialised memory unless all faces have one size.
    most = max(map(len, solid.faces))
    faces = [[*face, *[face[-1]] * (most - len(face))] for face in solid.faces]
    corners = [solid.vertices[face] * _MM for face in faces]
    axes.add_collection3d(Poly3DCollection(corners, facecolor=color, alpha=alpha, linewidth=0))


def _draw_edges(axes: Any, solid: Solid, **style: Any) -> None:
    for edge in solid.edges:
        axes.plot(*(solid.vertices[list(edge)] * _MM).T, **style)
