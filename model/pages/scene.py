"""A scene in 3-D: surfaces, strokes and labels, and the data from which `viewer.js` draws them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from model.pages.charts import round_step
from model.pose import Array, Pose
from model.rig import Rig
from model.scene import Scene
from model.shapes import ConvexHull, Obstacle, Solid, box_solid, convex_hull, solid_of

AZIMUTH, ELEVATION = -58.0, 24.0
"""From where a scene is seen at first, [deg]."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneSurface:
    """A surface of flat faces, world frame.

    Attributes:
        layer: With which it is shown and hidden.
        role: CSS variable of its colour.
        vertices: Shape (n, 3), [m].
        faces: Polygons by vertex number; none to draw edges alone.
        edges: Pairs of vertex numbers.
        opacity: Of faces.
        name: Written on it; may be empty.
    """

    layer: str
    role: str
    vertices: Array
    faces: Sequence[Sequence[int]]
    edges: Sequence[tuple[int, int]]
    opacity: float = 0.6
    name: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Stroke:
    """Straight pieces of one kind, world frame.

    Attributes:
        layer: With which it is shown and hidden.
        role: CSS variable of its colour.
        segments: Shape (k, 2, 3), [m].
        width: [px].
        opacity: 1 for opaque.
        dash: SVG dash pattern; empty for full lines.
        ahead: Whether it is painted a little nearer than it is: a path on the same track as others.
    """

    layer: str
    role: str
    segments: Array
    width: float
    opacity: float = 1.0
    dash: str = ""
    ahead: bool = False

    @classmethod
    def along(
        cls, layer: str, role: str, points: Array, width: float, opacity: float = 1.0
    ) -> Stroke:
        """A track through points, shape (n, 3), [m]."""
        segments = np.stack([points[:-1], points[1:]], axis=1) if len(points) else _NONE
        return cls(layer, role, segments, width, opacity, ahead=True)


_NONE = np.zeros((0, 2, 3))


