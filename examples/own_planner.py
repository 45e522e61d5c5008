"""Checks the waypoints of your own planner like any other plan, and saves them for a run.

    python examples/own_planner.py

This planner has two paths: a straight line, and one around the obstacle through given corners.
"""

from pathlib import Path

import numpy as np

import cdpr

CONFIGS = Path(__file__).parents[1] / "configs"
CORNERS_MM = [(-20.0, -120.0, 535.0), (-115.0, -185.0, 500.0)]


def main() -> None:
    rig = cdpr.load_rig(CONFIGS / "gachon_8_6.yaml")
    scene = cdpr.load_scene(CONFIGS / "environment_1.yaml")
    corners = [cdpr.Pose.level(np.array(corner) / 1000) for corner in CORNERS_MM]
    paths = {
        "straight": [scene.start, scene.goal],
        "around": [scene.start, *corners, scene.goal],
    }
    for name, waypoints in paths.items():
        try:
            plan = cdpr.plan_from_waypoints(rig, scene, waypoints, author=name)
        except cdpr.PlanRejected as rejected:
            for violation in rejected.violations:
                print(f"{name}: {violation.sentence()}")
            continue
        print(f"{name} passes: {plan}")
        plan.save("own-plan.json")  # for `cdpr run`, or cdpr.run(plan, rig)


if __name__ == "__main__":
    main()
