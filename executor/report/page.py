"""The page of a run: one HTML file that needs neither a server nor a network."""

from __future__ import annotations

from html import escape

from executor.report.figures import (
    clearance_figure,
    length_figure,
    position_figure,
    tension_figure,
    timing_figure,
)
from executor.report.run_data import RunData
from executor.report.scene import RunScene, run_scene, scene_viewer
from executor.report.tiles import (
    camera_table,
    chips,
    event_table,
    facts,
    fault_texts,
    frames,
    key_figures,
    stop_table,
    verdict_banner,
)
from model.pages.page import contents, paragraph, section
from model.pages.page import page as html_page
from model.pages.viewer import SCENE_SCRIPTS, page_data
from tracking.clearance import INTERVAL

_HINT = (
    "Charts: point or tap for values; drag, pinch or turn the wheel with Ctrl to zoom in time;"
    " double-click to see all again."
)
Section = tuple[str, str, str]


def page(run: RunData) -> str:
    """The whole page."""
    view = run_scene(run)
    sections = [part for part in _sections(run, view) if part[2]]
    title = f"Run of {run.plan.scene.name} on {run.rig.name}"
    parts = [verdict_banner(run.summary), key_figures(run.summary), paragraph(_HINT, "hint")]
    parts += [section(name, text, body) for name, text, body in sections]
    parts.append(f"<footer>{escape(_footer(run))}</footer>")
    lead = chips(run.summary) + contents((name, text) for name, text, _ in sections)
    scripts = ("charts.js", *SCENE_SCRIPTS)
    return html_page(
        title,
        "\n".join(parts),
        lead=lead,
        scripts=scripts,
        data=page_data(view.scene),
    )


def _sections(run: RunData, view: RunScene) -> list[Section]:
    moved = len(run.cycles) > 1
    return [
        ("scene", "Scene and path", _scene(run, view)),
        ("stops", "Stops", stop_table(run)),
        ("clearance", "Clearance", _clearance(run) if moved else ""),
        ("position", "Position", _position(run) if moved else ""),
        ("frames", "Images", frames(run)),
        ("cables", "Cables", _cables(run) if moved else ""),
        ("timing", "Following and timing", _timing(run) if moved else ""),
        ("facts", "Plan, rig and bus", facts(run)),
        ("events", "Events", event_table(run)),
        ("faults", "About the faults", fault_texts(run)),
    ]


def _scene(run: RunData, view: RunScene) -> str:
    text = ""
    if view.all_branches > view.branches:
        text = paragraph(f"{view.branches} of {view.all_branches} branches of the tree are drawn.")
    return text + scene_viewer(run, view)


def _clearance(run: RunData) -> str:
    if not len(run.clearance):
        return paragraph("The scene has no obstacles.")
    text = (
        f"Distances between surfaces. The shaded band is the {INTERVAL} of the measurement;"
        " planned is for the pose commanded at the same time."
    )
    return paragraph(text) + clearance_figure(run)


def _position(run: RunData) -> str:
    text = (
        "Encoders: the pose that fits the drives' actual positions. Camera: the pose of the tags."
    )
    if run.alone:
        text += " Fused: all cameras, weighted; the others are the poses of single cameras."
    return paragraph(text) + position_figure(run) + camera_table(run)


def _cables(run: RunData) -> str:
    upper = run.rig.max_tension
    note = f"The upper limit is {upper:g} N; it is drawn only where tensions come near it."
    return (
        "<h3>Lengths</h3>"
        + length_figure(run)
        + "<h3>Tensions</h3>"
        + paragraph(note)
        + tension_figure(run)
    )


def _timing(run: RunData) -> str:
    note = ""
    if run.fast:
        note = paragraph(
            "Simulated time: a cycle starts as soon as the previous one is computed, so lateness"
            " has no meaning. A run in real time shows it."
        )
    return note + timing_figure(run)


def _footer(run: RunData) -> str:
    version = run.summary["versions"].get("cdpr")
    maker = f"cdpr {version}" if version else "cdpr"
    return f"Made by {maker} from the files of the run folder; times count from its start."
