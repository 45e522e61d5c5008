"""`cdpr track`: measures the platform in pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cdpr.cli.calibrations import CalibrationOption

if TYPE_CHECKING:
    from cdpr.clearance import ClearanceModel
    from cdpr.rig import Camera, Rig
    from cdpr.scene import Scene
    from tracking.pose_log import LoggedPicture
    from tracking.track import Picture
    from tracking.track_together import TogetherCount

#: A live camera that shows no tag for so many pictures is given up.
PATIENCE = 50


def track(
    rig: Annotated[Path, typer.Argument(help="rig file (YAML)", metavar="RIG")],
    source: Annotated[
        list[str],
        typer.Argument(
            help="folder of pictures, video file, camera index, or 'synthetic' with --plan;"
            " for each of several cameras NAME=SOURCE",
            metavar="SOURCE...",
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="pose log to write (CSV)", metavar="CSV")
    ],
    camera: Annotated[
        str | None, typer.Option(help="name of the camera in the rig file (default: the first)")
    ] = None,
    calibration: CalibrationOption = None,
    scene: Annotated[
        Path | None, typer.Option(help="also measure the clearance to this scene's obstacles")
    ] = None,
    plan: Annotated[
        Path | None, typer.Option(help="with 'synthetic': the path the platform follows")
    ] = None,
    pictures: Annotated[
        int | None, typer.Option(min=1, help="stop after so many; Ctrl-C also stops")
    ] = None,
    detector: Annotated[
        str | None,
        typer.Option(help="opencv or apriltag, instead of the rig file's tags: detector"),
    ] = None,
    mcap: Annotated[
        Path | None, typer.Option(help="also write the poses as MCAP", metavar="MCAP")
    ] = None,
    overlay: Annotated[
        Path | None,
        typer.Option(
            help="also draw what is measured into the pictures: a folder, or a video (.mp4, .avi)",
            metavar="DIR|VIDEO",
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="replace what exists already")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON")] = False,
) -> None:
    """Measure the platform's pose from its tags, picture by picture.

    [dim]Examples:[/dim]

      cdpr track rig.yaml pictures/ -o poses.csv

      cdpr track rig.yaml 0 -o poses.csv --scene scene.yaml --pictures 100

      cdpr track configs/gachon_8_6.yaml synthetic --plan plan.json -o poses.csv

      cdpr track rig.yaml front=0 side=1 -o poses.csv
    """
    import time
    from dataclasses import replace
    from itertools import islice, takewhile

    from cdpr.clearance import ClearanceModel
    from cdpr.cli.calibrations import calibrated_rig
    from cdpr.cli.camera_line import rates
    from cdpr.cli.compiling import ready_to_measure
    from cdpr.cli.output import progress_bar, show_facts, show_json
    from cdpr.cli.plan import check_output
    from cdpr.cli.track_facts import track_facts
    from cdpr.cli.track_sources import eyes_of, picture_source, refuse_unused_plan
    from cdpr.rig import load_rig
    from executor.running import stop_requests
    from executor.track_mcap import write_track_mcap
    from executor.wishes import OwnBoard
    from tracking.measurement import PoseMeasurement
    from tracking.pace import Pace
    from tracking.pose_log import write_pose_log
    from tracking.track import TrackCount
    from tracking.track import track as tracked
    from tracking.track_together import TogetherCount
    from tracking.tracker import Tracker

    check_output(output, force)
    if mcap is not None:
        check_output(mcap, force)
    the_rig = calibrated_rig(load_rig(rig), calibration)
    if detector is not None:
        the_rig = replace(the_rig, tag_detector=detector)
    eyes = eyes_of(the_rig, source, camera)
    several = len(eyes) > 1
    logs = {eye.name: _own_file(output, eye.name) for eye in eyes} if several else {}
    for path in logs.values():
        check_output(path, force)
    refuse_unused_plan(eyes.values(), plan)
    the_scene = _scene(scene, plan)
    ready_to_measure(not as_json)
    unused: dict[str, dict[str, str]] = {eye.name: {} for eye in eyes}
    opened = [
        picture_source(the_rig, the_scene, eye, name, plan, unused[eye.name])
        for eye, name in eyes.items()
    ]
    totals = [total for _, total in opened if total is not None]
    total = max(totals) if len(totals) == len(opened) else None
    model = ClearanceModel(the_rig, the_scene) if the_scene and the_scene.obstacles else None
    logged: list[LoggedPicture] = []
    each: dict[str, list[LoggedPicture]] = {eye.name: [] for eye in eyes}
    count, shared, pace, board = TrackCount(), TogetherCount(), Pace(), OwnBoard()
    began = time.time_ns()
    with (
        ExitStack() as drawing,
        stop_requests(board),
        progress_bar("tracking", pictures or total, not as_json) as show,
    ):
        streams: dict[str, Iterator[LoggedPicture]] = {}
        for eye, (frames, length) in zip(eyes, opened, strict=True):
            place = _own_drawing(overlay, eye.name) if overlay and several else overlay
            streams[eye.name] = tracked(
                takewhile(lambda _: not board.read().stop, islice(frames, pictures)),
                Tracker(the_rig, eye),
                count,
                give_up_after=PATIENCE if length is None and not several else None,
                model=model,
                on_picture=drawing.enter_context(_overlay(place, the_rig, eye, force)),
            )
        # The fastest tells what one moment is, whichever is named first.
        within = 0.5 / max(eye.rate for eye in eyes)
        for found, alone in _all_of(streams, within, shared, model):
            logged.append(found)
            for name, one in alone.items():
                each[name].append(one)
            pace.take(time.monotonic(), count.seconds[-1])
            seen = found.observation
            tags = len(seen.tags) if isinstance(seen, PoseMeasurement) else 0
            show(len(logged), rates(pace.pictures_per_second, pace.measuring_ms, tags))
    for name, path in logs.items():
        write_pose_log(path, each[name], with_clearance=model is not None)
    write_pose_log(output, logged, with_clearance=model is not None)
    if mcap is not None:
        write_track_mcap(mcap, logged, each if several else {}, began)
    took = (time.time_ns() - began) * 1e-9
    facts = track_facts(logged, output, count, shared if several else None, took)
    if as_json:
        show_json({**facts, "unused": _by_file(unused)})
    else:
        show_facts(f"poses in {output}", [(k.replace("_", " "), str(v)) for k, v in facts.items()])


def _own_file(output: Path, name: str) -> Path:
    """Where one of several cameras is logged alone: ``poses-front.csv`` beside ``poses.csv``."""
    return output.with_name(f"{output.stem}-{name}{output.suffix}")


def _own_drawing(overlay: Path, name: str) -> Path:
    """Where one of several cameras' pictures are drawn: a video like a log, or a folder inside."""
    is_folder = overlay.is_dir() or not overlay.suffix
    return overlay / name if is_folder else _own_file(overlay, name)


