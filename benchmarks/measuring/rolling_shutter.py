"""Tracking of a moving platform with a rolling shutter, with and without `readout_ms`.

    python benchmarks/measuring/rolling_shutter.py [--speed-mm-s 100] [--readout-ms 30] [--rate 30]

The ready rig's cube oscillates (sine, thus at varying speed) along each axis of the world with
small rotations, in front of the synthetic camera, which renders by rows. Prints the errors of the
tracked positions without `readout_ms`, with it, and with a global shutter; NEES is the squared
error in units of the covariance, 3 if exact. Images with unknown motion (the first) are left out.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from model.pose import Pose, matrix_from_rotation_vector
from model.rig import Camera, Rig, load_rig
from model.scene import empty_scene
from simulation.camera.camera import SyntheticCamera
from simulation.ground_truth import Optics
from tracking.measurement import PoseMeasurement
from tracking.rolling_shutter import PlatformMotion
from tracking.tracker import Tracker

ROOT = Path(__file__).parents[2]
SWING = 0.04
"""Amplitude of the oscillation, [m]."""


@dataclass(frozen=True)
class Flight:
    """A platform that oscillates about home along an axis, with a peak speed [m/s]."""

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
        """Its motion at a time, [s]."""
        step = 1e-4
        return PlatformMotion.between(self.at(time - step), self.at(time + step), 2.0 * step)


def errors(
    rig: Rig, camera: Camera, readout: float, flight: Flight, images: int
) -> Iterator[tuple[float, float]]:
    """Distance to the truth [m] and NEES of each pose after the first, for a stated readout [s]."""
    eye = SyntheticCamera(rig, empty_scene(rig), camera, 3, Optics(blur=0.6, exposure=2e-3))
    tracker = Tracker(rig, replace(camera, readout=readout))
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
    options = parser.parse_args()
    rig = load_rig(ROOT / "configs" / "gachon_8_6.yaml")
    readout = options.readout_ms / 1e3
    print(
        f"{options.speed_mm_s:g} mm/s, {options.readout_ms:g} ms readout, {options.rate:g} images/s"
    )
    print(f"{'axis':6s}{'camera':28s}{'poses':>6s}{'RMS mm':>9s}{'max mm':>9s}{'NEES':>9s}")
    for axis in range(3):
        flight = Flight(rig.home, axis, options.speed_mm_s / 1e3)
        for name, true, stated in (
            ("rolling, readout not stated", readout, 0.0),
            ("rolling, readout_ms", readout, readout),
            ("global shutter", 0.0, 0.0),
        ):
            camera = replace(rig.cameras[0], readout=true, rate=options.rate)
            found = np.array(list(errors(rig, camera, stated, flight, options.images))).reshape(
                -1, 2
            )
            far, nees = found.T
            rms, most = (np.sqrt(np.mean(far**2)), far.max()) if len(far) else (np.nan, np.nan)
            print(
                f"{'xyz'[axis]:6s}{name:28s}{len(far):6d}{rms * 1e3:9.3f}{most * 1e3:9.3f}"
                f"{nees.mean() if len(nees) else np.nan:9.2f}"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
