"""The page of a run: one HTML file that needs neither a server nor a network."""

from __future__ import annotations

import json
from html import escape
from importlib.resources import files
from string import Template

from executor.report.clearance_figure import clearance_figure
from executor.report.drive_figures import length_figure, tension_figure, timing_figure
from executor.report.frames import frames
from executor.report.markup import chart, paragraph, section
from executor.report.position_figure import position_figure
from executor.report.run_data import RunData
from executor.report.scene_picture import AZIMUTH, ELEVATION, scene_picture
from executor.report.scene_view import SceneView, scene_view, viewer_data
from executor.report.tables import camera_table, event_table, facts, stop_table
from executor.report.tiles import chips, key_figures, verdict_banner

#: Layer, its name on the page, the colour's role, whether it is shown at first.
_LAYERS = (
    ("obstacles", "Obstacles", "obstacle", True),
    ("robot", "Platform and cables", "platform", True),
    ("frame", "Frame of outlets", "frame", True),
    ("workspace", "Workspace", "muted", True),
    ("tree", "Search tree", "tree", True),
    ("raw", "Raw path", "raw", True),
    ("path", "Final path", "ink", True),
    ("driven", "Driven path", "encoder", True),
    ("seen", "Seen by the camera", "tag", True),
)
Section = tuple[str, str, str]


def page(run: RunData) -> str:
    """The whole page."""
    view = scene_view(run)
    sections = [part for part in _sections(run, view) if part[2]]
    title = f"Run of {run.plan.scene.name} on {run.rig.name}"
    links = "".join(f'<li><a href="#{name}">{escape(text)}</a></li>' for name, text, _ in sections)
    return Template(_read("page.template")).substitute(
        title=escape(title),
        style=_read("page.css"),
        chips=chips(run.summary),
        contents=f"<ul>{links}</ul>",
        verdict=verdict_banner(run.summary),
        tiles=key_figures(run.summary),
        sections="".join(section(name, text, body) for name, text, body in sections),
        footer=escape(_footer(run)),
        script=_script(run, view),
    )


def _read(name: str) -> str:
    return files("executor.report").joinpath(name).read_text(encoding="utf-8")


def _sections(run: RunData, view: SceneView) -> list[Section]:
    moved = len(run.cycles) > 1
    return [
        ("scene", "Scene and path", _scene(run, view)),
        ("stops", "Stops", stop_table(run)),
        ("clearance", "Clearance", _clearance(run) if moved else ""),
        ("position", "Position", _position(run) if moved else ""),
        ("frames", "Pictures", frames(run)),
        ("cables", "Cables", _cables(run) if moved else ""),
        ("timing", "Following and timing", _timing(run) if moved else ""),
        ("facts", "Plan, rig and bus", facts(run)),
        ("events", "Events", event_table(run)),
    ]


def _scene(run: RunData, view: SceneView) -> str:
    present = {"tree": len(view.tree), "seen": len(view.seen), "obstacles": len(view.obstacles)}
    layers = "".join(
        f'<label><input type="checkbox" data-layer="{layer}"{" checked" if on else ""}>'
        f'<span class="swatch" style="color:var(--{role})"></span>{name}</label>'
        for layer, name, role, on in _LAYERS
        if present.get(layer, 1)
    )
    text = ""
    if view.all_branches > len(view.tree):
        text = paragraph(f"{len(view.tree)} of {view.all_branches} branches of the tree are drawn.")
    names = ", ".join(name for name, _ in view.obstacles) or "none"
    return text + Template(_read("scene.template")).substitute(
        label=escape(
            f"The robot, the obstacles ({names}), the search tree and the paths.", quote=True
        ),
        layers=layers,
        last=max(len(view.moments) - 1, 0),
        still=scene_picture(run, view),
    )


def _clearance(run: RunData) -> str:
    if not len(run.clearance):
        return paragraph("The scene has no obstacles.")
    text = (
        "Distances between surfaces. The true one lies in the shaded band, as the measurement"
        " itself states; planned is the pose that was commanded at the same time."
    )
    return paragraph(text) + chart(clearance_figure(run))


def _position(run: RunData) -> str:
    text = "Drives: the pose that fits the drives' actual positions. Camera: the pose of the tags."
    if run.alone:
        text += " Together: all cameras, each by its weight; the others are each camera's own pose."
    return paragraph(text) + chart(position_figure(run)) + camera_table(run)


def _cables(run: RunData) -> str:
    upper = run.rig.max_tension
    note = f"The upper limit is {upper:g} N; it is drawn only where the picture reaches so far."
    return (
        "<h3>Lengths</h3>"
        + chart(length_figure(run))
        + "<h3>Tensions</h3>"
        + paragraph(note)
        + chart(tension_figure(run))
    )


def _timing(run: RunData) -> str:
    note = ""
    if run.fast:
        note = paragraph(
            "Simulated time: a cycle follows the one before as soon as it is computed, so lateness"
            " has no meaning here. A run in real time shows it."
        )
    return note + chart(timing_figure(run))


def _footer(run: RunData) -> str:
    version = run.summary["versions"].get("cdpr")
    maker = f"cdpr {version}" if version else "cdpr"
    return f"Made by {maker} from the files of the run folder; times count from its start."


def _script(run: RunData, view: SceneView) -> str:
    data = {**viewer_data(run, view), "view": {"azimuth": AZIMUTH, "elevation": ELEVATION}}
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return (
        f'<script type="application/json" id="scene-data">{text}</script>'
        f"<script>{_read('viewer.js')}</script>"
    )
