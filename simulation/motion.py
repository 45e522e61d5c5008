"""How a simulated platform moves while a picture is exposed, and pictures one after the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from cdpr.poses import Array, Pose, matrix_from_rotation_vector, rotation_vector_from_matrix

if TYPE_CHECKING:
    from simulation.camera import SyntheticCamera
    from simulation.camera_canvas import Image8


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A steady motion of the platform.

    Attributes:
        velocity: Of its origin, world frame, shape (3,), [m/s].
        turning: Along the world's axes, shape (3,), [rad/s].
    """

    velocity: Array
    turning: Array

    @classmethod
    def between(cls, before: Pose, after: Pose, seconds: float) -> Motion:
        """The motion from one pose to another in a time that is not 0."""
        turn = rotation_vector_from_matrix(after.rotation @ before.rotation.T)
        return cls((after.position - before.position) / seconds, turn / seconds)

    def moved(self, pose: Pose, seconds: float) -> Pose:
        """The pose so much later, or earlier."""
        turn = matrix_from_rotation_vector(self.turning * seconds)
        return Pose(pose.position + self.velocity * seconds, turn @ pose.rotation)


class Film:
    """Pictures of one camera, each smeared by the platform's motion since the one before.

    The first is sharp. Between pictures the platform is taken to have moved steadily.
    """

    def __init__(self, camera: SyntheticCamera) -> None:
        """Takes the camera; nothing is rendered yet."""
        self._camera = camera
        self._before: tuple[float, Pose] | None = None

    def picture(self, time: float, pose: Pose, frame: int) -> Image8:
        """The next picture.

        Args:
            time: At the middle of its exposure, [s].
            pose: Of the platform there, ``world_from_platform``.
            frame: Number of the picture; it picks the noise.

        Returns:
            Grey picture, shape (height, width).
        """
        motion = None
        if self._before is not None and time > self._before[0]:
            motion = Motion.between(self._before[1], pose, time - self._before[0])
        self._before = time, pose
        return self._camera.render(pose, frame, motion)
