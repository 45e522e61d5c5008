"""Which of the rig's cameras look at it, and where the pictures of each come from."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cdpr.errors import BadInput

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

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
    if wanted != SYNTHETIC:
        _require_live(wanted)
    return wanted


def _require_live(source: str) -> None:
    """What was recorded shows nothing of a platform that moves now."""
    from cdpr.cli.picture_sources import is_camera

    if not is_camera(source):
        raise BadInput(
            f"{source!r} is no camera",
            where="--camera",
            why="pictures must be taken while the platform moves; a file or a folder has others",
            next_step="name an index such as 0, a device such as /dev/video0, or an address",
        )


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


def choose_one_camera(rig: Rig, wanted: list[str], in_process: bool) -> tuple[Camera, str]:
    """The one camera that measures a platform at rest, and where its pictures come from.

    Args:
        rig: Its cameras.
        wanted: One source, or ``NAME=SOURCE``.
        in_process: The drives are simulated in this process.

    Raises:
        BadInput: There are several, or the wish cannot be met.
    """
    from cdpr.cli.track_sources import eyes_of

    if len(wanted) != 1:
        raise BadInput(
            f"{len(wanted)} cameras are named, and one measures",
            where="--camera",
            next_step="name the one that sees the most tags, from the nearest",
        )
    ((camera, source),) = eyes_of(rig, wanted, None, "--camera").items()
    choose_camera(rig, source, False, in_process)
    return camera, source


def require_simulated_pictures(sources: Iterable[str], fast: bool) -> None:
    """In simulated time a real camera's pictures would be stamped with times that mean nothing.

    Raises:
        BadInput: ``--fast`` is given, and a source is a real camera.
    """
    real = [source for source in sources if source != SYNTHETIC]
    if fast and real:
        raise BadInput(
            "--fast needs synthetic cameras",
            where=f"--camera {real[0]}",
            why="a real camera takes its pictures in real time, and the run would be over before",
            next_step="leave --fast out, or pass --camera synthetic",
        )


def looked_with(eyes: Mapping[Camera, str]) -> str:
    """The cameras of a run and their sources, in a few words."""
    return ", ".join(f"{camera.name} ({source})" for camera, source in eyes.items())
