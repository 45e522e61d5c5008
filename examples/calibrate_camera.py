"""Calibrates a camera from images of a chessboard and applies the result to a rig in memory.

    python examples/calibrate_camera.py [FOLDER]

Without a folder it uses OpenCV's sample images from the tests of this repository.
"""

import sys
from pathlib import Path

import cdpr

ROOT = Path(__file__).parents[1]


def main(folder: str = str(ROOT / "tests/calibration/photographs")) -> None:
    board = cdpr.Chessboard(columns=9, rows=6, square=0.025)  # inner corners; metres
    camera = cdpr.calibrate_camera(folder, board, name="front")
    print(camera)
    for name, value in camera.result.in_words():
        print(f"  {name}: {value}")
    for step in camera.result.next_steps:
        print(f"  next: {step}")

    rig = cdpr.load_rig(ROOT / "configs/gachon_8_6.yaml")
    try:
        rig = rig.with_calibration(camera)  # in memory; the rig file does not change
    except cdpr.BadInput as error:  # these images are smaller than those of the rig file's camera
        print(error)


if __name__ == "__main__":
    main(*sys.argv[1:])
