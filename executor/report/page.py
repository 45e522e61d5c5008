"""The page of a run and its 3-D scene: one HTML file that needs neither a server nor a network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from executor.recording.clearance import ClearanceTable
from executor.recording.summary import versions
from executor.report.figures import (
    clearance_figure,
    length_figure,
    position_figure,
    tension_figure,
    timing_figure,
)
from executor.report.run_data import RunData
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
from model.kinematics import cables_to
from model.pages.page import contents, paragraph, section
from model.pages.page import page as html_page
from model.pages.scene import (
    Label,
    Moment,
    SceneFigure,
    Stroke,
    frame_surface,
    grid_floor,
    obstacle_surfaces,
    platform_surface,
    workspace_stroke,
)
from model.pages.viewer import SCENE_SCRIPTS, page_data, viewer
from model.plan import Plan
from model.pose import Array, matrix_from_quaternion
from tracking.clearance import INTERVAL

MOST_MOMENTS = 400
MOST_SEEN = 900
"""Camera poses of the path that is drawn."""
MOST_BRANCHES = 4000
MOST_APART = 0.5
"""Largest time between a moment and the clearance shown with it, [s]."""
#: Layer, its name on the page, the colour's role, whether it is shown at first.
_LAYERS = (
    ("obstacles", "Obstacles", "obstacle", True),
    ("robot", "Platform and cables", "platform", True),
    ("numbers", "Cable numbers", "ink", True),
    ("frame", "Frame of outlets", "frame", True),
    ("floor", "Floor", "line", True),
    ("workspace", "Workspace", "muted", True),
    ("tree", "Search tree", "tree", True),
    ("raw", "Raw path", "raw", True),
    ("path", "Final path", "ink", True),
    ("driven", "Driven path", "encoder", True),
    ("seen", "Seen by the camera", "tag", True),
)


@dataclass(frozen=True, slots=True, eq=False)
class RunScene:
    """The scene of a run.

    Attributes:
        scene: What is drawn.
        floor_step: Distance of the floor's lines, [m].
        branches: Of the search tree that are drawn.
        all_branches: That the search had.
    """

    scene: SceneFigure
    floor_step: float
    branches: int
    all_branches: int


def run_scene(run: RunData) -> RunScene:
    """The scene of a run, with the platform at its start."""
    tree, branches = _tree(run)
    obstacles = obstacle_surfaces(run.plan.scene)
    frame = frame_surface(run.rig)
    strokes = (workspace_stroke(run.rig), Stroke("tree", "tree", tree, 1.0, 0.75), *_paths(run))
    fixed = [frame.vertices, *(one.vertices for one in obstacles)]
    fixed += [stroke.segments.reshape(-1, 3) for stroke in strokes]
    floor, step = grid_floor(np.concatenate(fixed))
    scene = SceneFigure(
        surfaces=(frame, *obstacles),
        strokes=(floor, *strokes),
        labels=plan_labels(run.plan),
        anchors=run.rig.anchors,
        platform=platform_surface(run.rig),
        moments=_motion(run),
    )
    return RunScene(scene, step, len(tree), branches)


def scene_viewer(run: RunData, view: RunScene) -> str:
    """The viewer with its still image; HTML."""
    scene = view.scene
    drawn = {stroke.layer for stroke in scene.strokes if len(stroke.segments)}
    drawn |= {surface.layer for surface in scene.surfaces} | {"robot", "numbers"}
    layers = [layer for layer in _LAYERS if layer[0] in drawn]
    return viewer(scene, _alternative(run), layers, f"Floor grid {view.floor_step * 1e3:g} mm.")


def _tree(run: RunData) -> tuple[Array, int]:
    """Branches of the search, at most `MOST_BRANCHES`, shape (b, 2, 3), [m]; how many it had."""
    document = run.plan.document.tree
    positions = np.asarray(document.positions_mm, dtype=np.float64).reshape(-1, 3) / 1e3
    parents = np.asarray(document.parents, dtype=np.int64)
    children = np.flatnonzero(parents >= 0)
    branches = np.stack([positions[parents[children]], positions[children]], axis=1)
    every = max(1, -(-len(branches) // MOST_BRANCHES))
    return branches[::every], len(branches)


def _paths(run: RunData) -> tuple[Stroke, ...]:
    raw = np.array([pose.position for pose in run.plan.raw_path])
    path = np.array([pose.position for pose in run.plan.waypoints])
    driven = run.cycles.encoder[_moments(run)]
    seen = run.poses.position[_evenly(np.flatnonzero(run.poses.ok), MOST_SEEN)]
    return (
        Stroke.along("seen", "tag", seen, 7.5, 0.6),
        Stroke.along("path", "ink", path, 4.5),
        Stroke.along("driven", "encoder", driven, 2.0),
        Stroke.along("raw", "raw", raw, 1.8),
    )


def plan_labels(plan: Plan) -> tuple[Label, ...]:
    """Start, stops and goal."""
    points = plan.waypoints
    stops = tuple(Label("path", s.name, s.pose.position, "dot") for s in plan.scene.stops)
    start = Label("path", "start", points[0].position, "ring")
    return (start, *stops, Label("path", "goal", points[-1].position, "dot"))


def _moments(run: RunData) -> NDArray[np.int64]:
    """Cycles at which the platform is drawn, shape (k,)."""
    return _evenly(np.flatnonzero(run.cycles.has_encoder_pose), MOST_MOMENTS)


def _evenly(rows: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """At most ``most`` rows, evenly spaced, the first and the last among them."""
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).astype(np.int64)]


def _motion(run: RunData) -> tuple[Moment, ...]:
    cycles, rig = run.cycles, run.rig
    measured = [run.clearance.of(source) for source in ("tag", "encoder")]
    found = []
    for row in _moments(run).tolist():
        time, position = float(cycles.time[row]), cycles.encoder[row]
        turn = matrix_from_quaternion(cycles.encoder_rotation[row])
        exits = rig.outlets
        if rig.pulley_radius:  # the cable leaves a pulley at another point in every pose
            exits = cables_to(rig, position + rig.anchors @ turn.T).exits
        found.append(Moment(time, position, turn, exits, _nearest(measured, time)))
    return tuple(found)


def _nearest(measured: Sequence[ClearanceTable], time: float) -> str:
    """The clearance at a time: the camera's within a step of the encoders' rows, else theirs."""
    camera, encoders = measured
    after = int(np.searchsorted(encoders.time, time))
    step = np.diff(encoders.time[max(after - 1, 0) : after + 1]).min(initial=MOST_APART)
    for clearance, within in ((camera, step), (encoders, MOST_APART)):
        if not len(clearance):
            continue
        near = int(np.argmin(np.abs(clearance.time - time)))
        if abs(clearance.time[near] - time) <= within:
            pair = f"{clearance.body[near]} – {clearance.obstacle[near]}"
            return f"clearance {clearance.distance[near] * 1e3:.1f} mm ({pair})"
    return ""


def _alternative(run: RunData) -> str:
    plan = run.plan
    names = ", ".join(o.name for o in plan.scene.obstacles) or "none"
    start, end = (np.round(p.position * 1e3) for p in (plan.waypoints[0], plan.waypoints[-1]))
    return (
        f"The frame with {run.rig.cable_count} cables, the obstacles ({names}), the search tree and"
        f" the path from {start.tolist()} to {end.tolist()} mm, with the platform where the run"
        " began."
    )


# The page.

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
        measured = "No clearance was measured." if run.plan.scene.obstacles else ""
        return paragraph(measured or "The scene has no obstacles.")
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
        text += " Cameras together: weighted; the others are the poses of single cameras."
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
    maker, runner = versions()["cdpr"], run.summary["versions"].get("cdpr")
    made = f"Made by cdpr {maker}"
    if runner not in (None, maker):
        made = f"Run with cdpr {runner}; page made by cdpr {maker}"
    return f"{made} from the files of the run folder; times count from its start."
