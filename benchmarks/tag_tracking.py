"""Accuracy of pose tracking, compared with plain OpenCV and pyapriltags.

    python benchmarks/tag_tracking.py [--frames 1000] [--peer-every 5] [--heights 720 1080]

The ready rig's cube (96 mm tags on 130 mm faces) moves along a smooth curve with rotations of up to
10°, about 1.6 m in front of the camera, which sees three faces, at 1280 x 720 and 1920 x 1080 px.
The references get every fifth of the same images: their corners of all platform tags go through
`cv2.solvePnP` (SQPnP, then Levenberg-Marquardt). NEES is the squared error in units of the stated
covariance; its mean is 6 for an exact covariance. An image of a bare wall, without anything to
detect, is timed beside plain OpenCV. A height of 2598 px makes 12 megapixels.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.stats import chi2

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.detection import Finder, apriltag_library, plain
from model.pose import Array, Pose, matrix_from_rotation_vector, rotation_vector_from_matrix
from model.rig import Camera, Rig, load_rig
from model.scene import Scene, load_scene
from simulation.camera.camera import Optics, SyntheticCamera
from tracking.detection.tags import dictionary, tag_corners
from tracking.measurement import PoseMeasurement
from tracking.tracker import Tracker

CONFIGS = Path(__file__).parents[1] / "configs"
#: A pose rotated farther from the truth than this is a flip, [rad].
FLIP = np.radians(5.0)
#: Targets of position [m] and rotation [rad], RMS, from an image height on.
TARGETS = {720: (0.8e-3, np.radians(0.1)), 1080: (0.3e-3, np.radians(0.03))}
#: Number of images of a bare wall.
WALLS = 15


@dataclass
class Score:
    """Errors of one tracker."""

    errors: list[Array] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    missed: int = 0

    def add(self, found: Pose | None, truth: Pose, seconds: float) -> None:
        """Counts one image."""
        self.seconds.append(seconds)
        if found is None:
            self.missed += 1
            return
        turn = rotation_vector_from_matrix(found.rotation @ truth.rotation.T)
        self.errors.append(np.concatenate([found.position - truth.position, turn]))

    def line(self) -> str:
        """One line of the table."""
        errors = np.array(self.errors).reshape(-1, 6)
        position, turn = self.rms
        flips = int(np.sum(np.linalg.norm(errors[:, 3:], axis=1) > FLIP))
        worst = float(np.linalg.norm(errors[:, :3], axis=1).max()) * 1e3
        middle = float(np.median(self.seconds)) * 1e3
        return (
            f"{len(errors):7d}{self.missed:8d}{position * 1e3:9.3f}{worst:9.2f}"
            f"{np.degrees(turn):9.4f}{flips:7d}{middle:9.1f}"
        )

    @property
    def rms(self) -> tuple[float, float]:
        """RMS errors of position [m] and rotation [rad]."""
        errors = np.array(self.errors)
        return (
            float(np.sqrt(np.mean(np.sum(errors[:, :3] ** 2, axis=1)))),
            float(np.sqrt(np.mean(np.sum(errors[:, 3:] ** 2, axis=1)))),
        )


def curve(count: int) -> Iterator[Pose]:
    """Smooth motion through the workspace at 20 images a second and up to 0.1 m/s."""
    for k in range(count):
        s = k / 20.0
        position = [
            0.12 * np.sin(0.41 * s),
            0.12 * np.sin(0.53 * s + 1),
            0.42 + 0.1 * np.sin(0.37 * s),
        ]
        turn = np.radians(10.0) * np.sin(np.array([0.31, 0.43, 0.29]) * s + [0, 1, 2]) / np.sqrt(3)
        yield Pose(np.array(position), matrix_from_rotation_vector(turn))


def scaled(camera: Camera, height: int) -> Camera:
    """The same lens on a sensor with other pixels."""
    share = height / camera.height
    matrix = camera.matrix.copy()
    matrix[:2] *= share
    matrix[:2, 2] += (share - 1.0) / 2.0
    width = round(camera.width * share)
    return replace(camera, width=width, height=height, matrix=matrix)


def by_corners(rig: Rig, camera: Camera, find: Finder) -> Callable[[np.ndarray], Pose | None]:
    """A pose from the corners of a reference detector."""
    tags = {tag.id: tag for tag in rig.platform_tags}

    def pose(image: np.ndarray) -> Pose | None:
        seen: Mapping[int, Array] = find(image, -1)
        mine = [number for number in seen if number in tags]
        if not mine:
            return None
        points = np.concatenate([tag_corners(tags[number]) for number in mine])
        pixels = np.concatenate([seen[number] for number in mine])
        good, turn, shift = cv2.solvePnP(
            points, pixels, camera.matrix, camera.distortion, flags=cv2.SOLVEPNP_SQPNP
        )
        if not good:
            return None
        turn, shift = cv2.solvePnPRefineLM(
            points, pixels, camera.matrix, camera.distortion, turn, shift
        )
        there = Pose(np.ravel(shift), matrix_from_rotation_vector(np.ravel(turn)))
        return camera.world_from_camera.compose(there)

    return pose


def fly(
    rig: Rig, scene: Scene, camera: Camera, frames: int, peer_every: int, seed: int, optics: Optics
) -> bool:
    """Prints the table of one camera; returns whether all targets are met."""
    eye = SyntheticCamera(rig, scene, camera, seed=seed, optics=optics)
    tracker, mine = Tracker(rig, camera), Score()
    peers: dict[str, Callable[[np.ndarray], Pose | None]] = {
        "cv2 SUBPIX + solvePnP": by_corners(
            rig, camera, plain(rig.tag_family, cv2.aruco.CORNER_REFINE_SUBPIX)
        )
    }
    library = apriltag_library(rig.tag_family)
    if library is not None:
        peers["pyapriltags + solvePnP"] = by_corners(rig, camera, library)
    scores = {name: Score() for name in peers}
    states: dict[str, int] = {}
    faces = 0
    for frame, truth in enumerate(curve(frames)):
        image = eye.render(truth, frame)
        start = time.process_time()
        found = tracker.observe(image, frame / 20.0)
        took = time.process_time() - start
        if isinstance(found, PoseMeasurement):
            mine.add(found.pose, truth, took)
            mine.nees.append(
                float(mine.errors[-1] @ np.linalg.solve(found.covariance, mine.errors[-1]))
            )
            states[found.status] = states.get(found.status, 0) + 1
            faces += len(found.tags)
        else:
            mine.add(None, truth, took)
        if frame % peer_every == 0:
            for name, peer in peers.items():
                start = time.process_time()
                there = peer(image)
                scores[name].add(there, truth, time.process_time() - start)
    good = report(camera, mine, scores, states, faces)
    time_bare_wall(rig, camera, optics.noise)
    return good


def time_bare_wall(rig: Rig, camera: Camera, noise: float) -> None:
    """Prints the CPU time of an image without tags, and that of OpenCV's default detector."""
    grey = np.random.default_rng(0).normal(120.0, noise, (camera.height, camera.width))
    wall = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    tracker, peer = Tracker(rig, camera), cv2.aruco.ArucoDetector(dictionary(rig.tag_family))
    took: tuple[list[float], list[float]] = ([], [])
    for number in range(WALLS):
        start = time.process_time()
        tracker.observe(wall, number / 20.0)
        between = time.process_time()
        peer.detectMarkers(wall)
        took[0].append(between - start)
        took[1].append(time.process_time() - between)
    ours, theirs = (float(np.median(each)) for each in took)
    print(f"no tags: {ours * 1e3:.1f} ms CPU, {ours / theirs:.2f} of cv2's {theirs * 1e3:.1f}")


