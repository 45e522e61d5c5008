"""Runs a plan on simulated drives in simulated time, and reads the record of the run.

    python examples/run_simulated.py

Drives, platform and cameras are simulated in this process. The run folder, named by date and
time, is in `runs`.
"""

from pathlib import Path

import numpy as np

import cdpr

CONFIGS = Path(__file__).parents[1] / "configs"


def main() -> None:
    rig = cdpr.load_rig(CONFIGS / "gachon_8_6.yaml")
    scene = cdpr.load_scene(CONFIGS / "environment_1.yaml")
    goal = cdpr.Pose.level(scene.start.position + np.array([-0.02, 0.0, 0.02]))
    scene = scene.changed(goal=goal)  # 28 mm: a few seconds at 20 mm/s

    plan = cdpr.plan(rig, scene)
    run = cdpr.run(plan, rig, realtime=False, on_event=print)
    print(run.verdict, "-", run.sentence)

    error = run.cycles["following_error_mm"]
    print(f"{len(error)} cycles, largest following error {np.nanmax(error):.3f} mm")
    seen = run.poses["status"] == "ok"
    print(f"{seen.sum()} poses, clearance from {run.clearance['distance_mm'].min():.1f} mm")
    print(f"columns of cycles.csv: {', '.join(list(run.cycles)[:6])} ...")
    # import pandas; frame = pandas.DataFrame(run.cycles)

    run.plot().savefig("run.png")
    print(f"the report is {run.report}")


if __name__ == "__main__":
    main()
