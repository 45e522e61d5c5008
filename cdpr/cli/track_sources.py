"""Where the pictures of `cdpr track` come from."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
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

    names = [camera.name for camera in rig.cameras]
    if len(sources) == 1 and _is_unnamed(sources[0], names):
        return {named_camera(rig, wanted): sources[0]}
    if wanted is not None:
        raise BadInput(
            "--camera is for a single source without a name",
            where=where,
            next_step="leave it out, or name the camera in the source: NAME=SOURCE",
        )
    eyes: dict[Camera, str] = {}
    for source in sources:
        name, sign, place = source.partition("=")
        if name in names and not place:
            raise BadInput(
                f"camera {name!r} has no source",
                where=where,
                next_step=f"write {name}=0, or what its pictures come from",
            )
        if not sign or "://" in name:
            raise BadInput(
                f"the source {source!r} does not say which camera it is of",
                where=where,
                next_step=f"write NAME={source}, NAME one of: {', '.join(names)}",
            )
        camera = named_camera(rig, name)
        if camera in eyes:
            raise BadInput(
                f"camera {name!r} has two sources", where=where, next_step="name each camera once"
            )
        _require_own(place, eyes, name, where)
        eyes[camera] = place
    return eyes


def _is_unnamed(source: str, names: list[str]) -> bool:
    """Whether a source names no camera: ``0``, an address or a path, and not ``WORD=0``."""
    word, sign, _ = source.partition("=")
    if not sign:
        return word not in names or Path(source).exists()
    return "://" in word or (word not in names and Path(source).exists())


def _require_own(place: str, eyes: Mapping[Camera, str], name: str, where: str) -> None:
    """Two cameras cannot take the same pictures."""
    from cdpr.cli.camera_choice import SYNTHETIC
    from cdpr.errors import BadInput

    for camera, other in eyes.items():
        if place != SYNTHETIC and _device(place) == _device(other):
            raise BadInput(
                f"cameras {camera.name!r} and {name!r} have the same source {place!r}",
                where=where,
                next_step="give each camera its own",
            )


def _device(source: str) -> str:
    """A source, the same for both names of a camera of this machine: ``0`` and ``/dev/video0``."""
    return source.removeprefix("/dev/video")


def refuse_unused_plan(sources: Iterable[str], plan: Path | None) -> None:
    """A path is for rendered pictures.

    Raises:
        BadInput: There is one, and no source is ``synthetic``.
    """
    from cdpr.cli.camera_choice import SYNTHETIC
    from cdpr.errors import BadInput

    named = list(sources)
    if plan is not None and SYNTHETIC not in named:
        raise BadInput(
            "--plan is for the synthetic camera",
            where="track",
            why=f"pictures come from {', '.join(named)}",
            next_step="name the obstacles with --scene, or the source 'synthetic'",
        )


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
                where=f"track, camera {camera.name!r}",
                next_step="pass --plan plan.json",
            )
        rendered = _rendered_times(rig, camera, plan)
        return _rendered(rig, scene, camera, rendered), len(rendered)
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
