"""Benefit of encoder poses for tracking: poses found with and without them.

`python benchmarks/guidance.py` moves the ready rig's cube in front of the synthetic camera (lens
blur 0.6 px), hides it now and then, and lays bars over the tags' outlines, which defeats every
detector. The encoder pose has an error of 2 mm and 0.3°, and 20 mm more after a drum slips. Prints
poses, their errors, and CPU time per image, with and without encoder poses.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from model.pose import Pose, matrix_from_rotation_vector, rotation_vector_from_matrix
from model.rig import Rig, load_rig
from model.scene import load_scene
from simulation.camera.camera import Optics, SyntheticCamera
from tracking.measurement import PoseMeasurement
from tracking.tracker import Tracker

CONFIGS = Path(__file__).parents[1] / "configs"
RATE = 10.0
#: Error of the encoder pose, [m] and [rad], and the addition after a drum slips.
OFF = np.array([1.5e-3, -1.0e-3, 1.0e-3, 5e-3, 0.0, 3e-3])
SLIPPED = np.array([0.016, -0.008, 0.009, 0.02, 0.0, 0.01])
#: Speed [m/s], width of the bars [px], and whether a drum slips.
CONDITIONS = (
    (0.02, 0, False),
    (0.02, 6, False),
    (0.02, 14, False),
    (0.02, 14, True),
    (0.2, 6, False),
)
Cover = Callable[[np.ndarray, int], np.ndarray]


def hidden(k: int) -> bool:
    """Whether the platform is hidden: in a third of the images."""
    return k % 15 >= 10


def where(k: int, speed: float) -> Pose:
    """The pose on a curve in the work space, with small rotations."""
    s = k / RATE * speed
    position = [0.1 * np.sin(s / 0.1), 0.1 * np.cos(7.0 * s), 0.42 + 0.05 * np.sin(5.0 * s)]
    turn = np.array([0.05 * np.sin(9.0 * s), 0.05 * np.cos(7.0 * s), 0.0])
    return Pose(np.array(position), matrix_from_rotation_vector(turn))


def bars(width: int) -> Cover:
    """Bars of a width in pixels, 70 px apart, that move over the image; none for width 0."""

    def cover(image: np.ndarray, k: int) -> np.ndarray:
        if hidden(k):
            return np.full_like(image, 90)
        out, (height, wide) = image.copy(), image.shape
        for x in range(-height, wide, 70) if width else ():
            left = x + 13 * k % 70
            cv2.line(out, (left, 0), (left + height // 2, height), 90, width)
        return out

    return cover


def off_by(pose: Pose, by: np.ndarray) -> Pose:
    """A pose shifted and rotated along the world's axes."""
    return Pose(pose.position + by[:3], matrix_from_rotation_vector(by[3:]) @ pose.rotation)


def fly(rig: Rig, eye: SyntheticCamera, speed: float, cover: Cover, slips: bool, n: int) -> None:
    """Prints a line without encoder poses and one with them."""
    for guided in (False, True):
        tracker, errors, nees, seconds = Tracker(rig, eye.camera), [], [], []
        for k in range(n):
            truth = where(k, speed)
            image = cover(eye.render(truth, k), k)
            off = OFF + (SLIPPED if slips and k >= n // 3 else 0.0)
            start = time.process_time()
            found = tracker.observe(image, k / RATE, off_by(truth, off) if guided else None)
            took = time.process_time() - start
            if hidden(k):
                continue
            seconds.append(took)
            if isinstance(found, PoseMeasurement):
                turn = rotation_vector_from_matrix(found.pose.rotation @ truth.rotation.T)
                error = np.concatenate([found.pose.position - truth.position, turn])
                errors.append(float(np.linalg.norm(error[:3])))
                nees.append(float(error @ np.linalg.solve(found.covariance, error)))
        rms = np.sqrt(np.mean(np.square(errors))) * 1e3
        print(
            f"  {'with' if guided else 'without'} encoders: {len(errors)} of {len(seconds)} poses,"
            f" RMS {rms:.3f} mm, median NEES {np.median(nees):.1f},"
            f" {np.mean(seconds) * 1e3:.1f} ms per image",
            flush=True,
        )


def main() -> int:
    """Prints the results under each condition."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    rig = load_rig(CONFIGS / "gachon_8_6.yaml")
    scene = replace(load_scene(CONFIGS / "environment_1.yaml"), obstacles=())
    optics = Optics(blur=0.6)
    eye = SyntheticCamera(rig, scene, rig.cameras[0], seed=arguments.seed, optics=optics)
    for speed, width, slips in CONDITIONS:
        drum = ", a drum slips" if slips else ""
        print(f"{speed * 1e3:g} mm/s, bars of {width} px{drum}")
        fly(rig, eye, speed, bars(width), slips, arguments.frames)
    return 0


if __name__ == "__main__":
    sys.exit(main())
