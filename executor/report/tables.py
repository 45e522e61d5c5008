"""The plain facts of a run: plan, rig, bus, programs, events."""

from __future__ import annotations

import numpy as np

from cdpr.legs import legs_of
from cdpr.plan_file import OptimalPlannerDocument, PlannerDocument
from executor.fault_pages import page_of
from executor.pose_table import PoseTable
from executor.report.markup import known, list_table, table
from executor.report.run_data import RunData


def facts(run: RunData) -> str:
    """All tables, two beside each other where there is room."""
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
    """What was carried to each stop and on from it, and when; nothing without stops."""
    loads = [leg.scene.load.payload_mass for leg in legs_of(run.plan.scene)]
    rows = [
        (
            stop.name,
            stop.kind,
            ", ".join(f"{x * 1e3:.1f}" for x in stop.pose.position) + " mm",
            f"{before:g} → {after:g} kg",
            known(told["reached_s"], 2, "s"),
            known(told["left_s"], 2, "s"),
        )
        for stop, before, after, told in zip(
            run.plan.scene.stops, loads[:-1], loads[1:], run.summary["stops"], strict=True
        )
    ]
    head = ("Stop", "Kind", "Position", "Payload", "Reached", "Left")
    return list_table(head, rows) if rows else ""


def camera_table(run: RunData) -> str:
    """How each camera did; nothing of a run without one."""
    rows = [
        (
            one["name"],
            one["source"],
            f"{one['poses']} of {one['pictures']}",
            str(one["dropped"]),
            known(one["measuring_ms"], 1, "ms"),
            _alone(run.alone.get(one["name"])),
            one["failed"],
        )
        for one in run.summary["cameras"]
    ]
    head = ("Camera", "Source", "Poses", "Left out", "Time a picture", "Alone to plan", "Failed")
    return list_table(head, rows) if rows else ""


def _alone(poses: PoseTable | None) -> str:
    """How far one of several cameras saw the platform from the plan."""
    if poses is None or not poses.ok.any():
        return "–"
    return f"{float(np.sqrt(np.mean(poses.error[poses.ok] ** 2))) * 1e3:.2f} mm RMS"


def event_table(run: RunData) -> str:
    """What happened, in order."""
    rows = [(f"{e.time_s:.2f} s", e.code, e.text, page_of(e.code)) for e in run.events]
    return list_table(("Time", "Event", "Text", "More about it"), rows)


def _plan(run: RunData) -> list[tuple[str, str]]:
    document, scene = run.plan.document, run.plan.scene
    quality = document.quality
    rows = [
        ("Scene", scene.name),
        ("Obstacles", ", ".join(o.name for o in scene.obstacles) or "none"),
        ("Required clearance", f"{scene.obstacle_clearance * 1e3:g} mm"),
        ("Required self clearance", f"{scene.self_clearance * 1e3:g} mm"),
        ("Length", f"{quality.length_mm:.1f} mm (before smoothing {quality.raw_length_mm:.1f} mm)"),
        ("Corners", str(len(document.waypoints))),
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
    rows = _improving(planner) if isinstance(planner, OptimalPlannerDocument) else _tree(planner)
    return [
        *rows,
        ("Nodes", str(statistics.nodes)),
        ("Iterations", str(statistics.iterations)),
        ("Edge checks", str(statistics.edge_checks)),
        ("Planning time", f"{statistics.planning_time_s:.2f} s"),
    ]


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
