"""Which of the rig's cameras look at it, and where the pictures of each come from."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cdpr.errors import BadInput

if TYPE_CHECKING:
    from collections.abc import Mapping

    from cdpr.rig import Camera, Rig

SYNTHETIC = "synthetic"


def named_camera(rig: Rig, name: str | None) -> Camera:
    """The rig's camera of a name; its first when no name is given.

    Raises:
        BadInput: The rig has none of this name, or none at all.
    """
    names = [camera.name for camera in rig.cameras]
    if not names:
        raise BadInput(
            "the rig file has no camera", where=rig.name, next_step="add a `cameras` section"
        )
    if name is None:
        return rig.cameras[0]
    if name not in names:
        raise BadInput(
            f"no camera {name!r}", where=rig.name, next_step=f"name one of: {', '.join(names)}"
        )
    return rig.cameras[names.index(name)]


def choose_camera(rig: Rig, wanted: str | None, without: bool, in_process: bool) -> str | None:
    """Where pictures come from: ``synthetic``, a camera's index or address, or None.

    Raises:
        BadInput: The wish cannot be met; nothing is left out silently.
    """
    if without:
        if wanted is not None:
            raise BadInput(
                "--camera and --no-camera contradict each other", next_step="leave one of them out"
            )
        return None
    if not rig.cameras or not rig.platform_tags:
        raise BadInput(
            "the rig file has no camera or no tags",
            where=rig.name,
            next_step="add cameras and tags to the rig file, or pass --no-camera",
        )
    if wanted is None:
        if not in_process:
            raise BadInput(
                "no camera was named",
                where="--camera",
                why="the drives are not simulated in this process, so no picture can be rendered",
                next_step="pass --camera INDEX for a real camera, or --no-camera",
            )
        return SYNTHETIC
    if wanted == SYNTHETIC and not in_process:
        raise BadInput(
            "the synthetic camera needs drives that are simulated in this process",
            where="--camera",
            next_step="use the interface 'virtual', a real camera, or --no-camera",
        )
    return wanted


def choose_cameras(
    rig: Rig, wanted: list[str], without: bool, in_process: bool
) -> dict[Camera, str]:
    """Which of the rig's cameras look at a run, and where the pictures of each come from.

    Args:
        rig: Its cameras.
        wanted: One source, or for each of several cameras ``NAME=SOURCE``; ``synthetic`` alone, as
            nothing at all, stands for all of them.
        without: No camera is wanted.
        in_process: The drives are simulated in this process.

    Raises:
        BadInput: The wish cannot be met; nothing is left out silently.
    """
    from cdpr.cli.track_sources import eyes_of

    if not wanted:
        source = choose_camera(rig, None, without, in_process)
        return {} if source is None else dict.fromkeys(rig.cameras, source)
    if wanted == [SYNTHETIC]:
        choose_camera(rig, SYNTHETIC, without, in_process)
        return dict.fromkeys(rig.cameras, SYNTHETIC)
    if rig.cameras:
        eyes = eyes_of(rig, wanted, None, "--camera")
        for source in eyes.values():
            choose_camera(rig, source, without, in_process)
        return eyes
    choose_camera(rig, wanted[0], without, in_process)
    return {}


def looked_with(eyes: Mapping[Camera, str]) -> str:
    """The cameras of a run and their sources, in a few words."""
    return ", ".join(f"{camera.name} ({source})" for camera, source in eyes.items())
