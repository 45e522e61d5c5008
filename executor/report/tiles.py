"""Verdict, key figures and tables of a run's page."""

from __future__ import annotations

import base64
from html import escape
from typing import Any

import numpy as np

from executor.recording.tables import PoseTable
from executor.recording.verdict import NOT_ENDED, as_sentence
from executor.report.run_data import RunData, markdown, missing_images
from executor.safety.fault_messages import faults_among, page_of, page_text
from model.files.plan_file import OptimalPlannerDocument, PlannerDocument, WaypointsDocument
from model.files.reading import is_too_large
from model.pages.page import known, list_table, paragraph, prose, table, tile, tiles
from model.plan import raw_length_text
from model.scene import legs_of
from tracking.clearance import INTERVAL

_CLASS = {"PASSED": "pass", "STOPPED": "stop"}


def verdict_banner(summary: dict[str, Any]) -> str:
    """The verdict as a word, a sentence and its checks."""
    checks = "".join(_check(check) for check in summary["checks"])
    return (
        f'<section class="verdict {_CLASS.get(summary["verdict"], "fail")}" id="verdict">'
        f"<h2>{escape(summary['verdict'])}</h2>"
        f'<p class="sentence">{escape(summary["sentence"])}</p>'
        f'<ul class="checks">{checks}</ul></section>'
    )


def _check(check: dict[str, Any]) -> str:
    sign, name, word = ("✓", "yes", "met") if check["passed"] else ("✗", "no", "not met")
    return (
        f'<li><span class="mark {name}" role="img" aria-label="{word}">{sign}</span>'
        f"<span>{prose(check['text'])}</span></li>"
    )


def chips(summary: dict[str, Any]) -> str:
    """Properties of the run, in a few words each."""
    drives = "simulated drives" if summary["simulated"] else "real drives"
    time = "simulated time" if summary["fast"] else "real time"
    words = [summary["started"].replace("T", " ").split(".")[0] + " UTC"]
    words += [
        f"{drives}, bus {summary['interface']}",
        f"{time}, {summary['cycle_ms']:g} ms a cycle",
    ]
    if summary["tag_error_mm"] is not None:
        words.append("camera and tags")
    elif summary["cameras"]:
        words.append("camera without images")
    elif summary["final_state"] != NOT_ENDED:  # else a killed run's cameras are not on record
        words.append("no camera")
    return f'<ul class="chips">{"".join(f"<li>{escape(word)}</li>" for word in words)}</ul>'


def key_figures(summary: dict[str, Any]) -> str:
    """The most important figures."""
    parts = [
        tile("Path", known(summary["path_length_mm"], 0, "mm"), _path_note(summary)),
        *_clearance(summary["clearance_mm"]),
        _following(summary["following_error_mm"]),
        *_camera(summary["tag_error_mm"]),
        _tension(summary["tension_n"]),
        tile("Replies lost", str(summary["lost_replies"]), f"in {summary['cycles']} cycles"),
        *_lateness(summary["lateness_ms"]),
    ]
    return tiles(parts)


def _path_note(summary: dict[str, Any]) -> str:
    return (
        f"{known(summary['travelled_mm'], 0, 'mm')} driven, {summary['duration_s']:.1f} s recorded"
    )


def _clearance(key: dict[str, Any] | None) -> list[str]:
    if key is None:
        return []
    by = "camera" if key["source"] == "tag" else "drives"
    note = (
        f"{INTERVAL} {_span(key)} mm by the {by};"
        f" planned {known(key['planned_min'], 1, '')}, required {key['required']:g}"
    )
    return [tile("Smallest clearance", known(key["measured_min"], 1, "mm"), note)]


def _span(key: dict[str, Any]) -> str:
    """Bounds of the smallest true clearance."""
    if key["measured_min"] is None:
        return "–"
    low = key["measured_min"] - key["measured_uncertainty"]
    return f"{low:.1f} to {key['measured_at_most']:.1f}"


def _following(key: dict[str, Any]) -> str:
    text = known(key["max"], 3, "mm")
    if text.startswith("0.000"):
        text = "<\u00a00.001 mm"
    return tile("Following error", text, f"largest; limit {key['limit']:g} mm")


