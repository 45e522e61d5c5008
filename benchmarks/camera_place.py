"""Error of a camera's pose from surveyed tags, and its ratio to the Cramér-Rao bound.

    python benchmarks/camera_place.py [--trials 200]

Tags on the floor around a rig are surveyed with random errors and seen by a camera with known
noise. The output lists the resulting errors of points in the work space beside the Cramér-Rao bound
of the same observations: no unbiased estimator that knows the errors of survey and corners has
smaller ones.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from calibration.extrinsics.result import workspace_corners
from calibration.extrinsics.surveyed_tags import Survey, locate_by_frame_tags
from calibration.tag_map.observations import TagObservations
from model.pose import Array, Pose, matrix_from_rotation_vector, skew
from model.rig import Rig, Tag, load_rig
from tracking.camera_model import project_undistorted
from tracking.detection.tags import tag_corners
from tracking.edges.refine import RefinedTag
from tracking.pnp import moved

RIG = Path(__file__).parents[1] / "configs/gachon_8_6.yaml"
NOISE, SIZE = 0.03, 0.12
RING = [(0.5 * np.cos(a), 0.5 * np.sin(a)) for a in np.linspace(0.0, 2.0 * np.pi, 8, False)]
INNER = [
    (0.28 * np.cos(a), 0.28 * np.sin(a)) for a in np.linspace(0.2, 0.2 + 2.0 * np.pi, 8, False)
]
POSITIONS = {17: [(0.0, 0.0), *RING, *INNER], 4: RING[1::2], 1: [(0.0, 0.0)]}


SURVEYS = ("each corner", "each tag, rotations known", "each tag, and its rotation")


def survey_called(name: str, size: float) -> Survey:
    """A survey of a kind, with errors of a size, [m]."""
    turns = {SURVEYS[0]: None, SURVEYS[1]: 0.0, SURVEYS[2]: 2.0 * size / SIZE}
    return Survey(size, turns[name])


def by_pose(rig: Rig, tags: tuple[Tag, ...], camera_from_world: Pose) -> Array:
    """Derivatives of all pixels by the camera's pose, shape (8 t, 6)."""
    corners = np.concatenate([tag_corners(tag) for tag in tags])

    def pixels(step: Array) -> Array:
        pose = moved(camera_from_world, step)
        return project_undistorted(rig.cameras[0], pose.apply(corners)).ravel()

    return np.column_stack([(pixels(d) - pixels(-d)) / 2e-6 for d in 1e-6 * np.eye(6)])


def bound(rig: Rig, tags: tuple[Tag, ...], survey: Survey) -> float:
    """Cramér-Rao bound of points of the work space, RMS, [mm]."""
    truth = rig.cameras[0].world_from_camera.inverse()
    poses = by_pose(rig, tags, truth)
    covariance = NOISE**2 * np.eye(8 * len(tags))
    for k, tag in enumerate(tags):
        block = slice(8 * k, 8 * k + 8)
        covariance[block, block] += survey.of_pixels(rig.cameras[0], truth, tag)
    best = np.linalg.inv(poses.T @ np.linalg.solve(covariance, poses))
    points = truth.apply(workspace_corners(rig))
    slopes = [np.hstack([np.eye(3), -skew(p - truth.position)]) for p in points]
    return 1e3 * float(np.sqrt(np.mean([np.trace(s @ best @ s.T) for s in slopes])))


def error(
    rig: Rig, tags: tuple[Tag, ...], survey: Survey, rng: np.random.Generator
) -> tuple[float, float]:
    """Mean square error of points of the work space in one trial, and the stated error."""
    camera = rig.cameras[0]
    there, squares = camera.world_from_camera.inverse(), {}
    for tag in tags:
        slopes = survey.slopes(tag)
        off = (slopes @ rng.standard_normal(slopes.shape[1])).reshape(4, 3)
        pixels = project_undistorted(camera, there.apply(tag_corners(tag) + off))
        pixels = pixels + NOISE * rng.standard_normal((4, 2))
        whitening = np.eye(8) / NOISE
        target = whitening @ pixels.ravel()
        squares[tag.id] = RefinedTag(pixels, whitening, target, np.ones(4, bool))
    found = locate_by_frame_tags(
        replace(rig, frame_tags=tags), camera, TagObservations({"picture": squares}, {}), survey
    )
    back = found.world_from_camera.apply(there.apply(found.points)) - found.points
    return float(np.mean(np.sum(back**2, axis=1))), found.error


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--survey-mm", type=float, default=0.5)
    options = parser.parse_args()
    rig, size = load_rig(RIG), options.survey_mm / 1e3
    away = float(np.linalg.norm(rig.cameras[0].world_from_camera.position))
    print(
        f"survey {options.survey_mm:g} mm, corners {NOISE:g} px, tags of {SIZE * 1e3:g} mm on the"
    )
    print(f"floor, camera {away:.2f} m from the origin; points of the work space, RMS")
    print(
        f"{'tags':>5s} {'surveyed was':28s}{'error':>9s}{'bound':>9s}{'ratio':>7s}{'in 95 %':>9s}"
    )
    for count, positions in POSITIONS.items():
        tags = tuple(
            Tag(
                401 + k, SIZE, Pose(np.array([x, y, 0.0]), matrix_from_rotation_vector(np.zeros(3)))
            )
            for k, (x, y) in enumerate(positions)
        )
        for name in SURVEYS:
            survey, rng = survey_called(name, size), np.random.default_rng([11, count])
            found = np.array([error(rig, tags, survey, rng) for _ in range(options.trials)])
            off, best = 1e3 * float(np.sqrt(found[:, 0].mean())), bound(rig, tags, survey)
            held = float(np.mean(np.sqrt(found[:, 0]) <= found[:, 1]))
            row = f"{off:6.2f} mm{best:6.2f} mm{off / best:7.2f}{held:9.0%}"
            print(f"{count:5d} {name:28s}{row}", flush=True)


if __name__ == "__main__":
    main()
