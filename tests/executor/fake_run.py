"""A run made from formulas: environment 3 along a hand-made path, with small known errors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from executor.recording.clearance import ClearanceTable
from executor.recording.mcap import write_mcap
from executor.recording.record_files import RunCourse
from executor.recording.run_folder import RunEvent, RunFolder
from executor.recording.summary import summarize
from executor.recording.tables import CycleTable, PoseTable, fused_table
from executor.recording.verdict import RunContext
from model.clearance import ClearanceModel
from model.files.documents import PoseDocument
from model.files.plan_file import PlanDocument
from model.kinematics import cables_to
from model.plan import Plan, plan_from_document, sealed
from model.pose import Array, Pose
from model.rig import Rig, load_rig
from model.scene import Scene, load_scene
from model.statics.gravity import working_tensions

ROOT = Path(__file__).parents[2]
CORNERS_MM = [
    [180.0, 180.0, 300.0],
    [145.0, 147.0, 481.0],
    [50.0, 90.0, 579.0],
    [-96.0, 60.0, 634.0],
    [-154.0, -113.0, 537.0],
    [-164.0, -144.0, 477.0],
    [-180.0, -180.0, 400.0],
]
SPEED, ACCELERATION, CYCLE = 0.020, 0.1, 0.010
TAG_STD = 0.0003


@dataclass(frozen=True)
class FakeRun:
    """Data of a run folder."""

    context: RunContext
    cycles: CycleTable
    poses: PoseTable
    clearance: ClearanceTable

    @property
    def summary(self) -> dict[str, object]:
        return summarize(self.context, self.cycles, self.poses, self.clearance)


def write(run: FakeRun, path: Path, pictures: bool = True) -> RunFolder:
    """The run as a folder, without its report."""
    folder = RunFolder.create(path)
    folder.write_plan(run.context.plan.document)
    folder.write_rig(run.context.rig.document)
    course = run.context.course
    folder.write_course(
        RunCourse(
            *(course.started, "virtual", True, True, "finished", "", len(run.cycles)),
            cameras=course.cameras,
        )
    )
    poses = run.poses
    if pictures:
        rows = set(range(0, len(poses), 20))
        names = [
            folder.write_image(int(poses.frame[k]), picture(poses.position[k])) if k in rows else ""
            for k in range(len(poses))
        ]
        poses = replace(poses, picture=tuple(names))
    folder.write_table("cycles.csv", run.cycles)
    folder.write_table("poses.csv", poses)
    folder.write_table("clearance.csv", run.clearance)
    for event in run.context.events:
        folder.append_event(event)
    folder.write_summary(run.summary)
    write_mcap(
        folder, run.context, run.cycles, poses, run.clearance, fused_table(run.cycles, poses), {}
    )
    return folder


def changed(context: RunContext, **changes: Any) -> RunContext:
    """Another context: plan, rig, events, or a part of its course."""
    own = {name: changes.pop(name) for name in ("plan", "rig", "events") if name in changes}
    return replace(context, course=replace(context.course, **changes), **own)


@lru_cache(maxsize=4)
def make(rate_hz: float = 10.0, every: int = 1, camera: bool = True) -> FakeRun:
    """The run; ``every`` is the interval of kept cycles."""
    rig, scene = (
        load_rig(ROOT / "configs/gachon_8_6.yaml"),
        load_scene(ROOT / "configs/environment_3.yaml"),
    )
    plan = make_plan(rig, scene)
    cycles = _cycles(rig, scene, every)
    poses = _poses(cycles, rate_hz if camera else 0.0)
    clearance = _clearance(rig, scene, cycles, poses, rate_hz)
    events = (
        RunEvent(0.0, "armed", "Eight drives are enabled and hold."),
        RunEvent(0.05, "moving", "The platform moves along the path."),
        RunEvent(float(cycles.time[-1]), "finished", "The platform is at the goal."),
    )
    context = RunContext(
        plan=plan,
        rig=rig,
        course=RunCourse(
            datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC),
            interface="virtual",
            simulated=True,
            fast=True,
            final_state="finished",
            versions={"cdpr": "0.1.0", "numpy": np.__version__},
        ),
        events=events,
    )
    return FakeRun(context, cycles, poses, clearance)


def make_plan(rig: Rig, scene: Scene) -> Plan:
    """The hand-made path with a random tree about it."""
    random = np.random.default_rng(1)
    nodes, parents = [np.array(CORNERS_MM[0])], [-1]
    while len(nodes) < 400:
        aim = random.uniform([-250, -250, 150], [250, 250, 650])
        near = int(np.argmin(np.linalg.norm(np.array(nodes) - aim, axis=1)))
        step = aim - nodes[near]
        nodes.append(nodes[near] + step * min(1.0, 40.0 / float(np.linalg.norm(step))))
        parents.append(near)
    corners = np.array(CORNERS_MM)
    length = float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
    raw = np.vstack([corners[0], *[_between(a, b, random) for a, b in pairwise(corners)]])
    document = sealed(
        {
            "rig_hash": rig.plan_hash,
            "scene_hash": scene.hash,
            "rig": rig.document,
            "scene": scene.document,
            "planner": {
                "name": "adaptive",
                "cost": "kinematic",
                "mode": "rewire",
                "seed": 7,
                "step_mm": 40.0,
                "neighbour_radius_mm": 80.0,
                "goal_radius_mm": 50.0,
                "max_iterations": 5000,
            },
            "waypoints": [PoseDocument(position_mm=list(c)) for c in CORNERS_MM],
            "raw_path": [PoseDocument(position_mm=[float(x) for x in p]) for p in raw],
            "tree": {"positions_mm": [[float(x) for x in n] for n in nodes], "parents": parents},
            "statistics": {
                "nodes": 400,
                "iterations": 1234,
                "edge_checks": 5678,
                "planning_time_s": 1.25,
            },
            "quality": {
                "length_mm": length,
                "raw_length_mm": length * 1.1,
                "mean_kinematic_cost": 0.5,
                "min_tension_n": 5.0,
                "max_tension_n": 40.0,
                "obstacle_clearance": {
                    "first": "cable 3",
                    "second": "obstacle_1",
                    "distance_mm": 12.5,
                    "position_mm": CORNERS_MM[2],
                },
                "self_clearance": {
                    "first": "cable 1",
                    "second": "cable 5",
                    "distance_mm": 11.5,
                    "position_mm": CORNERS_MM[1],
                },
            },
        }
    )
    return plan_from_document(PlanDocument.model_validate(document.model_dump(mode="json")))


def _between(a: Array, b: Array, random: np.random.Generator) -> Array:
    count = max(2, int(np.linalg.norm(b - a) // 40))
    points = a + np.linspace(0, 1, count + 1)[1:, None] * (b - a)
    points[:-1] += random.normal(0, 8, (count - 1, 3))
    return points


def _travelled(length: float) -> Array:
    ramp = SPEED / ACCELERATION
    time = np.arange(0.0, length / SPEED + ramp + CYCLE, CYCLE)
    end = length / SPEED + ramp
    rising = 0.5 * ACCELERATION * np.minimum(time, ramp) ** 2
    level = SPEED * np.clip(time - ramp, 0.0, end - 2 * ramp)
    falling = np.clip(time - (end - ramp), 0.0, ramp)
    return rising + level + SPEED * falling - 0.5 * ACCELERATION * falling**2


def _cycles(rig: Rig, scene: Scene, every: int) -> CycleTable:
    corners = np.array(CORNERS_MM) / 1e3
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    travelled = _travelled(float(at[-1]))[::every]
    n, m = len(travelled), rig.cable_count
    planned = np.column_stack([np.interp(travelled, at, corners[:, i]) for i in range(3)])
    wave = np.sin(np.arange(n)[:, None] * CYCLE * every * np.array([3.0, 4.1, 2.3]))
    encoder = planned + 2e-5 * wave
    lengths = cables_to(rig, encoder[:, None] + rig.anchors).lengths
    wanted = cables_to(rig, planned[:, None] + rig.anchors).lengths
    counts = np.array([w.counts_per_metre for w in rig.winches])
    home = cables_to(rig, rig.home.apply(rig.anchors)).lengths
    some = np.linspace(0, n - 1, 60).astype(int)
    solved = np.array(
        [working_tensions(rig, Pose.level(p), scene.load).tensions for p in planned[some]]
    )
    tensions = np.column_stack([np.interp(np.arange(n), some, solved[:, i]) for i in range(m)])
    noise = np.random.default_rng(2).normal(0.0, 0.1, (n, m))
    return CycleTable(
        cycle=np.arange(n),
        time=np.arange(n) * CYCLE * every,
        state=("moving",) * (n - 1) + ("finished",),
        path_index=np.arange(n) * every,
        leg=np.ones(n, dtype=np.int64),
        stop=("",) * n,
        travelled=travelled,
        lateness=np.zeros(n),
        missing=np.zeros(n, dtype=np.int64),
        rejected=np.zeros(n, dtype=np.int64),
        error_frames=np.zeros(n, dtype=np.int64),
        planned=planned,
        planned_rotation=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        encoder=encoder,
        encoder_rotation=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        following_error=np.max(np.abs(lengths - wanted), axis=1),
        set_counts=np.rint((wanted - home) * counts).astype(np.int64),
        actual_counts=np.rint((lengths - home) * counts).astype(np.int64),
        lengths=lengths,
        planned_tensions=tensions,
        tensions=tensions + noise,
    )


def _poses(cycles: CycleTable, rate_hz: float) -> PoseTable:
    count = int(cycles.time[-1] * rate_hz)
    time = np.arange(count) / rate_hz if count else np.empty(0)
    planned = np.column_stack(
        [np.interp(time, cycles.time, cycles.planned[:, i]) for i in range(3)]
    )
    noise = np.random.default_rng(3).normal(0.0, TAG_STD, (count, 3))
    lost = np.arange(count) % 50 == 49
    position = np.where(lost[:, None], np.nan, planned + noise)
    square = np.diag([TAG_STD**2] * 3 + [1e-3**2] * 3)
    square[0, 4] = square[4, 0] = 2e-8
    return PoseTable(
        frame=np.arange(count),
        time=time,
        status=tuple("no tags seen, 2 needed" if k else "ok" for k in lost),
        position=position,
        rotation=np.where(lost[:, None], np.nan, np.array([1.0, 0.0, 0.0, 0.0])),
        covariance=np.where(lost[:, None, None], np.nan, square),
        tags=tuple("" if k else "301 303 305" for k in lost),
        reprojection=np.where(lost, np.nan, 0.05),
        planned=planned,
        picture=("",) * count,
    )


def _clearance(
    rig: Rig, scene: Scene, cycles: CycleTable, poses: PoseTable, rate_hz: float
) -> ClearanceTable:
    time = np.arange(0.0, cycles.time[-1], 1.0 / rate_hz)
    model = ClearanceModel(rig, scene)
    some = time[::4]
    nearest = [model.obstacles(Pose.level(_at(cycles, t))) for t in some]
    exact = np.array([[n.distance for n in pose] for pose in nearest])
    bodies = np.array([min(pose, key=lambda n: n.distance).first for pose in nearest])
    planned = np.column_stack([np.interp(time, some, exact[:, i]) for i in range(exact.shape[1])])
    seen = np.flatnonzero(poses.ok)
    tag = planned[seen] + 0.0004 * np.sin(5.0 * time[seen])[:, None]
    rows = np.vstack([planned, tag])
    wanted = np.vstack([planned, planned[seen]])
    times = np.concatenate([time, time[seen]])
    closest = np.argmin(rows, axis=1)
    spread = np.concatenate([np.full(len(time), 5e-5), np.full(len(seen), 0.0009)])
    return ClearanceTable(
        time=times,
        source=("encoder",) * len(time) + ("tag",) * len(seen),
        distance=rows.min(axis=1),
        uncertainty=spread,
        at_most=rows.min(axis=1) + spread,
        body=tuple(str(bodies[min(np.searchsorted(some, t), len(some) - 1)]) for t in times),
        obstacle=tuple(scene.obstacles[i].name for i in closest),
        planned_distance=wanted.min(axis=1),
        obstacles=tuple(o.name for o in scene.obstacles),
        distances=rows,
        planned_distances=wanted,
    )


def _at(cycles: CycleTable, time: float) -> Array:
    return np.array([np.interp(time, cycles.time, cycles.planned[:, i]) for i in range(3)])


def picture(position: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """A grey image with a bright square where the platform is."""
    grey = np.tile(np.linspace(40, 120, 640, dtype=np.uint8), (360, 1))
    if np.isfinite(position).all():
        x, y = int(320 + 600 * position[0]), int(320 - 400 * position[2])
        grey[max(y - 40, 0) : y + 40, x - 40 : x + 40] = 230
    return grey