def _by_file(unused: dict[str, dict[str, str]]) -> dict[str, str]:
    """Why files are not used, by name; of several cameras by ``NAME/FILE``."""
    several = len(unused) > 1
    return {
        f"{camera}/{name}" if several else name: why
        for camera, files in unused.items()
        for name, why in files.items()
    }


def _all_of(
    streams: dict[str, Iterator[LoggedPicture]],
    within: float,
    count: TogetherCount,
    model: ClearanceModel | None,
) -> Iterator[tuple[LoggedPicture, dict[str, LoggedPicture]]]:
    """What is measured together and by each camera alone."""
    from tracking.track_together import track_together

    if len(streams) > 1:
        yield from track_together(streams, within, count, model)
        return
    for name, stream in streams.items():
        for found in stream:
            yield found, {name: found}


def _scene(scene: Path | None, plan: Path | None) -> Scene | None:
    from cdpr.plan import load_plan
    from cdpr.scene import load_scene

    if scene is not None:
        return load_scene(scene)
    return load_plan(plan).scene if plan is not None else None


@contextmanager
def _overlay(
    place: Path | None, rig: Rig, camera: Camera, force: bool
) -> Iterator[Callable[[Picture, LoggedPicture], None] | None]:
    """What draws each picture's measurement into it; None without a place for it."""
    if place is None:
        yield None
        return
    from drivers.picture_output import PictureOutput
    from tracking.overlay import drawn_over

    with PictureOutput(place, camera.rate, force) as out:

        def draw(picture: Picture, logged: LoggedPicture) -> None:
            found = logged.observation
            out.write(drawn_over(picture.image, rig, camera, found, logged.clearance), picture.name)

        yield draw
