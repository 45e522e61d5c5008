"""Measures the platform's pose in your own images, frame by frame.

    python examples/track_images.py [RIG] [SOURCE]

SOURCE is a folder of images, a video file, or the index of a live camera.
"""

import sys
from pathlib import Path

import cdpr
from tracking import NoPose

ROOT = Path(__file__).parents[1]


def main(
    rig_file: str = str(ROOT / "configs/gachon_8_6_rehearsal.yaml"),
    source: str = str(ROOT / "examples/rig_session/pictures"),
) -> None:
    rig = cdpr.load_rig(rig_file)
    camera = rig.camera()  # the first of the rig file, or rig.camera("front")
    tracker = cdpr.Tracker(rig, camera)

    with cdpr.open_camera(rig, source, camera.name) as images:
        for frame in images:
            found = tracker.observe(frame.image, frame.time)
            if isinstance(found, NoPose):
                print(f"{frame.name}: {found.reason}")
                continue
            x, y, z = found.pose.position * 1000
            sigma = found.position_deviation.max() * 1000
            where = f"{x:8.2f} {y:8.2f} {z:8.2f} mm"
            print(f"{frame.name}: {where}, 1 sigma {sigma:.2f} mm, {found.tags}")


if __name__ == "__main__":
    main(*sys.argv[1:])
