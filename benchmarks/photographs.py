"""Tag detection in real photographs, compared with plain OpenCV and pyapriltags.

    python benchmarks/photographs.py [--family tag36h11] [PICTURE ...]

Without arguments it uses the images of the AprilTag library's own test, in this repository. Where
``NAME.txt`` beside an image lists that library's detections, the last columns show how many of its
tags are found, and the distance of their corners from its own.

Other suitable images are in Debian's package `visp-images-data` (GPL-2, hence not here):
``apt-get download visp-images-data && dpkg -x visp-images-data*.deb visp`` and then the files of
``visp/usr/share/visp-images-data/ViSP-images/AprilTag``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from model.pose import Array
from model.rig import Camera, load_rig
from tests.tracking.reference_tags import nearest_gap, tags_found_by_apriltag
from tracking.camera_model import Image
from tracking.detection.detector import TagDetector
from tracking.detection.tags import dictionary, modules_across
from tracking.edges.refine import refine

ROOT = Path(__file__).parents[1]
#: Corners farther off than this belong to another tag, [px].
NEAR = 2.0
#: Corners of every tag in an image, each of shape (4, 2), [px].
Finder = Callable[[Image], Sequence[Array]]


def ours(family: str, exhaustive: bool) -> Finder:
    """As in `cdpr`: detection, then edge refinement where possible."""
    detector, modules = TagDetector(family), modules_across(family)

    def find(image: Image) -> Sequence[Array]:
        found = detector.detect_all(image)
        if exhaustive:
            found = detector.detect_exhaustively(image, found)
        rough = np.array([d.corners for d in found])
        squares = refine(image, _some_camera(image), rough.reshape(-1, 4, 2), modules)
        return [
            s.corners if s is not None and s.whole else corners
            for s, corners in zip(squares, rough, strict=True)
        ]

    return find


def _some_camera(image: Image) -> Camera:
    """A camera without lens distortion for the image's size."""
    camera = load_rig(ROOT / "configs" / "gachon_8_6.yaml").cameras[0]
    height, width = image.shape
    matrix = np.array([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    nothing = np.zeros_like(camera.distortion)
    return Camera("any", width, height, matrix, nothing, camera.world_from_camera, camera.rate)


def opencv(family: str) -> Finder:
    """OpenCV alone, with its sub-pixel refinement."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary(family), parameters)

    def find(image: Image) -> Sequence[Array]:
        corners, _, _ = detector.detectMarkers(image)
        return [np.asarray(c, dtype=np.float64).reshape(4, 2) for c in corners]

    return find


def apriltag_library(family: str) -> Finder | None:
    """Pyapriltags without decimation, if installed; its pixel centres are at 0.5."""
    try:
        from pyapriltags import Detector
    except ImportError:
        print("pyapriltags is left out: it is not installed (pip install 'cdpr[apriltag]')")
        return None
    detector = Detector(families=family, nthreads=1, quad_decimate=1.0)
    return lambda image: [
        np.asarray(d.corners, dtype=np.float64) - 0.5 for d in detector.detect(image)
    ]


def summary(found: Sequence[Array], listing: Path) -> str:
    """Number of tags, and their agreement with a listing if there is one."""
    if not listing.exists():
        return f"{len(found):6d}"
    reference = tags_found_by_apriltag(listing)
    gaps = np.array([nearest_gap(corners, found) for corners in reference])
    near = gaps[gaps < NEAR]
    middle = float(np.median(near)) if len(near) else float("nan")
    return f"{len(found):6d}{len(near):8d} of {len(reference):2d}{middle:10.3f}"


def main() -> int:
    """Prints a line for each image and detector."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pictures", nargs="*", type=Path)
    parser.add_argument("--family", default="tag36h11")
    arguments = parser.parse_args()
    shipped = sorted((ROOT / "tests" / "tracking" / "photographs").glob("*.jpg"))
    finders = {
        "ours": ours(arguments.family, exhaustive=False),
        "ours, exhaustive": ours(arguments.family, exhaustive=True),
        "cv2": opencv(arguments.family),
    }
    library = apriltag_library(arguments.family)
    if library is not None:
        finders["pyapriltags"] = library
    print(f"{'picture':28s}{'finder':16s} found   in listing  median gap, px")
    for picture in arguments.pictures or shipped:
        image = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
        if image is None:
            print(f"{picture} cannot be read as an image", file=sys.stderr)
            return 2
        for name, find in finders.items():
            cells = summary(find(image), picture.with_suffix(".txt"))
            print(f"{picture.name:28s}{name:16s}{cells}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
