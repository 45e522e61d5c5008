"""Where the platform should be seen, by the positions of its drives.

Drives are off by whatever cable lengths are off, so a camera's last pose tells by how much; from
there on they tell how the platform went, however fast and however long no tag was to be seen. This
says only where to look: what is found there is judged as if nobody had said so.
"""

from __future__ import annotations

import numpy as np

from cdpr.poses import Array, Pose, interpolate

#: Drives' poses farther apart in time than this do not tell how the platform goes on, [s].
MEMORY = 0.5


class Guidance:
    """Keeps by how much the drives were off when the camera saw the platform last."""

    def __init__(self) -> None:
        """It never did: the drives are taken at their word."""
        self._shift: Array = np.zeros(3)
        self._turn: Array = np.eye(3)

    def expected(self, by_drives: Pose) -> Pose:
        """Where the platform should be, ``world_from_platform``.

        Args:
            by_drives: Where the drives' positions put it.
        """
        return Pose(by_drives.position + self._shift, self._turn @ by_drives.rotation)

    def learn(self, measured: Pose, by_drives: Pose) -> None:
        """The camera saw the platform.

        Args:
            measured: Where.
            by_drives: Where the drives' positions put it at the same time.
        """
        self._shift = measured.position - by_drives.position
        self._turn = measured.rotation @ by_drives.rotation.T


class DrivesAhead:
    """The drives' pose at the time of a picture, a little after they were heard or before."""

    def __init__(self) -> None:
        """They were not heard yet."""
        self._last: tuple[float, Pose] | None = None

    def at(self, picture: float, heard: float, pose: Pose | None) -> Pose | None:
        """The pose when the picture was taken, if the drives go as they went.

        Args:
            picture: When it was taken, [s].
            heard: When the drives stood at ``pose``, [s].
            pose: ``world_from_platform`` by the drives; None when it is not known.
        """
        before, self._last = self._last, None if pose is None else (heard, pose)
        if before is None or pose is None:
            return pose
        between, ahead = heard - before[0], picture - heard
        if not (0.0 < between <= MEMORY and 0.0 < abs(ahead) <= MEMORY):
            return pose
        return interpolate(before[1], pose, 1.0 + ahead / between)
