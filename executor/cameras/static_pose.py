"""Where a platform at rest is, from several images of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from executor.cameras.client import HEARING
from executor.cameras.process import CameraProcess, FrameRequest
from model.errors import Fault, Refused
from model.kinematics import structure_matrix
from model.pose import Pose, matrix_from_rotation_vector, rotation_vector_from_matrix
from model.rig import Rig
from tracking.measurement import Observation, PoseMeasurement

#: At least this share of the images must give a pose.
SEEN_SHARE = 0.8
#: The platform moves, or the light flickers, when poses scatter by more, [m].
MOST_SCATTER = 0.5e-3


@dataclass(frozen=True, slots=True, eq=False)
class RestPose:
    """The mean of several measurements.

    Attributes:
        pose: ``world_from_platform``.
        uncertainty: Of the position along its worst direction, standard deviation, [m].
        length_uncertainty: Of the cable length known worst, [m].
        pictures: How many gave a pose.
    """

    pose: Pose
    uncertainty: float
    length_uncertainty: float
    pictures: int


def static_pose(rig: Rig, looks: Sequence[Observation]) -> RestPose:
    """The pose in which the platform stood still in all images.

    What is wrong with one image is wrong with all, so the mean is not more certain than each.

    Raises:
        Refused: Too few images show it, it did not stand still, or it is not known well enough
            for a run to start: to half the rig's start tolerance, in cable length.
    """
    found = [look for look in looks if isinstance(look, PoseMeasurement)]
    if not found or len(found) < SEEN_SHARE * len(looks):
        reasons = {getattr(look, "reason", "") for look in looks} - {""}
        raise _refusal(
            f"{len(found)} of {len(looks)} images give a platform pose",
            "; ".join(sorted(reasons)),
        )
    first = found[0].pose
    positions = np.array([look.pose.position for look in found])
    turns = np.array(
        [rotation_vector_from_matrix(look.pose.rotation @ first.rotation.T) for look in found]
    )
    scatter = float(np.max(np.std(positions, axis=0)))
    if not scatter <= MOST_SCATTER:
        raise _refusal(
            f"the platform is not at rest: its poses scatter by {scatter * 1000:.2f} mm,"
            f" limit {MOST_SCATTER * 1000:g} mm",
            "it swings, or the light flickers",
        )
    turned = matrix_from_rotation_vector(turns.mean(axis=0))
    pose = Pose(positions.mean(axis=0), turned @ first.rotation)
    covariance = np.mean([look.covariance for look in found], axis=0)
    columns = structure_matrix(rig, pose)
    lengths = float(np.sqrt(np.max(np.einsum("im,ij,jm->m", columns, covariance, columns))))
    allowed = rig.motion.start_tolerance / 2.0
    if not lengths <= allowed:
        raise _refusal(
            f"the uncertainty of a cable's length is {lengths * 1000:.2f} mm, limit"
            f" {allowed * 1000:.2f} mm",
            "few tags are visible, from far away or at a steep angle",
        )
    worst = float(np.sqrt(np.max(np.linalg.eigvalsh(covariance[:3, :3]))))
    return RestPose(pose, worst, lengths, len(found))


def _refusal(what: str, why: str) -> Refused:
    return Refused(
        what,
        where="tracked pose",
        why=why,
        next_step="check camera, light and tags (`cdpr track RIG SOURCE`), then home again; the"
        " cables are taut and held",
    )


# Images of a platform that stands still, and an operator who may end the looking at any time.


#: An image that has not come after so long will not come, [s].
PATIENCE = 20.0


def looks_at_rest(
    process: CameraProcess,
    pictures: int,
    period: float | None,
    true_pose: Pose | None,
    unless_stopped: Callable[[], None],
) -> list[Observation]:
    """What a camera measures in some images, one after another.

    Args:
        process: Of the camera, which is open.
        pictures: How many.
        period: Between images in simulated time, [s]; None where a real camera takes them.
        true_pose: Where the simulated platform is.
        unless_stopped: Called before each image and while one is waited for; what it raises ends
            the looking.

    Raises:
        CdprError: The camera failed, for the reason given.
    """
    began, looks = time.monotonic(), []
    for frame in range(pictures):
        unless_stopped()
        asked = time.monotonic()
        since = asked - began if period is None else frame * period
        process.ask(FrameRequest(frame, since, asked, true_pose))
        looks.append(_answer(process, asked + PATIENCE, unless_stopped))
    return looks


def _answer(
    process: CameraProcess, latest: float, unless_stopped: Callable[[], None]
) -> Observation:
    while True:
        look = process.answer_within(HEARING)
        if look is not None:
            return look.found
        unless_stopped()
        if time.monotonic() > latest:
            raise Fault(
                f"the camera delivered no image for {PATIENCE:g} s",
                where=f"camera {process.name}",
                why="the camera or its connection hangs",
                next_step="check its cable, then start again",
            )
