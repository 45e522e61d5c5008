"""Varies a rig and its payload in memory and compares statics at the start of a scene.

    python examples/parameter_study.py

`Rig.from_dict` and `Scene.from_dict` take the keys of the files and check them like files.
"""

from pathlib import Path

import numpy as np

import cdpr

CONFIGS = Path(__file__).parents[1] / "configs"


def main() -> None:
    rig_data = cdpr.load_rig(CONFIGS / "gachon_8_6.yaml").as_dict()
    scene_data = cdpr.load_scene(CONFIGS / "environment_1.yaml").as_dict()
    outlets = np.array(rig_data["outlets_mm"])

    print(f"{'frame':>8} {'payload':>8} {'margin':>8} {'dexterity':>10}")
    for width in (0.9, 1.0, 1.1):
        rig = cdpr.Rig.from_dict({**rig_data, "outlets_mm": outlets * [width, width, 1.0]})
        for payload in (0.0, 1.0, 2.0):
            load = {"payload_kg": payload, "force_n": [2.0, 2.0, 2.0]}
            scene = cdpr.Scene.from_dict({**scene_data, "load": load})
            posed = rig.at(scene.start, scene.load)
            print(
                f"{width * 100:6.0f} % {payload:5.1f} kg {posed.capacity_margin:6.1f} N"
                f" {posed.dexterity:10.3f}"
            )


if __name__ == "__main__":
    main()