def _camera(key: dict[str, Any] | None) -> list[str]:
    if key is None:
        return []
    seen = key["frames"] - key["frames_without_pose"]
    note = f"RMS; largest {known(key['max'], 2, 'mm')}, {seen} of {key['frames']} images"
    return [tile("Camera to plan", known(key["rms"], 2, "mm"), note)]


def _tension(key: dict[str, Any]) -> str:
    note = f"limits {key['lower_limit']:g} to {key['upper_limit']:g} N"
    if key["min"] is None:
        return tile("Tension", "– N", note)
    return tile("Tension", f"{key['min']:.1f}–{key['max']:.1f} N", note)


def _lateness(key: dict[str, Any] | None) -> list[str]:
    if key is None:
        return []
    note = f"99 % of cycles; largest {known(key['max'], 2, 'ms')}"
    return [tile("Lateness", known(key["p99"], 2, "ms"), note)]


# Tables of a run: plan, rig, bus, programs, events.


def facts(run: RunData) -> str:
    """All tables, in two columns where there is room."""
    parts = [
        ("Plan", _plan(run)),
        ("Search", _search(run)),
        ("Rig", _rig(run)),
        ("Run and bus", _bus(run)),
        ("Programs", sorted(run.summary["versions"].items())),
    ]
    blocks = "".join(f"<div><h3>{title}</h3>{table(rows)}</div>" for title, rows in parts if rows)
    return f'<div class="tables">{blocks}</div>'


def stop_table(run: RunData) -> str:
    """Payload and times at each stop; empty without stops."""
    loads = [leg.scene.load.payload_mass for leg in legs_of(run.plan.scene)]
    rows = [
        (
            stop.name,
            stop.kind,
            ", ".join(f"{x * 1e3:z.1f}" for x in stop.pose.position) + " mm",
            f"{before:g} → {after:g} kg",
            known(times["reached_s"], 2, "s"),
            known(times["left_s"], 2, "s"),
        )
        for stop, before, after, times in zip(
            run.plan.scene.stops, loads[:-1], loads[1:], run.summary["stops"], strict=True
        )
    ]
    head = ("Stop", "Kind", "Position", "Payload", "Reached", "Left")
    return list_table(head, rows) if rows else ""


def camera_table(run: RunData) -> str:
    """Statistics of each camera; empty without a camera."""
    rows = [
        (
            one["name"],
            one["source"],
            f"{one['poses']} of {one['pictures']}",
            str(one["dropped"]),
            known(one["measuring_ms"], 1, "ms"),
            _alone(run, one["name"]),
            one["failed"],
        )
        for one in run.summary["cameras"]
    ]
    head = ("Camera", "Source", "Poses", "Dropped", "Time per image", "Alone to plan", "Failed")
    return list_table(head, rows) if rows else ""


def _alone(run: RunData, camera: str) -> str:
    """Distance of one camera's poses from the plan, along the path as in the summary."""
    poses = run.alone.get(camera, PoseTable.empty())
    error = poses.error[poses.ok & (poses.time >= run.cycles.path_began)]
    return f"{float(np.sqrt(np.mean(error**2))) * 1e3:.2f} mm RMS" if len(error) else "–"


def event_table(run: RunData) -> str:
    """All events, in order."""
    rows = [(f"{e.time_s:.2f} s", e.code, e.text, page_of(e.code)) for e in run.events]
    head = ("Time", "Event", "Text", "More about it")
    # An empty column wastes room in a narrow window.
    shown = 4 if any(row[-1] for row in rows) else 3
    return list_table(head[:shown], [row[:shown] for row in rows])


def fault_texts(run: RunData) -> str:
    """Collapsed pages about the faults among the events; empty without a fault."""
    pages = [page_text(code).split("\n", 1) for code in faults_among(e.code for e in run.events)]
    return "".join(
        f"<details><summary>{escape(title.removeprefix('# '))}</summary>{markdown(text)}</details>"
        for title, text in pages
    )


