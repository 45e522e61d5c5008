"""Held-out errors of our fit, OpenCV's and mrcal's, on the same corners in the same run.

    python benchmarks/measuring/calibrations.py [--columns 9 --rows 6] [PICTURE ...]

Without arguments it uses the chessboards of Debian's `opencv-doc` in this repository. Our detector
finds the corners; every other image calibrates, the others are held out, in both directions. Only
camera and lens of each fit are used: the pose of a held-out board is estimated by the same method
for all. mrcal is Debian's (`apt-get install mrcal python3-mrcal`), with its defaults (it rejects
outliers and estimates the board's warp); without it its lines are omitted. Exit code 1 if ours is
more than 2 % worse than OpenCV's with the same model, or our selected model than the best of
OpenCV's and mrcal's.
"""

from __future__ import annotations

import argparse
import ast
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from calibration.intrinsics.lens import LENSES, LensFit, LensModel, choose_lens, error_of, fit_lens
from calibration.targets.boards import Chessboard, DetectedBoard

ROOT = Path(__file__).parents[2]
Views = Mapping[str, DetectedBoard]
Size = tuple[int, int]
Fitter = Callable[[Views, Size], LensFit]
WORSE = 1.02
"""Allowed ratio of our error to a reference."""
MRCAL = {"five": "LENSMODEL_OPENCV5", "rational": "LENSMODEL_OPENCV8"}


def by_opencv(lens: LensModel) -> Fitter:
    """OpenCV's own fit of a lens model."""

    def fit(views: Views, size: Size) -> LensFit:
        points = [seen.points.astype(np.float32).reshape(-1, 1, 3) for seen in views.values()]
        corners = [seen.corners.astype(np.float32).reshape(-1, 1, 2) for seen in views.values()]
        if lens.fisheye:
            _, matrix, found, _, _ = cv2.fisheye.calibrate(
                [p.astype(np.float64) for p in points],
                [c.astype(np.float64) for c in corners],
                size,
                np.eye(3),
                np.zeros(4),
                flags=cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW,
            )
        else:
            _, matrix, found, _, _ = cv2.calibrateCamera(
                points, corners, size, np.eye(3), np.zeros(0), flags=lens.flags
            )
        return LensFit(lens, matrix, np.ravel(found)[: len(lens.coefficients)], {}, {})

    return fit


def by_mrcal(lens: LensModel, board: Chessboard) -> Fitter:
    """Mrcal's fit of a lens model, by its program in a temporary folder."""

    def fit(views: Views, size: Size) -> LensFit:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            lines = ["# filename x y level"]
            for key, seen in views.items():
                lines += [f"{Path(key).name} {x:.6f} {y:.6f} 0" for x, y in seen.corners]
            (folder / "corners.vnl").write_text("\n".join(lines) + "\n")
            subprocess.run(
                [
                    "mrcal-calibrate-cameras",
                    *("--corners-cache", "corners.vnl", "--lensmodel", MRCAL[lens.name]),
                    *("--focal", str(size[0]), "--imagersize", *map(str, size)),
                    *("--object-spacing", str(board.square)),
                    *("--object-width-n", str(board.columns)),
                    *("--object-height-n", str(board.rows), "--outdir", ".", "*"),
                ],
                cwd=folder,
                check=True,
                capture_output=True,
                timeout=300,
            )
            text = (folder / "camera-0.cameramodel").read_text()
        body = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
        numbers = ast.literal_eval(body.strip())["intrinsics"]
        fx, fy, cx, cy = numbers[:4]
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return LensFit(lens, matrix, np.array(numbers[4:]), {}, {})

    return fit


def held_out(views: Views, size: Size, fit: Fitter) -> tuple[float, str]:
    """RMS error of held-out images, [px], and the models of both halves."""
    names, squares, count, models = list(views), 0.0, 0, []
    for which in (0, 1):
        found = fit({name: views[name] for name in names[which::2]}, size)
        models.append(found.lens.name)
        for name in names[1 - which :: 2]:
            own = len(views[name].corners)
            squares += error_of(found, views[name]) * own
            count += own
    return float(np.sqrt(squares / count)), " ".join(dict.fromkeys(models))


def main() -> int:
    """Prints a line for each fit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pictures", nargs="*", type=Path)
    parser.add_argument("--columns", type=int, default=9)
    parser.add_argument("--rows", type=int, default=6)
    arguments = parser.parse_args()
    shipped = sorted((ROOT / "tests" / "calibration" / "photographs").glob("left*.jpg"))
    board = Chessboard(arguments.columns, arguments.rows, 0.025)
    images = {str(path): cv2.imread(str(path), 0) for path in arguments.pictures or shipped}
    if unread := [name for name, image in images.items() if image is None]:
        print(f"not readable as images: {', '.join(unread)}", file=sys.stderr)
        return 2
    size = next(iter(images.values())).shape[::-1]
    seen = {name: board.find(image) for name, image in images.items()}
    views = {name: one for name, one in seen.items() if one is not None}
    print(f"{board} in {len(views)} of {len(images)} images of {size[0]} x {size[1]} px")
    fits: dict[tuple[str, str], Fitter] = {("ours", "auto"): choose_lens}
    for lens in LENSES.values():
        fits[("ours", lens.name)] = lambda v, s, lens=lens: fit_lens(lens, v, s)
        fits[("cv2", lens.name)] = by_opencv(lens)
        if lens.name in MRCAL and shutil.which("mrcal-calibrate-cameras"):
            fits[("mrcal", lens.name)] = by_mrcal(lens, board)
    print(f"{'fit':8s}{'lens':12s}{'held out, px':>14s}  model")
    errors: dict[tuple[str, str], float] = {}
    for (who, lens), fit in fits.items():
        try:
            errors[(who, lens)], models = held_out(views, size, fit)
            print(f"{who:8s}{lens:12s}{errors[(who, lens)]:14.4f}  {models}")
        except (cv2.error, subprocess.SubprocessError, np.linalg.LinAlgError) as error:
            print(f"{who:8s}{lens:12s}{'no fit':>14s}  {type(error).__name__}")
    worse = [
        f"{lens}: {ours:.4f} px, {who} {theirs:.4f} px"
        for (who, lens), theirs in errors.items()
        if who == "cv2" and (ours := errors.get(("ours", lens), np.inf)) > WORSE * theirs
    ]
    reference = min((e for (who, _), e in errors.items() if who != "ours"), default=np.inf)
    if errors.get(("ours", "auto"), np.inf) > WORSE * reference:
        worse.append(f"auto: {errors[('ours', 'auto')]:.4f} px, best reference {reference:.4f} px")
    print("more than 2 % worse: " + ("; ".join(worse) or "none"))
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
