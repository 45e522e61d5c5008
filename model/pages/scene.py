"""A scene in 3-D: a still image as SVG, and the data with which `viewer.js` turns it.

Both draw the same surfaces, strokes and labels, the far ones first, in the page's colours. On a
page with `viewer`, `playback.js` moves the platform through its moments; the console moves its own.
"""

from __future__ import annotations

import base64
import gzip
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from string import Template
from typing import Any

import numpy as np

from model.pages.page import resource
from model.pose import Array

AZIMUTH, ELEVATION = -58.0, 24.0
"""From where a scene is seen at first, [deg]."""
_WIDTH = 1000.0
"""Of the still image's coordinates."""
_MARGIN = 34.0
_PIECES = 10
"""Of a cable, so that it can pass behind one obstacle and in front of another."""


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
    rough = float((high - low)[:2].max()) / 12.0
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(f * power for f in (1.0, 2.0, 5.0, 10.0) if f * power >= rough * (1 - 1e-9))
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


def viewer(
    scene: SceneFigure,
    label: str,
    layers: Iterable[tuple[str, str, str, bool]],
    hint: str = "",
) -> str:
    """The viewer and, for print and without scripts, the still image; HTML.

    Args:
        scene: What is drawn.
        label: What a reader who does not see it should know; plain text.
        layers: Name, title, CSS variable of its colour, and whether it is shown at first.
        hint: More about the image; plain text.
    """
    boxes = "".join(
        f'<label><input type="checkbox" data-layer="{name}"{" checked" if on else ""}>'
        f'<span class="swatch" style="color:var(--{role})"></span>{escape(title)}</label>'
        for name, title, role, on in layers
    )
    hidden = "" if len(scene.moments) > 1 else " hidden"
    return Template(resource("scene.template")).substitute(
        label=escape(label, quote=True),
        layers=boxes,
        hidden=hidden,
        last=max(len(scene.moments) - 1, 0),
        hint=escape(hint),
        still=still(scene, label),
    )


SCENE_SCRIPTS = ("viewer.js", "playback.js")
"""Of a page with a scene, after `page_data`."""


def page_data(scene: SceneFigure) -> dict[str, object]:
    """What `SCENE_SCRIPTS` read, for `page`: the scene, and three.js."""
    return {"scene-data": scene_data(scene), "three": _packed_three()}


@cache
def _packed_three() -> dict[str, str]:
    """three.js with its licence, as a script that needs neither a server nor imports.

    A page opened from a folder can import no file, and its policy allows only what is in it; so
    the names that the module exports become those of a global object.
    """
    folder = "vendor/three/"
    module, _, exported = resource(folder + "three.module.min.js").rpartition("export{")
    names = re.sub(r"([\w$]+) as (\w+)", r"\2:\1", exported.rstrip().removesuffix(";"))
    script = f'(()=>{{"use strict";{module}globalThis.THREE={{{names}}})()'
    packed = gzip.compress(script.encode(), mtime=0)
    return {"licence": resource(folder + "LICENSE"), "gzip": base64.b64encode(packed).decode()}


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


# The still image.


