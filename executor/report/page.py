"""The page of a run: one HTML file that needs neither a server nor a network."""

from __future__ import annotations

import re
from dataclasses import dataclass
from html import escape
from typing import Any

from executor.recording.clearance import ClearanceTable
from executor.recording.record_files import AGAIN
from executor.recording.run_folder import RunEvent, RunFolder
from executor.recording.tables import CycleTable, PoseTable
from executor.report.figures import (
    clearance_figure,
    length_figure,
    position_figure,
    tension_figure,
    timing_figure,
)
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
from model.errors import BadInput
from model.pages.page import contents, paragraph, prose, section
from model.pages.page import page as html_page
from model.pages.viewer import SCENE_SCRIPTS, page_data
from model.plan import Plan
from model.rig import Rig
from tracking.clearance import INTERVAL


@dataclass(frozen=True, slots=True, eq=False)
class RunData:
    """A run as on disk; ``alone`` has the poses of each of several cameras, by name."""

    folder: RunFolder
    plan: Plan
    rig: Rig
    cycles: CycleTable
    poses: PoseTable
    alone: dict[str, PoseTable]
    clearance: ClearanceTable
    summary: dict[str, Any]
    events: tuple[RunEvent, ...]

    @property
    def fast(self) -> bool:
        """Whether time was simulated."""
        return bool(self.summary["fast"])


def read_run(folder: RunFolder) -> RunData:
    """Reads a run folder.

    Raises:
        BadInput: A file of it is missing or was changed.
    """
    run = RunData(
        folder=folder,
        plan=folder.plan(),
        rig=folder.rig(),
        cycles=folder.cycles(),
        poses=folder.poses(),
        alone=folder.poses_by_camera(),
        clearance=folder.clearance(),
        summary=folder.summary(),
        events=tuple(folder.events()),
    )
    _require_agreement(run)
    return run


def _require_agreement(run: RunData) -> None:
    """Requires files of one run: the same stops."""
    stops = [stop.name for stop in run.plan.scene.stops]
    found = [stop["name"] for stop in run.summary["stops"]]
    if found != stops:
        raise BadInput(
            f"summary.json has the stops {found}, plan.json {stops}",
            where=str(run.folder.path),
            why="files of different runs are mixed",
            next_step=AGAIN,
        )


# Markdown of the pages about faults.


def markdown(text: str) -> str:
    """Renders the Markdown of fault pages: headings, paragraphs, code and emphasis."""
    parts = []
    for block in filter(None, map(str.strip, text.split("\n\n"))):
        kind, content = ("h3", block[3:]) if block.startswith("## ") else ("p", block)
        content = re.sub(r"`([^`]+)`", r"<code>\1</code>", prose(" ".join(content.split())))
        content = re.sub(r"\*([^*]+)\*", r"<em>\1</em>", content)
        parts.append(f"<{kind}>{content}</{kind}>")
    return "".join(parts)


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
