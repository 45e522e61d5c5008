"""Board detection in third-party images, compared with OpenCV in the same run.

    python benchmarks/measuring/boards.py [--board chessboard --columns 9 --rows 6] [PICTURE ...]

Without arguments it uses the chessboards of Debian's `opencv-doc` in this repository. The last
column is the RMS reprojection error of held-out images: every other image calibrates, the others
are held out, in both directions, over the images in which both our detector and the row's find the
board. Only the corners differ: camera model and fit are OpenCV's, five coefficients (`--rational`:
eight).

Other sets: `apt-get download opencv-doc && dpkg -x opencv-doc*.deb doc` (26 chessboards of two
cameras), github.com/sourishg/fisheye-stereo-calibration (58, fisheye, 9 x 6),
github.com/ros-industrial/industrial_calibration (15 circle grids of 10 x 10 in
examples/data/test_set_10x10), github.com/powei-lin/aprilgrid (5 of Kalibr's grids).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from calibration.targets.boards import Board, Charuco, Chessboard, DetectedBoard
from calibration.targets.grids import CircleGrid, TagGrid
from tracking.camera_model import Image
from tracking.detection.tags import dictionary, upright_corners

ROOT = Path(__file__).parents[2]
Finder = Callable[[Image], DetectedBoard | None]
_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)


def made_board(arguments: argparse.Namespace) -> Board:
    """The board described by the options; its size does not matter here."""
    count, tag, gap = (arguments.columns, arguments.rows), 0.05, 0.05 * arguments.gap
    match arguments.board:
        case "chessboard":
            return Chessboard(*count, 0.025)
        case "circles":
            return CircleGrid(*count, 0.02, 0.02 * arguments.diameter, arguments.asymmetric)
        case "charuco":
            return Charuco(*count, 0.03, 0.03 * arguments.marker, arguments.dictionary)
        case _:
            return TagGrid(*count, tag, gap, "tag36h11", arguments.first, arguments.order)


def peers_of(board: Board) -> dict[str, Finder]:
    """OpenCV's detectors for the same board."""
    match board:
        case Chessboard():
            return {
                "cv2 classic": _chessboard(board, cv2.findChessboardCorners),
                "cv2 sectors": _chessboard(board, cv2.findChessboardCornersSB, refined=False),
            }
        case CircleGrid():
            return {"cv2 circles": _circles(board)}
        case Charuco():
            return {"cv2 charuco": _charuco(board)}
        case TagGrid():
            return {"cv2 tags": _tags(board)}
    raise TypeError(f"no peer for {board}")


def _chessboard(board: Chessboard, find: Callable[..., object], refined: bool = True) -> Finder:
    def finder(image: Image) -> DetectedBoard | None:
        good, corners = find(image, (board.columns, board.rows))
        if not good:
            return None
        if refined:
            corners = cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), _STOP)
        return DetectedBoard(board.points(), np.asarray(corners, dtype=np.float64).reshape(-1, 2))

    return finder


def _circles(board: CircleGrid) -> Finder:
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if board.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID

    def finder(image: Image) -> DetectedBoard | None:
        good, centres = cv2.findCirclesGrid(image, (board.columns, board.rows), flags=kind)
        if not good:
            return None
        return DetectedBoard(board.points(), np.asarray(centres, dtype=np.float64).reshape(-1, 2))

    return finder


def _charuco(board: Charuco) -> Finder:
    named = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{board.dictionary}"))
    drawn = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, named)
    detector = cv2.aruco.CharucoDetector(drawn)

    def finder(image: Image) -> DetectedBoard | None:
        corners, numbers, _, _ = detector.detectBoard(image)
        if np.size(numbers) < 8:
            return None
        points = np.asarray(drawn.getChessboardCorners(), dtype=np.float64)[np.ravel(numbers)]
        return DetectedBoard(points, np.asarray(corners, dtype=np.float64).reshape(-1, 2))

    return finder


