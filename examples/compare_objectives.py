"""Plans one scene for four objectives and compares the results.

    python examples/compare_objectives.py

With a fixed number of rounds and a seed the paths are the same each time, with the same libraries
on processors of the same type.
"""

from pathlib import Path

import cdpr

CONFIGS = Path(__file__).parents[1] / "configs"


def main() -> None:
    rig = cdpr.load_rig(CONFIGS / "gachon_8_6.yaml")
    scene = cdpr.load_scene(CONFIGS / "environment_3.yaml")

    print(f"{'cost':10} {'length':>10} {'clearance':>10} {'margin':>8} {'kinematic':>10}")
    for cost in ("length", "kinematic", "clearance", "capacity"):
        plan = cdpr.plan(rig, scene, cost=cost, rounds=20, seed=1)
        report = cdpr.check(plan, rig)
        print(
            f"{cost:10} {report.length * 1000:7.1f} mm"
            f" {report.proved_obstacle_clearance * 1000:7.2f} mm"
            f" {report.proved_capacity_margin:6.1f} N"
            f" {plan.quality.mean_kinematic_cost:10.3f}"
        )


if __name__ == "__main__":
    main()
