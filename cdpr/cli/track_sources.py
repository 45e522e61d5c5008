"""Where the pictures of `cdpr track` come from."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cdpr.poses import Pose
    from cdpr.rig import Camera, Rig
    from cdpr.scene import Scene
    from tracking.track import Picture


def eyes_of(
    rig: Rig, sources: list[str], wanted: str | None, where: str = "track"
) -> dict[Camera, str]:
    """Which camera's pictures come from where.

    Args:
        rig: Its cameras.
        sources: One source, or for each of several cameras ``NAME=SOURCE``.
        wanted: The camera of a single source; None for the rig's first.
        where: What names the sources, for messages.

    Raises:
        BadInput: A camera is not the rig's, is named twice, or not at all.
    """
    from cdpr.cli.camera_choice import named_camera
    from cdpr.errors import BadInput

    named = [source.partition("=") for source in sources]
    names = [camera.name for camera in rig.cameras]
    if len(sources) == 1 and named[0][0] not in names:
        return {named_camera(rig, wanted): sources[0]}
    if wanted is not None:
        raise BadInput(
            "--camera is for a single source without a name",
            where=where,
            next_step="leave it out, or name the camera in the source: NAME=SOURCE",
        )
    eyes: dict[Camera, str] = {}
    for name, sign, place in named:
        if not sign or not place:
            raise BadInput(
                f"the source {name!r} does not say which camera it is of",
                where=where,
                next_step=f"write NAME={name}, NAME one of: {', '.join(names)}",
            )
        camera = named_camera(rig, name)
        if camera in eyes:
            raise BadInput(
                f"camera {name!r} has two sources", where=where, next_step="name each camera once"
            )
        eyes[camera] = place
    return eyes


def picture_source(
    rig: Rig,
    scene: Scene | None,
    camera: Camera,
    source: str,
    plan: Path | None,
    unused: dict[str, str],
) -> tuple[Iterable[Picture], int | None]:
    """The pictures, and how many there are where that is known.

    Args:
        rig: What they show.
        scene: What else a rendered one shows.
        camera: The rig's camera that takes them.
        source: Where they come from.
        plan: The path that rendered ones show.
        unused: Becomes why files of a folder are not used, by name, as they are met.
    """
    from cdpr.cli.camera_choice import SYNTHETIC
    from cdpr.cli.output import err
    from cdpr.cli.picture_sources import require_camera_source
    from cdpr.errors import BadInput
    from drivers.cameras import LiveCamera, VideoFile
    from drivers.picture_folder import ImageFolder

    if source == SYNTHETIC:
        if plan is None or scene is None:
            raise BadInput(
                "the synthetic camera needs a path to look at",
                where="track",
                next_step="pass --plan plan.json",
            )
        rendered = _rendered_times(rig, camera, plan)
        return _rendered(rig, scene, camera, rendered), len(rendered)
    if plan is not None:
        raise BadInput(
            "--plan is for the synthetic camera",
            where="track",
            next_step="name the obstacles with --scene, or the source 'synthetic'",
        )
    path = Path(source)
    if path.is_dir():

        def skipped(name: str, why: str) -> None:
            unused[name] = why
            err.print(f"skipped: {name} {why}", markup=False, highlight=False)

        folder = ImageFolder(path, camera, on_unused=skipped)
        return folder, len(folder)
    if path.is_file():
        video = VideoFile(path, camera)
        return video, len(video)
    require_camera_source(source)
    return LiveCamera(source, camera), None


def _rendered_times(rig: Rig, camera: Camera, plan: Path) -> list[tuple[float, Pose]]:
    """Times and poses at which the synthetic camera looks: those of a run of the plan."""
    from cdpr.cli.carry_out import prepared_run
    from cdpr.cli.plan_for_rig import require_same_rig
    from cdpr.plan import load_plan

    the_plan = load_plan(plan)
    require_same_rig(the_plan, rig, plan)
    table = prepared_run(the_plan, rig, quiet=True).checked.table
    poses = table.poses()
    every = max(1, round(1.0 / (camera.rate * table.cycle)))
    return [(row * table.cycle, poses[row]) for row in range(0, len(table), every)]


def _rendered(
    rig: Rig, scene: Scene, camera: Camera, looks: list[tuple[float, Pose]]
) -> Iterable[Picture]:
    from drivers.cameras import Frame
    from simulation.motion import Film
    from simulation.simulate import make_synthetic_camera

    film = Film(make_synthetic_camera(rig, scene, camera))
    for number, (time, pose) in enumerate(looks):
        yield Frame(time, film.picture(time, pose, number), f"rendered {number}")