def _tags(board: TagGrid) -> Finder:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.markerBorderBits = 2 if board.order == "kalibr" else 1
    detector = cv2.aruco.ArucoDetector(dictionary(board.family), parameters)
    numbers_of = range(board.first, board.first + board.columns * board.rows)

    def finder(image: Image) -> DetectedBoard | None:
        squares, ids, _ = detector.detectMarkers(image)
        pairs = zip([] if ids is None else np.ravel(ids).tolist(), squares, strict=True)
        found = {
            n: upright_corners(board.family, np.reshape(s, (4, 2)).astype(np.float64))
            for n, s in pairs
            if n in numbers_of
        }
        if len(found) < 2:
            return None
        return DetectedBoard(board.points_of(found), np.concatenate(list(found.values())))

    return finder


def held_out(views: Mapping[str, DetectedBoard], size: tuple[int, int], flags: int) -> float:
    """RMS error of held-out images, [px]; NaN if there are too few."""
    names, squares, count = list(views), 0.0, 0
    for which in (0, 1):
        used, rest = names[which::2], names[1 - which :: 2]
        if len(used) < 4 or not rest:
            return float("nan")
        points = [views[n].points.astype(np.float32).reshape(-1, 1, 3) for n in used]
        corners = [views[n].corners.astype(np.float32).reshape(-1, 1, 2) for n in used]
        _, matrix, lens, _, _ = cv2.calibrateCamera(
            points, corners, size, np.eye(3), np.zeros(0), flags=flags
        )
        for name in rest:
            seen = views[name]
            _, turn, shift = cv2.solvePnP(seen.points, seen.corners, matrix, lens)
            there = cv2.projectPoints(seen.points, turn, shift, matrix, lens)[0].reshape(-1, 2)
            squares += float(np.sum((there - seen.corners) ** 2))
            count += len(there)
    return float(np.sqrt(squares / count))


def options() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pictures", nargs="*", type=Path)
    kinds = ("chessboard", "circles", "charuco", "tags")
    parser.add_argument("--board", choices=kinds, default="chessboard")
    parser.add_argument("--columns", type=int, default=9)
    parser.add_argument("--rows", type=int, default=6)
    parser.add_argument("--diameter", type=float, default=0.5, help="in spacings (circles)")
    parser.add_argument("--asymmetric", action="store_true")
    parser.add_argument("--marker", type=float, default=0.7, help="in squares (charuco)")
    parser.add_argument("--dictionary", default="4X4_50")
    parser.add_argument("--gap", type=float, default=0.3, help="in sides of a tag (tags)")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--order", choices=("rows", "kalibr"), default="rows")
    parser.add_argument("--rational", action="store_true", help="eight lens coefficients")
    return parser


def main() -> int:
    """Prints a line for each detector."""
    arguments = options().parse_args()
    shipped = sorted((ROOT / "tests" / "calibration" / "photographs").glob("left*.jpg"))
    pictures = {path.name: cv2.imread(str(path), 0) for path in arguments.pictures or shipped}
    if unread := [name for name, image in pictures.items() if image is None]:
        print(f"not readable as images: {', '.join(unread)}", file=sys.stderr)
        return 2
    board = made_board(arguments)
    flags = cv2.CALIB_RATIONAL_MODEL if arguments.rational else 0
    size = next(iter(pictures.values())).shape[::-1]
    print(f"{board} in {len(pictures)} images; times are CPU")
    print(f"{'finder':14s}{'found':>6s}{'ms each':>9s}{'found by both':>15s}{'held out, px':>22s}")
    ours: dict[str, DetectedBoard] = {}
    for name, find in {"ours": board.find, **peers_of(board)}.items():
        start = time.process_time()
        seen = {key: find(image) for key, image in pictures.items()}
        each = (time.process_time() - start) / len(pictures) * 1e3
        found = {key: view for key, view in seen.items() if view is not None}
        ours = ours or found
        both = [key for key in found if key in ours]
        theirs = held_out({key: found[key] for key in both}, size, flags)
        same = held_out({key: ours[key] for key in both}, size, flags)
        what = f"{theirs:.4f} (ours {same:.4f})"
        print(f"{name:14s}{len(found):6d}{each:9.0f}{len(both):15d}{what:>22s}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
