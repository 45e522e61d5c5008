"""Coverage of a camera calibration's stated intervals, and its errors.

    python benchmarks/camera_calibration.py [--trials 50] [--pictures 20]

Every trial renders a chessboard with a lens, noise and random poses, detects it and calibrates; the
reference is plain OpenCV (`findChessboardCornersSB`, `calibrateCamera`) on the same images.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from calibration.intrinsics.calibrate import fit_camera
from calibration.intrinsics.lens import LENSES
from calibration.intrinsics.quality import judge_camera
from calibration.targets.boards import Chessboard
from tests.calibration.board_images import (
    DISTORTION,
    MATRIX,
    SIZE,
    picture_of,
    poses_before_the_camera,
    with_noise,
)
from tests.cli.test_calibrate_camera import MIDDLE, chessboard_print

BOARD = Chessboard(9, 6, 0.025)
TRUTH = np.array([MATRIX[0, 0], MATRIX[1, 1], MATRIX[0, 2], MATRIX[1, 2], *DISTORTION])


def rendered(count: int, seed: int) -> list[tuple[str, np.ndarray]]:
    """Images of the board."""
    poses = poses_before_the_camera(MIDDLE, count, seed=seed, spread=0.10)
    return [
        (f"{k}", with_noise(picture_of(chessboard_print(), 0.0005, np.full(2, 0.05), pose), k))
        for k, pose in enumerate(poses)
    ]


def plain(pictures: list[tuple[str, np.ndarray]]) -> np.ndarray:
    """Parameters estimated by OpenCV alone."""
    corners = []
    for _, image in pictures:
        found, seen = cv2.findChessboardCornersSB(image, (9, 6))
        if found:
            corners.append(seen.astype(np.float32))
    points = [BOARD.points().astype(np.float32)] * len(corners)
    _, matrix, lens, _, _ = cv2.calibrateCamera(points, corners, SIZE, np.eye(3), np.zeros(0))
    return np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *np.ravel(lens)[:5]])


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--pictures", type=int, default=20)
    arguments = parser.parse_args()
    inside, errors, peers, verdicts = [], [], [], []
    for trial in range(arguments.trials):
        pictures = rendered(arguments.pictures, 100 + trial)
        found = fit_camera(pictures, BOARD, lens="five")
        off = np.array([interval.value for interval in found.intervals.values()]) - TRUTH
        inside.append(np.abs(off) <= found.uncertainty.half_widths)
        errors.append(off)
        peers.append(plain(pictures) - TRUTH)
        verdicts.append(judge_camera(found, 1e-3).verdict.good)
    ours, theirs = (np.sqrt(np.mean(np.square(part), axis=0)) for part in (errors, peers))
    print(
        f"{arguments.trials} trials of {arguments.pictures} images; good enough for 1 mm:", end=""
    )
    print(f" {sum(verdicts)}")
    print(f"{'':8s}{'in 95 %':>9s}{'RMS error':>12s}{'OpenCV alone':>14s}")
    for k, name in enumerate(LENSES["five"].names):
        print(f"{name:8s}{np.mean(inside, axis=0)[k]:9.0%}{ours[k]:12.4g}{theirs[k]:14.4g}")
    every = np.mean([row[:4].all() for row in inside])
    print(f"all four of the matrix inside: {every:.0%}; over all values: {np.mean(inside):.0%}")


if __name__ == "__main__":
    main()
