"""Plans a path, checks it, and prints the state of the robot along it.

    python examples/plan_path.py

Writes `plan.json` for `cdpr run` and the figure `plan.png` into the current folder.
"""

from pathlib import Path

import cdpr

CONFIGS = Path(__file__).parents[1] / "configs"


def main() -> None:
    rig = cdpr.load_rig(CONFIGS / "gachon_8_6.yaml")
    scene = cdpr.load_scene(CONFIGS / "environment_3.yaml")

    plan = cdpr.plan(rig, scene, cost="length", rounds=20, seed=1)
    print(plan)
    report = cdpr.check(plan, rig)  # raises cdpr.PlanRejected with every violation
    print(f"proved clearance: {report.proved_obstacle_clearance * 1000:.2f} mm")

    for pose in plan.waypoints:
        posed = rig.at(pose)
        print(posed)
        print(f"  tensions {posed.tensions.round(1)} N, lengths {posed.lengths.round(3)} m")

    plan.save("plan.json")
    plan.plot().savefig("plan.png")


if __name__ == "__main__":
    main()
