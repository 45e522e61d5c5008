"""Time of one accepted 40 mm edge: compiled exact checks, python-fcl and coal, in one run.

All three check the same condition on the same edges: eight swept cable triangles and the swept
platform stay 10 mm from every box. Usage: python benchmarks/planner/edges.py [edges]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import coal
import fcl
import numpy as np

from model.pose import Array
from model.rig import Rig, load_rig
from model.scene import Scene, load_scene
from planner.collision.edges import edges_free
from planner.collision.world import self_edges_free
from planner.edge_checks import ExactChecks
from planner.wrench.translation import edges_held

CONFIGS = Path(__file__).parents[2] / "configs"
CLEARANCE = 0.010
LENGTH = 0.040
REPEATS = 5

Check = Callable[[Array, Array], bool]


def main() -> None:
    """Prints a row for each environment."""
    library_edges = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    rig = load_rig(CONFIGS / "gachon_8_6.yaml")
    print("accepted edges of 40 mm, processor time per edge [µs]")
    print("env  exact   all(*)  python-fcl    coal   fcl/exact  coal/exact  disagreements fcl coal")
    for number in (1, 2, 3):
        scene = load_scene(CONFIGS / f"environment_{number}.yaml")
        _row(number, rig, scene, library_edges)
    print("(*) with self clearance (proved over the workspace) and wrench feasibility")


def _row(number: int, rig: Rig, scene: Scene, library_edges: int) -> None:
    checks = ExactChecks(
        rig,
        scene,
        np.eye(3),
        obstacle_clearance=CLEARANCE,
        self_clearance=scene.self_clearance,
        margin_reserve=0.002 * rig.max_tension,
    )
    starts, ends = _edges(rig, 40_000)
    free = edges_free(checks.world, starts, ends)
    accepted = starts[free], ends[free]
    exact = _best(lambda: edges_free(checks.world, *accepted)) / len(accepted[0])

    def everything() -> None:
        edges_free(checks.world, *accepted)
        self_edges_free(checks.world, checks.robot, *accepted)
        edges_held(checks.world, checks.load, checks.holding, *accepted)

    together = _best(everything) / len(accepted[0])
    few = accepted[0][:library_edges], accepted[1][:library_edges]
    timed = []
    for check in (_fcl_check(rig, scene), _coal_check(rig, scene)):
        timed.append(
            _best(lambda c=check: [c(a, b) for a, b in zip(*few, strict=True)], 2) / len(few[0])
        )
    differ = [
        sum(check(a, b) != f for a, b, f in zip(starts[:400], ends[:400], free[:400], strict=True))
        for check in (_fcl_check(rig, scene), _coal_check(rig, scene))
    ]
    fcl_time, coal_time = timed
    print(
        f"{number:3d} {exact * 1e6:6.2f} {together * 1e6:8.2f} {fcl_time * 1e6:11.1f} "
        f"{coal_time * 1e6:7.1f} {fcl_time / exact:11.0f} {coal_time / exact:11.0f} "
        f"{differ[0]:14d}/400 {differ[1]}/400"
    )


def _edges(rig: Rig, count: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(0)
    starts = rng.uniform(rig.workspace_lower, rig.workspace_upper, (count, 3))
    directions = rng.normal(size=(count, 3))
    ends = starts + LENGTH * directions / np.linalg.norm(directions, axis=1)[:, None]
    inside = np.all((ends >= rig.workspace_lower) & (ends <= rig.workspace_upper), axis=1)
    return starts[inside], ends[inside]


def _best(run: Callable[[], object], repeats: int = REPEATS) -> float:
    """The least processor time of a few runs after a first one, [s]."""
    run()
    times = []
    for _ in range(repeats):
        begun = time.process_time()
        run()
        times.append(time.process_time() - begun)
    return min(times)


def _swept(rig: Rig, start: Array, end: Array) -> tuple[Array, Array]:
    """Triangles, shape (m, 3, 3), and the platform's corners, shape (16, 3)."""
    triangles = np.stack([rig.outlets, rig.anchors + start, rig.anchors + end], axis=1)
    corners = np.concatenate([rig.platform_corners + start, rig.platform_corners + end])
    return triangles, corners


def _fcl_check(rig: Rig, scene: Scene) -> Check:
    """As a user of python-fcl would write it: stops at the first pair that is too near."""
    boxes = [
        fcl.CollisionObject(
            fcl.Box(*(2.0 * o.shape.half_size)),
            fcl.Transform(np.array(o.pose.rotation), np.array(o.pose.position)),
        )
        for o in scene.obstacles
    ]
    request, result = fcl.DistanceRequest(), fcl.DistanceResult()
    two_sides = np.array([3, 0, 1, 2, 3, 0, 2, 1])
    fan = np.array([[3, 0, i, i + 1] for i in range(1, 15)]).ravel()

    def free(start: Array, end: Array) -> bool:
        triangles, corners = _swept(rig, start, end)
        bodies = [fcl.CollisionObject(fcl.Convex(t, 2, two_sides)) for t in triangles]
        bodies.append(fcl.CollisionObject(fcl.Convex(corners, 14, fan)))
        return all(
            fcl.distance(body, box, request, result) >= CLEARANCE
            for box in boxes
            for body in bodies
        )

    return free


def _coal_check(rig: Rig, scene: Scene) -> Check:
    boxes = [
        (
            coal.Box(*(2.0 * o.shape.half_size)),
            coal.Transform3s(np.array(o.pose.rotation), np.array(o.pose.position)),
        )
        for o in scene.obstacles
    ]
    request, nowhere = coal.DistanceRequest(), coal.Transform3s.Identity()
    two_sides = _coal_sides([(0, 1, 2), (0, 2, 1)])
    fan = _coal_sides([(0, i, i + 1) for i in range(1, 15)])

    def distance(body: coal.Convex, box: coal.Box, pose: coal.Transform3s) -> float:
        result = coal.DistanceResult()
        return float(coal.distance(body, nowhere, box, pose, request, result))

    def free(start: Array, end: Array) -> bool:
        triangles, corners = _swept(rig, start, end)
        bodies = [coal.Convex(_coal_points(t), two_sides) for t in triangles]
        bodies.append(coal.Convex(_coal_points(corners), fan))
        return all(distance(body, *box) >= CLEARANCE for box in boxes for body in bodies)

    return free


def _coal_points(points: Array) -> coal.StdVec_Vec3s:
    made = coal.StdVec_Vec3s()
    for point in points:
        made.append(point)
    return made


def _coal_sides(corners: list[tuple[int, int, int]]) -> coal.StdVec_Triangle:
    made = coal.StdVec_Triangle()
    for corner in corners:
        made.append(coal.Triangle(*corner))
    return made


if __name__ == "__main__":
    main()
