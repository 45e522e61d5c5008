"""A scene on a page of its own: `viewer.js` turns it, and without scripts it is a still image.

Both draw the same surfaces, strokes and labels in the page's colours. `playback.js` moves the
platform through its moments; the console, which has `viewer.js` too, moves its own.
"""

from __future__ import annotations

import base64
import gzip
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from html import escape
from string import Template
from typing import Any

import numpy as np

from model.pages.page import resource
from model.pages.scene import AZIMUTH, ELEVATION, SceneFigure, SceneSurface, Stroke, scene_data
from model.pose import Array

_WIDTH = 1000.0
"""Of the still image's coordinates."""
_MARGIN = 34.0
_PIECES = 10
"""Of a cable, so that it can pass behind one obstacle and in front of another."""


def viewer(
    scene: SceneFigure,
    label: str,
    layers: Iterable[tuple[str, str, str, bool]],
    hint: str = "",
    still: str = "",
) -> str:
    """The viewer and, for print and without scripts, the still image; HTML.

    Args:
        label: What a reader who does not see it should know; plain text.
        layers: Name, title, CSS variable of its colour, and whether it is shown at first.
        hint: More about the image; plain text.
        still: HTML of another still image.
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
        still=f'<div class="still">{still}</div>' if still else still_image(scene, label),
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


def still_image(scene: SceneFigure, label: str) -> str:
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
