"""Creates the recorded session of examples/rig_session: stationary samples and some images.

    python tools/rig_session.py FOLDER [--count 60] [--pictures 6]

The simulated rig of gachon_8_6_rehearsal.yaml moves to the poses that `cdpr calibrate poses` would
choose; the tracker measures each in one image of the synthetic camera. Deterministic.
"""

from __future__ import annotations

import argparse
import sys
from itertools import chain
from math import radians
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from calibration.geometry.parameters import DEFAULT_DEVIATIONS, Parameters
from calibration.geometry.pose_selection import PoseRequirements, choose_poses
from model.files.scene_file import SceneDocument
from model.kinematics import cables_at
from model.pose import Pose
from model.rig import Rig, load_rig
from model.scene import Scene, scene_from_document
from model.statics.gravity import working_tensions
from model.winches import WinchMap
from simulation.factory import make_synthetic_camera
from simulation.ground_truth import rig_as_built
from simulation.plant import Plant
from tracking.measurement import PoseMeasurement
from tracking.tracker import Tracker

RIG = Path(__file__).parents[1] / "configs/gachon_8_6_rehearsal.yaml"
QUALITY = 90
"""JPEG quality: small files, with corner errors below the noise."""


def free_scene(rig: Rig) -> Scene:
    """A scene without obstacles."""
    home = {"position_mm": (rig.home.position * 1e3).tolist()}
    plain = {
        "schema_version": 1,
        "name": "measuring",
        "clearance": {"obstacle_mm": 10, "self_mm": 3},
        "start": home,
        "goal": home,
    }
    return scene_from_document(SceneDocument.model_validate(plain))


def poses_to_measure(rig: Rig, scene: Scene, count: int) -> list[Pose]:
    """The poses that `cdpr calibrate poses` chooses."""
    doubts = (0.3e-3,) * 3 + (radians(0.05),) * 3
    requirements = PoseRequirements(count, radians(15.0), radians(15.0), 300, 7.125, 0.1e-3, doubts)
    return choose_poses(rig, scene, requirements, Parameters.of(rig, DEFAULT_DEVIATIONS), seed=0)


def header(cables: int) -> list[str]:
    """Column names; see docs/data-formats.md."""
    numbers = range(1, cables + 1)
    return [
        *chain.from_iterable((f"actual_{i}_counts", f"tension_{i}_n") for i in numbers),
        *("x_mm", "y_mm", "z_mm", "qw", "qx", "qy", "qz"),
        *("std_x_mm", "std_y_mm", "std_z_mm", "std_rx_deg", "std_ry_deg", "std_rz_deg"),
    ]


def row(counts: np.ndarray, tensions: np.ndarray, seen: PoseMeasurement) -> list[str]:
    """Values of one sample."""
    pairs = zip(counts, tensions, strict=True)
    turns = np.degrees(seen.rotation_deviation)
    return [
        *chain.from_iterable((f"{c:.0f}", f"{t:.1f}") for c, t in pairs),
        *(f"{x:.4f}" for x in seen.pose.position * 1e3),
        *(f"{q:.8f}" for q in seen.pose.quaternion),
        *(f"{d:.5f}" for d in chain(seen.position_deviation * 1e3, turns)),
    ]


def main() -> None:
    """Writes the folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--pictures", type=int, default=6)
    options = parser.parse_args()
    (options.folder / "pictures").mkdir(parents=True, exist_ok=True)
    rig = load_rig(RIG)
    scene, camera = free_scene(rig), rig.cameras[0]
    winches, plant = WinchMap(rig), Plant(rig_as_built(rig), rig.home)
    lens, tracker = make_synthetic_camera(rig, scene, camera), Tracker(rig, camera)
    noise = np.random.default_rng(0)
    rows = [header(rig.cable_count)]
    for number, pose in enumerate(poses_to_measure(rig, scene, options.count)):
        tensions = working_tensions(rig, pose).tensions
        lengths = cables_at(rig, pose).lengths
        counts = np.rint(winches.counts(winches.unstrained(lengths, tensions)))
        plant.settle_counts(counts)
        picture = lens.render(plant.pose, number)
        seen = tracker.observe(picture, float(number))
        tracker.forget()  # the next pose is far away
        if isinstance(seen, PoseMeasurement):
            felt = plant.tensions + noise.normal(0.0, 0.05, rig.cable_count)
            rows.append(row(counts, felt, seen))
        if number < options.pictures:
            name = options.folder / "pictures" / f"place_{number + 1:02d}.jpg"
            data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
            name.write_bytes(data.tobytes())
    text = "\n".join(",".join(values) for values in rows) + "\n"
    (options.folder / "places.csv").write_text(text, encoding="utf-8")
    print(f"{len(rows) - 1} samples, {options.pictures} images in {options.folder}")


if __name__ == "__main__":
    main()