def _plan(run: RunData) -> list[tuple[str, str]]:
    document, scene = run.plan.document, run.plan.scene
    quality = document.quality
    rows = [
        ("Scene", scene.name),
        ("Obstacles", ", ".join(o.name for o in scene.obstacles) or "none"),
        ("Required clearance", f"{scene.obstacle_clearance * 1e3:g} mm"),
        ("Required self clearance", f"{scene.self_clearance * 1e3:g} mm"),
        (
            "Length without rotation" if scene.rotation_limits else "Length",
            f"{quality.length_mm:.1f} mm ({raw_length_text(document)})",
        ),
        ("Waypoints", str(len(document.waypoints))),
    ]
    if quality.obstacle_clearance is not None:
        near = quality.obstacle_clearance
        text = f"{near.distance_mm:.2f} mm ({near.first} to {near.second})"
        rows.append(("Clearance found by the planner", text))
    near = quality.self_clearance
    rows += [
        ("Self clearance", f"{near.distance_mm:.2f} mm ({near.first} to {near.second})"),
        ("Mean kinematic cost", f"{quality.mean_kinematic_cost:.4f}"),
        ("Tensions", f"{quality.min_tension_n:.1f} to {quality.max_tension_n:.1f} N"),
        ("Plan hash", _short(document.hash)),
    ]
    return rows


def _search(run: RunData) -> list[tuple[str, str]]:
    planner, statistics = run.plan.document.planner, run.plan.document.statistics
    return [
        *_planner(planner),
        ("Nodes", str(statistics.nodes)),
        ("Iterations", str(statistics.iterations)),
        ("Edge checks", str(statistics.edge_checks)),
        ("Planning time", f"{statistics.planning_time_s:.2f} s"),
    ]


def _planner(
    planner: OptimalPlannerDocument | PlannerDocument | WaypointsDocument,
) -> list[tuple[str, str]]:
    match planner:
        case OptimalPlannerDocument():
            return _improving(planner)
        case PlannerDocument():
            return _tree(planner)
        case WaypointsDocument(author=author):
            return [("Planner", author or "user's waypoints")]


def _improving(planner: OptimalPlannerDocument) -> list[tuple[str, str]]:
    weights = planner.weights.model_dump()
    asked = ", ".join(f"{name} {weight:g}" for name, weight in weights.items() if weight > 0.0)
    name = "optimal, free to turn" if planner.name == "turning" else planner.name
    rows = [("Planner", name), ("Weights", asked), ("Seed", str(planner.seed))]
    if planner.longest_mm is not None:
        rows.append(("Longest path allowed", f"{planner.longest_mm:g} mm"))
    return rows


def _tree(planner: PlannerDocument) -> list[tuple[str, str]]:
    return [
        ("Sampling", planner.name),
        ("Cost", planner.cost),
        ("Mode", planner.mode),
        ("Seed", str(planner.seed)),
        ("Step", f"{planner.step_mm:g} mm"),
        ("Neighbour radius", f"{planner.neighbour_radius_mm:g} mm"),
        ("Goal radius", f"{planner.goal_radius_mm:g} mm"),
        ("Most iterations", str(planner.max_iterations)),
    ]


def _rig(run: RunData) -> list[tuple[str, str]]:
    rig = run.rig
    motion = rig.motion
    return [
        ("Name", rig.name),
        ("Description", rig.document.description or "–"),
        ("Cables", str(rig.cable_count)),
        ("Platform", f"{' × '.join(f'{x * 2e3:g}' for x in rig.half_size)} mm, {rig.mass:g} kg"),
        ("Exits", f"pulleys of {rig.pulley_radius * 1e3:g} mm" if rig.pulley_radius else "points"),
        ("Tension limits", f"{rig.min_tension:g} to {rig.max_tension:g} N"),
        ("Speed", f"{motion.speed * 1e3:g} mm/s"),
        ("Acceleration, jerk", f"{motion.acceleration * 1e3:g} mm/s², {motion.jerk * 1e3:g} mm/s³"),
        ("Corner rounding", f"within {motion.blend_tolerance * 1e3:g} mm"),
        ("Rig hash", _short(rig.hash)),
    ]


