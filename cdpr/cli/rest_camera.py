"""One camera that measures a platform at rest, in a process of its own as in a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from cdpr.poses import Pose
    from cdpr.rig import Camera, Rig
    from tracking.measurement import Observation


def look_at_rest(
    rig: Rig,
    eye: tuple[Camera, str],
    pictures: int,
    true_pose: Pose | None,
    unless_stopped: Callable[[], None],
    *,
    shown: bool,
) -> list[Observation]:
    """Opens the camera, takes pictures of a platform that stands still, measures each.

    Args:
        rig: The robot.
        eye: From `choose_one_camera`.
        pictures: How many.
        true_pose: Where the simulated platform is.
        unless_stopped: Called all the while; what it raises ends the looking.
        shown: Whether a spinner may turn while the camera opens.
    """
    from contextlib import closing
    from functools import partial

    from cdpr.cli.camera_choice import SYNTHETIC
    from cdpr.cli.cameras import make_observer
    from cdpr.cli.output import spinner
    from cdpr.scene import nothing_in_the_way
    from executor.camera_process import CameraProcess
    from executor.camera_start import wait_until_ready
    from executor.rest_looks import looks_at_rest

    camera, source = eye
    scene = nothing_in_the_way(rig).document
    make = partial(
        make_observer, rig.document, scene, camera.name, source, None, pictures, named=False
    )
    period = 1.0 / camera.rate if source == SYNTHETIC else None
    with closing(CameraProcess(camera.name, make, may_wait=False)) as process:
        with spinner(f"opening camera {camera.name}", shown):
            wait_until_ready([process], unless_stopped)
        return looks_at_rest(process, pictures, period, true_pose, unless_stopped)