@dataclass(frozen=True, slots=True, eq=False)
class Eye:
    """A perspective view; images have x to the right and y up.

    Attributes:
        centre: Point in the middle of the image, shape (3,), [m].
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


def eye_for(points: Array) -> Eye:
    """The first view of points, shape (n, 3), [m]."""
    low, high = points.min(axis=0), points.max(axis=0)
    a, e = np.radians([AZIMUTH, ELEVATION])
    toward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    axes = np.array([right, np.cross(toward, right), toward])
    return Eye((low + high) / 2.0, 2.2 * float(np.linalg.norm(high - low)), axes)


def still(scene: SceneFigure, label: str) -> str:
    """The scene with the platform at its first moment; HTML with an SVG element."""
    points = scene.points()
    eye = eye_for(points)
    seen = eye.see(points)[:, :2]
    low, high = seen.min(axis=0), seen.max(axis=0)
    scale = (_WIDTH - 2.0 * _MARGIN) / float(high[0] - low[0])
    height = scale * float(high[1] - low[1]) + 2.0 * _MARGIN

    def project(world: Array) -> Array:
        found = eye.see(world)
        found[..., 0] = _MARGIN + scale * (found[..., 0] - low[0])
        found[..., 1] = _MARGIN + scale * (high[1] - found[..., 1])
        return found

    shapes = sorted(_shapes(scene, project, eye.distance), key=lambda shape: -shape[0])
    text = "".join(shape for _, shape in shapes) + _texts(scene, project)
    alternative = escape(label, quote=True)
    return (
        f'<figure class="still drawing"><svg viewBox="0 0 {_WIDTH:.0f} {height:.0f}" role="img"'
        f' aria-label="{alternative}">{text}</svg></figure>'
    )


def _shapes(scene: SceneFigure, project: Any, distance: float) -> Iterator[tuple[float, str]]:
    """Depth and SVG element of everything but texts."""
    for surface in [*scene.surfaces, *_placed(scene)]:
        yield from _of_surface(surface, project)
    for stroke in [*scene.strokes, *_cables(scene)]:
        if not len(stroke.segments):
            continue
        ends = project(stroke.segments)
        path = "".join(f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}" for a, b in ends)
        style = _style(stroke.role, stroke.width, stroke.dash, stroke.opacity)
        if stroke.ahead or stroke.layer in ("tree", "floor"):  # one path keeps the page small
            first = 1e9 if stroke.layer == "floor" else 0.5 * distance - 0.001 * (9 - stroke.width)
            yield first, f'<path d="{path}" {style}/>'
            continue
        for a, b in ends:
            line = f'<path d="M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}" {style}/>'
            yield float(a[2] + b[2]) / 2.0, line


def _of_surface(surface: SceneSurface, project: Any) -> Iterator[tuple[float, str]]:
    seen = project(surface.vertices)
    for face in surface.faces:
        corners = seen[list(face)]
        path = "L".join(f"{x:.1f} {y:.1f}" for x, y in corners[:, :2])
        style = f'style="fill:var(--{surface.role})" opacity="{surface.opacity:g}"'
        yield float(corners[:, 2].mean()), f'<path d="M{path}Z" {style}/>'
    for a, b in surface.edges:
        p, q = seen[a], seen[b]
        path = f"M{p[0]:.1f} {p[1]:.1f}L{q[0]:.1f} {q[1]:.1f}"
        yield float(p[2] + q[2]) / 2.0, f'<path d="{path}" {_style(surface.role, 1.2)}/>'


def _style(role: str, width: float, dash: str = "", opacity: float = 1.0) -> str:
    text = f'fill="none" style="stroke:var(--{role});stroke-width:{width:g}"'
    text += f' stroke-dasharray="{dash}"' if dash else ""
    return text + (f' opacity="{opacity:g}"' if opacity < 1.0 else "")


def _placed(scene: SceneFigure) -> list[SceneSurface]:
    """The platform at the first moment."""
    one = scene.platform
    return [
        SceneSurface(
            one.layer,
            one.role,
            moment.position + one.vertices @ moment.rotation.T,
            one.faces,
            one.edges,
            one.opacity,
        )
        for moment in scene.moments[:1]
    ]


def _cables(scene: SceneFigure) -> list[Stroke]:
    found = []
    for moment in scene.moments[:1]:
        ends = moment.position + scene.anchors @ moment.rotation.T
        share = np.linspace(0.0, 1.0, _PIECES + 1)[:, None]
        for start, end in zip(moment.exits, ends, strict=True):
            points = start + share * (end - start)
            found.append(Stroke("robot", "cable", np.stack([points[:-1], points[1:]], axis=1), 1.3))
    return found


def _texts(scene: SceneFigure, project: Any) -> str:
    found = [_text(project(one.at), one.text, one.mark) for one in scene.labels]
    for surface in scene.surfaces:
        if surface.name:
            upper = surface.vertices[:, 2] > surface.vertices[:, 2].max() - 1e-6
            found.append(_text(project(surface.vertices[upper].mean(axis=0)), surface.name))
    for moment in scene.moments[:1]:
        ends = moment.position + scene.anchors @ moment.rotation.T
        for k, (start, end) in enumerate(zip(moment.exits, ends, strict=True), start=1):
            found.append(_text(project(start + 0.25 * (end - start)), str(k)))
    return "".join(found)


def _text(at: Array, text: str, mark: str = "") -> str:
    x, y = float(at[0]), float(at[1])
    if not mark:
        return f'<text class="of" x="{x:.1f}" y="{y + 5:.1f}">{escape(text)}</text>'
    fill = "--surface" if mark == "ring" else "--ink"
    return (
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="6"'
        f' style="fill:var({fill});stroke:var(--ink);stroke-width:2"/>'
        f'<text class="of" style="text-anchor:start" x="{x + 11:.1f}" y="{y - 7:.1f}">'
        f"{escape(text)}</text>"
    )