def _bus(run: RunData) -> list[tuple[str, str]]:
    summary, bus = run.summary, run.rig.document.bus
    late = summary["lateness_ms"]
    lateness = "not measured: the time was simulated"
    if late is not None and late["max"] is not None:
        lateness = f"p50 {late['p50']:.3f}, p99 {late['p99']:.3f}, largest {late['max']:.3f} ms"
    return [
        ("Drives", "simulated" if summary["simulated"] else "real"),
        ("Interface", summary["interface"]),
        ("Protocol", f"{run.rig.document.drives.type}, {bus.bitrate // 1000} kbit/s"),
        ("Cycle", f"{summary['cycle_ms']:g} ms"),
        ("Cycles", str(summary["cycles"])),
        ("Replies lost", str(summary["lost_replies"])),
        ("Frames rejected", str(summary["rejected_frames"])),
        ("Error frames", str(summary["error_frames"])),
        ("Lateness", lateness),
        ("Duration", f"{summary['duration_s']:.2f} s"),
        ("Final state", summary["final_state"]),
    ]


def _short(digest: str) -> str:
    kind, _, value = digest.partition(":")
    return f"{kind}:{value[:16]}…" if value else digest


# Images of the run with their measurements (paper, Fig. 12).


COUNT = 6
WIDEST = 960
_QUALITY = 80


def frames(run: RunData) -> str:
    """Up to six images, evenly spread over the kept ones, and how many are missing."""
    missing = missing_images(run.folder, (run.poses, *run.alone.values()))
    note = paragraph(as_sentence(missing)) if missing else ""
    names = run.poses.picture
    kept = [i for i, name in enumerate(names) if name and run.folder.has_image(name)]
    if not kept:
        return note
    indices = np.unique(np.linspace(0, len(kept) - 1, min(COUNT, len(kept))).astype(int))
    figures = "".join(_figure(run, kept[k]) for k in indices.tolist())
    return f'{note}<div class="frames">{figures}</div>'


def _figure(run: RunData, row: int) -> str:
    poses = run.poses
    time = f"{round(float(poses.time[row]), 1) + 0.0:.1f} s"  # not -0.0
    data = base64.b64encode(_smaller(run.folder.image(poses.picture[row]))).decode()
    return (
        f'<figure><img src="data:image/jpeg;base64,{data}" alt="Camera image after {time}">'
        f"<figcaption><b>{time}</b> {prose(_clearance_frame(run, row))}<br>"
        f"{prose(_measured(run, row))}</figcaption></figure>"
    )


def _clearance_frame(run: RunData, row: int) -> str:
    rows = run.clearance.of("tag")
    near = np.flatnonzero(np.abs(rows.time - run.poses.time[row]) < 1e-3)
    if not near.size:
        return ""
    k = int(near[0])
    distance, spread, at_most, planned = (
        float(values[k]) * 1e3
        for values in (rows.distance, rows.uncertainty, rows.at_most, rows.planned_distance)
    )
    span = f"{distance - spread:.1f} to {at_most:.1f}"
    return f"clearance {distance:.1f} mm, {INTERVAL} {span} (plan {planned:.1f})"


def _measured(run: RunData, row: int) -> str:
    poses = run.poses
    if not poses.ok[row]:
        return f"No pose: {poses.status[row]}"
    position = ", ".join(f"{value * 1e3:.1f}" for value in poses.position[row])
    tags = len(poses.tags[row].split())
    error = float(poses.error[row]) * 1e3
    return f"{position} mm · {error:.2f} mm from the plan · {tags} tag{'s' if tags != 1 else ''}"


def _smaller(jpeg: bytes) -> bytes:
    """The same image, at most ``WIDEST`` wide, so that the page stays small."""
    import cv2

    if not jpeg or is_too_large(jpeg):
        return b""
    try:
        image = cv2.imdecode(np.frombuffer(jpeg, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return b""
    if image is None or image.shape[1] <= WIDEST:
        return jpeg
    height = round(image.shape[0] * WIDEST / image.shape[1])
    small = cv2.resize(image, (WIDEST, height), interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return data.tobytes() if done else jpeg
