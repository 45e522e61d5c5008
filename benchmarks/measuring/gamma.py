"""Error of poses from images that encode light by a gamma, stated and not stated.

    python benchmarks/measuring/gamma.py [--images 30]

The ready rig's cube at random level poses within 100 mm of its home, at 1280 x 720 px, with lens
blur of 0.6 px. Prints the RMS error and the mean stated deviation of the position along its worst
direction.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from model.files.camera_file import Gamma  # noqa: E402
from model.pose import Pose  # noqa: E402
from model.rig import load_rig  # noqa: E402
from model.scene import load_scene  # noqa: E402
from simulation.camera.camera import Optics, SyntheticCamera  # noqa: E402
from tracking.measurement import PoseMeasurement  # noqa: E402
from tracking.tracker import Tracker  # noqa: E402

ROWS: tuple[tuple[Gamma, Gamma], ...] = (
    (1.0, 1.0),
    ("srgb", 1.0),
    ("srgb", "srgb"),
    (1.3, 1.0),
    (2.2, 2.2),
    (2.2, "srgb"),
)


def main() -> int:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=30)
    count = parser.parse_args().images
    rig = load_rig(ROOT / "configs/gachon_8_6.yaml")
    scene = replace(load_scene(ROOT / "configs/environment_1.yaml"), obstacles=())
    print("true gamma  stated  poses  RMS error [mm]  stated deviation [mm]")
    for true, stated in ROWS:
        camera = replace(rig.cameras[0], gamma=true)
        synthetic = SyntheticCamera(rig, scene, camera, optics=Optics(blur=0.6))
        draw = np.random.default_rng(1)
        errors, deviations = [], []
        for number in range(count):
            pose = Pose.level(rig.home.position + draw.uniform(-0.1, 0.1, 3))
            tracker = Tracker(rig, replace(camera, gamma=stated))
            found = tracker.observe(synthetic.render(pose, number), 0.0)
            if isinstance(found, PoseMeasurement):
                errors.append(found.pose.distance_to(pose))
                deviations.append(np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[-1]))
        rms, deviation = np.sqrt(np.mean(np.square(errors))) * 1e3, np.mean(deviations) * 1e3
        print(f"{true!s:>10}  {stated!s:>6}  {len(errors):5}  {rms:14.3f}  {deviation:21.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
