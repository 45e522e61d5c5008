"""A moving platform before a rolling shutter, tracked with and without `readout_ms`.

    python benchmarks/measuring/rolling_shutter.py [--speed-mm-s 100] [--readout-ms 30] [--rate 30]

The ready rig's cube goes back and forth (sine, so that it is faster and slower) along each axis of
the world and turns meanwhile, before the synthetic camera, which renders by rows. Printed are the
errors of the tracked positions: as from a camera without `readout_ms`, with it, and of a camera
that exposes all rows at once; NEES is the squared error in units of the covariance, 3 when exact.
Images whose motion is not known yet (the first one) are left out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from model.pose import PlatformMotion, Pose, matrix_from_rotation_vector
from model.rig import Camera, Rig, load_rig
from model.scene import empty_scene
from simulation.camera.camera import SyntheticCamera
from simulation.ground_truth import Optics
from tracking.measurement import PoseMeasurement
from tracking.tracker import Tracker

ROOT = Path(__file__).parents[2]
SWING = 0.04
"""Half the way back and forth, [m]."""


@dataclass(frozen=True)
class Flight:
    """A platform that swings about home along an axis, at most at a speed [m/s]."""

    home: Pose
    axis: int
    speed: float

    def at(self, time: float) -> Pose:
        """Its pose, ``world_from_platform``, at a time, [s]."""
        phase = self.speed / SWING * time
        shift = np.zeros(3)
        shift[self.axis] = SWING * np.sin(phase)
        turn = matrix_from_rotation_vector(np.array([0.0, 0.0, 0.03 * np.sin(phase)]))
        return Pose(self.home.position + shift, turn @ self.home.rotation)

    def motion(self, time: float) -> PlatformMotion:
        """Its motion there."""
        step = 1e-4
        return PlatformMotion.between(self.at(time - step), self.at(time + step), 2.0 * step)


def errors(
    rig: Rig, camera: Camera, told: float, flight: Flight, images: int
) -> Iterator[tuple[float, float]]:
    """Distance to the truth [m] and NEES of each pose after the first, by a stated readout [s]."""
    eye = SyntheticCamera(rig, empty_scene(rig), camera, 3, Optics(blur=0.6, exposure=2e-3))
    tracker = Tracker(rig, replace(camera, readout=told))
    for number in range(images):
        time = number / camera.rate
        picture = eye.render(flight.at(time), number, flight.motion(time))
        found = tracker.observe(picture, time)
        if isinstance(found, PoseMeasurement) and number > 0:
            gap = found.pose.position - flight.at(time).position
            nees = gap @ np.linalg.solve(found.covariance[:3, :3], gap)
            yield float(np.linalg.norm(gap)), float(nees)


def main() -> int:
    """Prints a line for each axis and camera."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--speed-mm-s", type=float, default=100.0)
    parser.add_argument("--readout-ms", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=30.0, help="images a second")
    parser.add_argument("--images", type=int, default=60)
    told = parser.parse_args()
    rig = load_rig(ROOT / "configs" / "gachon_8_6.yaml")
    readout = told.readout_ms / 1e3
    print(f"{told.speed_mm_s:g} mm/s, {told.readout_ms:g} ms readout, {told.rate:g} images/s")
    print(f"{'axis':6s}{'camera':28s}{'poses':>6s}{'RMS mm':>9s}{'max mm':>9s}{'NEES':>9s}")
    for axis in range(3):
        flight = Flight(rig.home, axis, told.speed_mm_s / 1e3)
        for name, true, stated in (
            ("rolling, readout not stated", readout, 0.0),
            ("rolling, readout_ms", readout, readout),
            ("all rows at once", 0.0, 0.0),
        ):
            camera = replace(rig.cameras[0], readout=true, rate=told.rate)
            found = np.array(list(errors(rig, camera, stated, flight, told.images))).reshape(-1, 2)
            far, nees = found.T
            rms, most = (np.sqrt(np.mean(far**2)), far.max()) if len(far) else (np.nan, np.nan)
            print(
                f"{'xyz'[axis]:6s}{name:28s}{len(far):6d}{rms * 1e3:9.3f}{most * 1e3:9.3f}"
                f"{nees.mean() if len(nees) else np.nan:9.2f}"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
