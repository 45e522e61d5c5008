"""The straight way of a jog: from where the platform stands, short, and free."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cdpr.plan_file import PlanDocument
    from cdpr.poses import Pose
    from cdpr.rig import Rig
    from cdpr.scene import Scene

#: A jog is no longer than this, [mm], and turns the platform by no more than that, [deg].
LONGEST_MM, MOST_DEG = 50.0, 10.0


def require_short(by_mm: tuple[float, float, float]) -> None:
    """Refuses what is no way, or a long one.

    Raises:
        BadInput: It is none.
        Refused: It is too long.
    """
    import math

    from cdpr.errors import BadInput

    if not 0.0 < math.hypot(*by_mm) < math.inf:
        raise BadInput(
            "that is no way to go", where="--by-mm", next_step="give x y z in mm, not all 0"
        )
    _require_jog(math.hypot(*by_mm), 0.0)


def moved(start: Pose, by_mm: tuple[float, float, float]) -> Pose:
    """So far from a start, and turned as there."""
    from cdpr.document_types import millimetres
    from cdpr.poses import Pose

    return Pose(start.position + millimetres(list(by_mm)), start.rotation)


def where_it_stands(rig: Rig, scene: Scene) -> Pose:
    """Asks the drives; none of them is enabled for it.

    Raises:
        Refused: Their reference is lost, or their positions fit no pose.
    """
    import numpy as np

    from cdpr.cli.drives import open_drives
    from executor.arming import require_still_referenced
    from executor.custody import Custody
    from executor.standing_pose import standing_pose

    reference = Custody(rig).require_ready()
    with open_drives(rig, rig.home, scene.load) as drives:
        require_still_referenced(rig, reference, drives.group)
        positions = drives.group.read_positions().positions
    return standing_pose(rig, np.array(positions, dtype=np.float64), scene.load)


def straight_way(rig: Rig, scene: Scene, start: Pose, goal: Pose, shown: bool) -> PlanDocument:
    """A plan that goes straight there, turning on the way where start and goal differ in it.

    Raises:
        CdprError: Start or goal cannot be used.
        Refused: It is too long, or something is in the straight way.
    """
    import numpy as np

    from cdpr.cli.plan import planned
    from cdpr.errors import Refused
    from planner.optimal.settings import OptimalSettings
    from planner.turning.settings import TurningSettings

    straight, turn = 1000.0 * start.distance_to(goal), float(np.degrees(start.angle_to(goal)))
    _require_jog(straight, turn)
    way, turns = scene.changed(start=start, goal=goal), turn > 1e-6
    settings = TurningSettings if turns else OptimalSettings
    if turns:
        way = _free_to_turn(way, (start, goal))
    document = planned(rig, way, settings(seed=0, rounds=1), shown)
    if document.quality.length_mm > straight + 0.01:
        raise Refused(
            f"the straight way of {straight:.1f} mm is not free; the way around is"
            f" {document.quality.length_mm:.1f} mm",
            where="cdpr jog",
            why="cables or platform would come too near to something on the straight way",
            next_step="jog another way, or plan a path with `cdpr plan --start-mm`",
        )
    return document


def _require_jog(length_mm: float, turn_deg: float) -> None:
    from cdpr.errors import Refused

    if length_mm > LONGEST_MM or turn_deg > MOST_DEG:
        raise Refused(
            f"a jog of {length_mm:.1f} mm and {turn_deg:.1f}° is longer than {LONGEST_MM:g} mm or"
            f" turns more than {MOST_DEG:g}°",
            where="cdpr jog",
            why="a longer way is planned around what is in it",
            next_step="jog less far, or plan a path from here with `cdpr plan --start-mm`",
        )


def _free_to_turn(scene: Scene, poses: tuple[Pose, ...]) -> Scene:
    """The scene, allowing what is between these orientations."""
    import numpy as np

    from cdpr.rotation_limits import largest_rotations
    from cdpr.scene import scene_from_document
    from cdpr.scene_file import RotationLimitsDocument

    first, last = poses[0].quaternion, poses[-1].quaternion
    tilt, turn = np.degrees(largest_rotations(first, last))
    limits = RotationLimitsDocument(
        tilt_deg=min(90.0, float(tilt) + 0.1), turn_deg=min(180.0, float(turn) + 0.1)
    )
    return scene_from_document(scene.document.model_copy(update={"rotation_limits": limits}))
