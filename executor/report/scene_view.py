"""The 3-D scene of a run as plain data, for the page's viewer and for the still picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cdpr.cables import cables_to
from cdpr.poses import Array, Pose, matrix_from_quaternion
from cdpr.rig import Rig
from cdpr.shapes import Obstacle, convex_hull
from executor.report.run_data import RunData
from executor.solids import Solid, box_solid, solid_of

MOST_MOMENTS = 400
MOST_BRANCHES = 4000


@dataclass(frozen=True, slots=True, eq=False)
class SceneView:
    """What can be seen of a run; all in the world frame, [m].

    Attributes:
        obstacles: Names and surfaces.
        frame: Surface that spans the outlets; only its edges are drawn.
        outlets: Shape (m, 3).
        workspace: The box that the platform's origin keeps within.
        tree: Branches of the search, shape (b, 2, 3).
        all_branches: How many branches the search had; ``tree`` may hold fewer.
        raw: Path before post-processing, shape (r, 3).
        path: Corners of the final path, shape (w, 3).
        driven: Track of the platform by the drives, shape (k, 3).
        seen: Track of the platform by the camera, shape (p, 3).
        moments: Cycles at which the platform is drawn, shape (k,).
        platform: Its surface in its own frame.
    """

    obstacles: tuple[tuple[str, Solid], ...]
    frame: Solid
    outlets: Array
    workspace: Solid
    tree: Array
    all_branches: int
    raw: Array
    path: Array
    driven: Array
    seen: Array
    moments: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    platform: Solid


def scene_view(run: RunData) -> SceneView:
    """What can be seen of a run."""
    rig, plan = run.rig, run.plan
    tree, branches = _tree(run)
    moments = _moments(run)
    centre = (rig.workspace_upper + rig.workspace_lower) / 2.0
    workspace = box_solid((rig.workspace_upper - rig.workspace_lower) / 2.0, Pose.level(centre))
    return SceneView(
        obstacles=tuple((o.name, solid_of(o)) for o in plan.scene.obstacles),
        frame=_frame(rig),
        outlets=rig.outlets,
        workspace=workspace,
        tree=tree,
        all_branches=branches,
        raw=np.array([pose.position for pose in plan.raw_path]),
        path=np.array([pose.position for pose in plan.waypoints]),
        driven=run.cycles.encoder[moments],
        seen=run.poses.position[run.poses.ok],
        moments=moments,
        platform=box_solid(rig.half_size),
    )


def _frame(rig: Rig) -> Solid:
    try:
        hull = convex_hull(rig.outlets)
    except ValueError:  # all outlets at one height: the frame stands on the floor
        hull = convex_hull(np.vstack([rig.outlets, rig.outlets * [1.0, 1.0, 0.0]]))
    return solid_of(Obstacle("frame", hull, Pose.level(np.zeros(3))))


def _tree(run: RunData) -> tuple[Array, int]:
    document = run.plan.document.tree
    positions = np.asarray(document.positions_mm, dtype=np.float64).reshape(-1, 3) / 1e3
    parents = np.asarray(document.parents, dtype=np.int64)
    children = np.flatnonzero(parents >= 0)
    branches = np.stack([positions[parents[children]], positions[children]], axis=1)
    every = max(1, -(-len(branches) // MOST_BRANCHES))
    return branches[::every], len(branches)


def _moments(run: RunData) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    known = np.isfinite(run.cycles.encoder).all(axis=1)
    known &= np.isfinite(run.cycles.encoder_rotation).all(axis=1)
    rows = np.flatnonzero(known)
    if len(rows) <= MOST_MOMENTS:
        return rows
    return rows[np.linspace(0, len(rows) - 1, MOST_MOMENTS).astype(np.int64)]


def viewer_data(run: RunData, view: SceneView) -> dict[str, Any]:
    """The same for the page's viewer: mm, flat lists, times in s."""
    return {
        "obstacles": [{"name": name, **_solid(solid)} for name, solid in view.obstacles],
        "frame": _solid(view.frame),
        "workspace": _solid(view.workspace),
        "platform": _solid(view.platform),
        "outlets": _mm(view.outlets),
        "tree": _mm(view.tree.reshape(-1, 6)),
        "raw": _mm(view.raw),
        "path": _mm(view.path),
        "driven": _mm(view.driven),
        "seen": _mm(view.seen),
        "anchors": _mm(run.rig.anchors),
        "moments": _motion(run, view),
    }


def _solid(solid: Solid) -> dict[str, Any]:
    return {"vertices": _mm(solid.vertices), "faces": solid.faces, "edges": solid.edges}


def _mm(values: Array) -> list[list[float]]:
    rows: list[list[float]] = np.round(values * 1e3, 1).tolist()
    return rows


def _motion(run: RunData, view: SceneView) -> list[dict[str, Any]]:
    cycles, rig = run.cycles, run.rig
    by_tags, by_drives = run.clearance.of("tag"), run.clearance.of("encoder")
    clearance = by_tags if len(by_tags) else by_drives
    found = []
    for row in view.moments.tolist():
        time, position = float(cycles.time[row]), cycles.encoder[row]
        turn = matrix_from_quaternion(cycles.encoder_rotation[row])
        moment: dict[str, Any] = {
            "t": round(time, 3),
            "p": np.round(position * 1e3, 1).tolist(),
            "r": np.round(turn, 5).reshape(-1).tolist(),
        }
        if rig.pulley_radius:  # the cable leaves a pulley at another point in every pose
            moment["exits"] = _mm(cables_to(rig, position + rig.anchors @ turn.T).exits)
        if len(clearance):
            near = int(np.argmin(np.abs(clearance.time - time)))
            moment["clearance"] = round(float(clearance.distance[near]) * 1e3, 1)
            moment["to"] = f"{clearance.body[near]} – {clearance.obstacle[near]}"
        found.append(moment)
    return found
