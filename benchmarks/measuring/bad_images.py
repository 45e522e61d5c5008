"""Coverage of the 95 % intervals of the platform's pose, by kind of image degradation.

    python benchmarks/measuring/bad_images.py [--pictures 200] [--kind jpeg ...] [--seed 1]

The synthetic camera takes images of the ready rig's cube at random poses, with lamps, shadows, blur
and in-camera processing. The output for each kind: poses, refusals by their commonest reason, RMS
error, coverage of the six intervals, and NEES (6 for an exact covariance). The tracker is reset for
each image.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from model.pose import Array, Pose, matrix_from_rotation_vector, rotation_vector_from_matrix
from model.rig import Rig, load_rig
from model.scene import load_scene
from simulation.camera.camera import SyntheticCamera
from simulation.ground_truth import Optics
from tracking.measurement import PoseMeasurement
from tracking.rolling_shutter import PlatformMotion
from tracking.tracker import Tracker

CONFIGS = Path(__file__).parents[2] / "configs"
EXPOSURE = 0.01


@dataclass(frozen=True)
class Kind:
    """One kind of images: optics, motion in the image [px], and whether only one face is seen."""

    optics: Optics
    smear: float = 0.0
    frontal: bool = False


PLAIN = Optics(noise=1.5, blur=0.6)
KINDS = {
    "clean": Kind(PLAIN),
    "sharpened": Kind(replace(PLAIN, sharpening=1.0)),
    "enlarged": Kind(replace(PLAIN, enlarged=2)),
    "halo": Kind(replace(PLAIN, halo=0.6)),
    "jpeg": Kind(replace(PLAIN, jpeg=30)),
    "motion": Kind(replace(PLAIN, exposure=EXPOSURE), smear=6.0),
    "shadow": Kind(replace(PLAIN, shadow=0.5)),
    "frontal": Kind(PLAIN, frontal=True),
}


def in_front(rig: Rig) -> Rig:
    """The rig with its camera in front of the +x face, the only one with a tag."""
    camera = rig.cameras[0]
    rotation = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    there = replace(camera, world_from_camera=Pose(np.array([1.25, 0.0, 0.45]), rotation))
    tags = tuple(tag for tag in rig.platform_tags if tag.pose.position[0] > 0.06)
    return replace(rig, cameras=(there,), platform_tags=tags)


def random_pose(kind: Kind, rng: np.random.Generator) -> Pose:
    """A random pose in the workspace."""
    middle, wide = np.array([0.02, 0.0, 0.45]), np.array([0.12, 0.1, 0.1])
    turn = matrix_from_rotation_vector(np.radians(6.0) * rng.standard_normal(3))
    return Pose(middle + wide * rng.uniform(-1.0, 1.0, 3), turn)


def errors_of(
    rig: Rig, kind: Kind, count: int, seed: int
) -> tuple[list[Array], list[Array], Counter[str]]:
    """Errors and covariances of the poses, and reasons of refusals."""
    rig = in_front(rig) if kind.frontal else rig
    camera, scene = rig.cameras[0], load_scene(CONFIGS / "environment_1.yaml")
    source = SyntheticCamera(rig, replace(scene, obstacles=()), camera, seed, kind.optics)
    rng = np.random.default_rng([seed, 7])
    errors, covariances, refused = [], [], Counter[str]()
    for number in range(count):
        pose = random_pose(kind, rng)
        direction = rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        away = float(np.linalg.norm(pose.position - camera.world_from_camera.position))
        speed = kind.smear * away / camera.matrix[0, 0] / EXPOSURE
        motion = PlatformMotion(speed * direction, np.zeros(3)) if kind.smear else None
        found = Tracker(rig, camera).observe(source.render(pose, number, motion), 0.0)
        if not isinstance(found, PoseMeasurement):
            refused[" ".join(found.reason.split(":")[0].split()[:6])] += 1
            continue
        turn = rotation_vector_from_matrix(found.pose.rotation @ pose.rotation.T)
        errors.append(np.concatenate([found.pose.position - pose.position, turn]))
        covariances.append(found.covariance)
    return errors, covariances, refused


def main() -> int:
    """Prints a line for each kind; returns 1 if a coverage is too low."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pictures", type=int, default=200)
    parser.add_argument("--kind", nargs="*", choices=KINDS, default=list(KINDS))
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rig, bad = load_rig(CONFIGS / "gachon_8_6.yaml"), 0
    print(f"{'pictures':11s}{'poses':>6s}{'RMS':>10s}{'inside':>8s}{'NEES':>8s}  refused")
    for name in options.kind:
        errors, covariances, refused = errors_of(rig, KINDS[name], options.pictures, options.seed)
        why = ", ".join(f"{n} x {reason}" for reason, n in refused.most_common(1))
        if not errors:
            print(f"{name:11s}{0:6d}  {why}", flush=True)
            continue
        off, spread = np.array(errors), np.array(covariances)
        deviations = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
        inside = float(np.mean(np.abs(off) <= 1.96 * deviations))
        nees = float(
            np.mean(np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[..., None])[..., 0]))
        )
        rms = 1e3 * float(np.sqrt(np.mean(np.sum(off[:, :3] ** 2, axis=1))))
        good = (0.92 <= inside <= 0.98 and 5.5 <= nees <= 6.5) if name == "clean" else inside >= 0.9
        bad += not good
        mark = "" if good else "  <--"
        print(
            f"{name:11s}{len(off):6d}{rms:7.3f} mm{inside:8.1%}{nees:8.2f}  {why}{mark}", flush=True
        )
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