@dataclass(frozen=True, slots=True, eq=False)
class Label:
    """A text at a point, world frame, [m]; ``mark`` is ``ring``, ``dot`` or empty."""

    layer: str
    text: str
    at: Array
    mark: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """The platform at a time.

    Attributes:
        time: [s].
        position: World frame, shape (3,), [m].
        rotation: ``world_from_platform``, shape (3, 3).
        exits: Where cables leave outlets or pulleys, shape (m, 3), [m].
        text: What is written below the image; plain text.
    """

    time: float
    position: Array
    rotation: Array
    exits: Array
    text: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class SceneFigure:
    """All that is drawn.

    Attributes:
        surfaces: Of the world.
        strokes: Frame, floor, paths, arrows.
        labels: Texts at points.
        anchors: Platform frame, shape (m, 3), [m].
        platform: In its own frame.
        moments: Rising in time; the first is shown at first, none draws no platform.
    """

    surfaces: tuple[SceneSurface, ...]
    strokes: tuple[Stroke, ...]
    labels: tuple[Label, ...]
    anchors: Array
    platform: SceneSurface
    moments: tuple[Moment, ...]

    def points(self) -> Array:
        """All points that must be seen, shape (n, 3), [m]."""
        parts = [s.vertices for s in self.surfaces]
        parts += [stroke.segments.reshape(-1, 3) for stroke in self.strokes]
        parts += [label.at[None] for label in self.labels]
        reach = np.abs(self.platform.vertices).max(axis=0)
        for moment in self.moments[:: max(len(self.moments) // 20, 1)]:
            parts += [moment.position + np.array([-reach, reach])]
        return np.concatenate(parts)


def grid_floor(points: Array) -> tuple[Stroke, float]:
    """A floor below points, shape (n, 3), [m], with lines at round coordinates, and their distance.

    It is at z = 0, or below the lowest point where one is below that.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    step = round_step(float((high - low)[:2].max()) / 12.0)
    first, last = np.floor(low[:2] / step) * step, np.ceil(high[:2] / step) * step
    level = min(0.0, float(low[2]))
    xs, ys = (
        first[k] + step * np.arange(round(float(last[k] - first[k]) / step) + 1) for k in (0, 1)
    )
    lines = [[[x, first[1], level], [x, last[1], level]] for x in xs]
    lines += [[[first[0], y, level], [last[0], y, level]] for y in ys]
    return Stroke("floor", "frame", np.array(lines), 1.0, 0.3), step


def arrows(layer: str, role: str, starts: Array, ends: Array, width: float = 2.0) -> Stroke:
    """Arrows from points to points, each of shape (n, 3), [m]."""
    parts = []
    for start, end in zip(starts, ends, strict=True):
        along = end - start
        length = float(np.linalg.norm(along))
        if length <= 0.0:
            continue
        side = np.cross(along, np.eye(3)[int(np.argmin(np.abs(along)))])
        side *= 0.12 * length / float(np.linalg.norm(side))
        other = np.cross(along, side) / length
        back = end - 0.3 * along
        parts += [[start, end], *([end, back + s] for s in (side, -side, other, -other))]
    return Stroke(layer, role, np.array(parts) if parts else _NONE, width, ahead=True)


def scene_data(scene: SceneFigure) -> dict[str, Any]:
    """What `viewer.js` reads, JSON-like: mm, flat lists, times in s."""
    return {
        "view": {"azimuth": AZIMUTH, "elevation": ELEVATION},
        "surfaces": [_surface_data(s) for s in scene.surfaces],
        "strokes": [
            {
                "layer": s.layer,
                "role": s.role,
                "segments": _mm(s.segments.reshape(-1, 6)),
                "width": s.width,
                "opacity": s.opacity,
                "dash": [float(part) for part in s.dash.split()],
                "ahead": s.ahead,
            }
            for s in scene.strokes
        ],
        "labels": [
            {"layer": one.layer, "text": one.text, "at": _mm(one.at), "mark": one.mark}
            for one in scene.labels
        ],
        "anchors": _mm(scene.anchors),
        "platform": _surface_data(scene.platform),
        "moments": [_moment_data(moment) for moment in scene.moments],
    }


def _surface_data(surface: SceneSurface) -> dict[str, Any]:
    return {
        "layer": surface.layer,
        "role": surface.role,
        "vertices": _mm(surface.vertices),
        "faces": [list(face) for face in surface.faces],
        "edges": [list(edge) for edge in surface.edges],
        "opacity": surface.opacity,
        "name": surface.name,
    }


def _moment_data(moment: Moment) -> dict[str, Any]:
    return {
        "t": round(moment.time, 3),
        "p": _mm(moment.position),
        "r": np.round(moment.rotation, 5).reshape(-1).tolist(),
        "exits": _mm(moment.exits),
        "text": moment.text,
    }


def _mm(values: Array) -> Any:
    return np.round(values * 1e3, 1).tolist()


# What every scene shows of a robot and what is around it.


def _surface(layer: str, role: str, solid: Solid, opacity: float, name: str = "") -> SceneSurface:
    return SceneSurface(layer, role, solid.vertices, solid.faces, solid.edges, opacity, name)


def obstacle_surfaces(scene: Scene) -> tuple[SceneSurface, ...]:
    """The obstacles, by their names."""
    return tuple(
        _surface("obstacles", "obstacle", solid_of(one), 0.62, one.name) for one in scene.obstacles
    )


def platform_surface(rig: Rig) -> SceneSurface:
    """The platform in its own frame."""
    return _surface("robot", "platform", box_solid(rig.half_size), 0.85)


def frame_surface(rig: Rig) -> SceneSurface:
    """The edges of the body that spans the outlets; with the workspace if they are on one line."""
    bodies = [
        rig.outlets,
        np.vstack([rig.outlets, rig.outlets + _depth(rig)]),  # all in one plane
        np.vstack([rig.outlets, _workspace_box(rig).vertices]),
    ]
    hull = next(hull for hull in map(_hull, bodies) if hull is not None)
    solid = solid_of(Obstacle("frame", hull, Pose.level(np.zeros(3))))
    return SceneSurface("frame", "frame", solid.vertices, (), solid.edges)


def _hull(points: Array) -> ConvexHull | None:
    """The convex hull of points, [m]; None if they do not span a volume."""
    try:
        return convex_hull(points)
    except ValueError:
        return None


def _depth(rig: Rig) -> Array:
    """From the plane of all outlets to the far end of workspace and floor, shape (3,), [m]."""
    centre = rig.outlets.mean(axis=0)
    normal = np.linalg.svd(rig.outlets - centre)[2][-1]
    ends = np.vstack([_workspace_box(rig).vertices, centre * [1.0, 1.0, 0.0]])
    depths = (ends - centre) @ normal
    depth: Array = depths[np.argmax(np.abs(depths))] * normal
    return depth


def workspace_stroke(rig: Rig) -> Stroke:
    """The box that the platform's origin keeps within."""
    box = _workspace_box(rig)
    edges = box.vertices[np.array(box.edges)]
    return Stroke("workspace", "muted", edges, 1.0, 0.8, dash="4 4")


def _workspace_box(rig: Rig) -> Solid:
    centre = (rig.workspace_upper + rig.workspace_lower) / 2.0
    return box_solid((rig.workspace_upper - rig.workspace_lower) / 2.0, Pose.level(centre))
