"""Where the platform will be: it goes on as it went."""

from __future__ import annotations

from dataclasses import replace

from cdpr.poses import Pose, matrix_from_rotation_vector, read_only, rotation_vector_from_matrix
from tracking.measurement import PoseMeasurement

#: Older motion says nothing about the present one, [s].
MEMORY = 0.5


def predicted(last: PoseMeasurement, before: PoseMeasurement | None, time: float) -> Pose:
    """The pose at a time if the platform goes on with the speed between two measurements.

    Args:
        last: The newest measurement.
        before: The one before it, if there is one.
        time: Of the prediction, [s].
    """
    if before is None:
        return last.pose
    between, ahead = last.time - before.time, time - last.time
    if not (0.0 < between <= MEMORY and 0.0 < ahead <= MEMORY):
        return last.pose
    share = ahead / between
    turn = rotation_vector_from_matrix(last.pose.rotation @ before.pose.rotation.T)
    position = last.pose.position + share * (last.pose.position - before.pose.position)
    return Pose(position, matrix_from_rotation_vector(share * turn) @ last.pose.rotation)


def carried_on(
    last: PoseMeasurement, before: PoseMeasurement | None, time: float
) -> PoseMeasurement | None:
    """A measurement as it would have been a little later, with what that adds to its covariance.

    Args:
        last: The measurement.
        before: The one before it by the same camera, if there is one.
        time: Of the later one, [s]; not before the measurement's own.

    Returns:
        None where `predicted` knows no speed: nobody can tell where the platform is then.
    """
    if time == last.time:
        return last
    pose = predicted(last, before, time)
    if before is None or pose is last.pose:
        return None
    share = (time - last.time) / (last.time - before.time)
    covariance = (1.0 + share) ** 2 * last.covariance + share**2 * before.covariance
    return replace(last, time=time, pose=pose, covariance=read_only(covariance))