def report(
    camera: Camera, mine: Score, scores: Mapping[str, Score], states: Mapping[str, int], faces: int
) -> bool:
    """Prints the results; returns whether the targets are met."""
    print(
        f"\n{camera.width} x {camera.height} px, {faces / len(mine.errors):.2f} faces per pose;",
        end="",
    )
    print(f" {', '.join(f'{n} {status}' for status, n in sorted(states.items()))}")
    print(f"{'':24s}  poses  missed   RMS mm worst mm  RMS deg  flips   CPU ms")
    print(f"{'ours':24s}{mine.line()}")
    for name, score in scores.items():
        print(f"{name:24s}{score.line()}")
    count, mean = len(mine.nees), float(np.mean(mine.nees))
    low, high = chi2.ppf([0.005, 0.995], 6 * count) / count
    beyond = float(np.mean(np.array(mine.nees) > chi2.ppf(0.99, 6)))
    print(f"NEES {mean:.2f} (exact: 6, 99 % band {low:.2f} to {high:.2f}); ", end="")
    print(f"{beyond:.1%} of poses beyond the 99 % ellipsoid")
    position, turn = mine.rms
    limit_position, limit_turn = TARGETS[max(h for h in TARGETS if h <= camera.height)]
    flips = sum(np.linalg.norm(e[3:]) > FLIP for e in mine.errors)
    return position <= limit_position and turn <= limit_turn and not flips and not mine.missed


def main() -> int:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--peer-every", type=int, default=5)
    parser.add_argument("--heights", type=int, nargs="+", default=[720, 1080], help="[px]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--noise", type=float, default=1.5, help="of 255")
    parser.add_argument("--blur", type=float, default=0.6, help="of the lens, px")
    arguments = parser.parse_args()
    if (lowest := min(arguments.heights)) < min(TARGETS):
        parser.error(f"--heights: {lowest} px is below {min(TARGETS)} px, the lowest with targets")
    cv2.setNumThreads(1)
    rig = load_rig(CONFIGS / "gachon_8_6.yaml")
    scene = replace(load_scene(CONFIGS / "environment_1.yaml"), obstacles=())
    optics, good = Optics(noise=arguments.noise, blur=arguments.blur), True
    for height in arguments.heights:
        camera = scaled(rig.cameras[0], height)
        good &= fly(
            rig, scene, camera, arguments.frames, arguments.peer_every, arguments.seed, optics
        )
    print("\nall targets are met" if good else "\na target is missed")
    return 0 if good else 3


if __name__ == "__main__":
    sys.exit(main())
