"""How `cdpr home` knows where the platform is: it is stated, or one camera measures it."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cdpr.poses import Pose
    from cdpr.rig import Camera, Rig
    from executor.reference import ReferenceDocument
    from executor.winch_motion import WinchesStand
    from executor.wishes import WishBoard


def require_picture(rig: Rig, eye: tuple[Camera, str], shown: bool) -> None:
    """The camera is there and gives pictures, before anything is moved for it."""
    from cdpr.cli.rest_camera import look_at_rest

    look_at_rest(rig, eye, 1, rig.home, lambda: None, shown=shown)


def require_one_way(
    at_home: bool,
    pose_mm: tuple[float, float, float] | None,
    camera: list[str] | None,
    as_rig_file: bool,
) -> None:
    """The pose must be known in one way, not in several nor in none.

    Raises:
        BadInput: It is not.
    """
    from cdpr.errors import BadInput

    if (at_home, pose_mm is not None, bool(camera)).count(True) != 1 or as_rig_file:
        raise BadInput(
            "say how the platform's pose is known: --at-home, --pose-mm or --camera alone",
            where="cdpr home",
            why="counts are referenced at a pose that is known, and at no guess",
            next_step="put the platform on a jig and pass --at-home or --pose-mm X Y Z; or let it"
            " hang in view of a calibrated camera and pass --camera INDEX",
        )


def stated_pose(rig: Rig, pose_mm: tuple[float, float, float] | None) -> Pose:
    """The pose in which a jig holds the platform; the rig's home without a place.

    Raises:
        BadInput: It is outside the workspace.
    """
    from cdpr.document_types import millimetres
    from cdpr.errors import BadInput
    from cdpr.poses import Pose

    if pose_mm is None:
        return rig.home
    pose = Pose.level(millimetres(list(pose_mm)))
    inside = (rig.workspace_lower <= pose.position) & (pose.position <= rig.workspace_upper)
    if not inside.all():
        raise BadInput(
            "this pose is outside the workspace",
            where="--pose-mm",
            next_step="name the position of the platform's origin in the world frame, in mm",
        )
    return pose


def referenced(
    rig: Rig,
    stand: WinchesStand,
    true_pose: Pose | None,
    board: WishBoard,
    known: Pose | None,
    eye: tuple[Camera, str] | None,
    pictures: int,
) -> ReferenceDocument:
    """The reference at the pose where the platform is held now.

    Args:
        rig: The robot.
        stand: Where its winches stand, and the tensions.
        true_pose: Where the simulated platform is.
        board: Where a stop is wished.
        known: The stated pose; None where a camera measures it.
        eye: That camera, from `choose_one_camera`.
        pictures: How many it takes.

    Raises:
        StoppedByOperator: The operator stopped it while the camera looked.
        Refused: The pose is not known well enough.
    """
    from cdpr.cli.rest_camera import look_at_rest
    from cdpr.errors import StoppedByOperator
    from executor.reference import reference_at
    from executor.rest_pose import rest_pose

    if known is not None:
        return reference_at(rig, known, stand.counts, stand.tensions, "stated pose", 0.0)
    assert eye is not None

    def unless_stopped() -> None:
        if board.read().stop:
            raise StoppedByOperator(
                "stopped before the pose was measured; the cables are taut and held",
                next_step="home again when all is well",
            )

    looks = look_at_rest(rig, eye, pictures, true_pose, unless_stopped, shown=False)
    found = rest_pose(rig, looks)
    how = f"tags in {found.pictures} of {pictures} pictures, camera {eye[0].name!r}"
    return reference_at(rig, found.pose, stand.counts, stand.tensions, how, found.uncertainty)
