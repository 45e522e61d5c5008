"""`cdpr track`: measures the platform's pose in images."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cdpr.cli.arguments import argument, flag, option, required
from cdpr.cli.operate.supervision import stop_requests
from cdpr.cli.options import CALIBRATION, JSON, RIG, calibrated_rig
from cdpr.cli.output import Terminal, err, present, show_line
from executor.cameras.sources import parse_camera_sources, require_plan_used
from executor.supervision import LocalRequests
from executor.track import TrackResult, own_drawing, own_file, track_sources
from model.files.output import refuse_overwriting, require_new_file
from model.plan import load_plan, require_same_rig
from model.rig import Camera, load_rig
from model.scene import load_scene


def track(
    *,
    rig: Path = RIG,
    source: list[str] = argument(
        "folder of images, video file, camera index, or 'synthetic' with --plan; for several"
        " cameras NAME=SOURCE, repeated",
        "SOURCE...",
    ),
    output: Path = required("pose log to write (CSV)", "-o", "--output", metavar="CSV"),
    camera: str | None = option("name of the camera in the rig file (default: the first)"),
    calibration: list[Path] | None = CALIBRATION,
    scene: Path | None = option("also measure the clearance to this scene's obstacles"),
    plan: Path | None = option("with 'synthetic': plan that the platform follows"),
    pictures: int | None = option("largest number of images; Ctrl-C also stops", min=1),
    detector: str | None = option("opencv or apriltag, overriding tags.detector of the rig file"),
    mcap: Path | None = option("also write the poses as MCAP", metavar="MCAP"),
    overlay: Path | None = option(
        "also write images with the measurements: a folder or a video (.mp4, .avi)",
        metavar="DIR|VIDEO",
    ),
    force: bool = flag("replace existing output"),
    as_json: bool = JSON,
) -> None:
    """Measure the platform's pose from its tags, image by image.

    Several live cameras are read in turn, at the pace of the slowest.

    Examples:
      cdpr track rig.yaml pictures/ -o poses.csv
      cdpr track rig.yaml 0 -o poses.csv --scene scene.yaml --pictures 100
      cdpr track configs/gachon_8_6.yaml synthetic --plan plan.json -o poses.csv
      cdpr track rig.yaml front=0 side=1 -o poses.csv
    """
    the_rig = calibrated_rig(load_rig(rig), calibration)
    if detector is not None:
        the_rig = the_rig.with_tag_detector(detector)
    sources = parse_camera_sources(the_rig, source, camera)
    _require_outputs(sources, output, mcap, overlay, force)
    require_plan_used(sources.values(), plan)
    the_scene = None if scene is None else load_scene(scene)
    the_plan = None if plan is None else load_plan(plan)
    if plan is not None and the_plan is not None:
        require_same_rig(the_plan, the_rig, plan)
    requests = LocalRequests()

    def keep(partial: TrackResult) -> None:
        partial.save(output, mcap)
        show_line(f"{len(partial.pictures)} images before the error are in {output}", err)

    with stop_requests(requests):
        result = track_sources(
            the_rig,
            sources,
            scene=the_scene,
            plan=the_plan,
            pictures=pictures,
            overlay=overlay,
            replace_overlay=force,
            stopped=lambda: requests.read().stop,
            keep=keep,
            listener=Terminal(quiet=as_json),
        )
    result.save(output, mcap)
    found = {"poses_file": str(output), **result.summary()}
    facts = [("poses file", str(output)), *result.facts()]
    present(as_json, {**found, "unused": result.unused_files()}, f"poses in {output}", facts)


def _require_outputs(
    sources: Mapping[Camera, str],
    output: Path,
    mcap: Path | None,
    overlay: Path | None,
    force: bool,
) -> None:
    """Refuses outputs that cannot be written, or that are the same file as another or an input."""
    several = [camera.name for camera in sources] if len(sources) > 1 else []
    written = {"--output": output}
    if mcap is not None:
        written["--mcap"] = mcap
    written |= {f"the log of {name}": own_file(output, name) for name in several}
    for path in written.values():
        require_new_file(path, force)
    if overlay is not None:
        written["--overlay"] = overlay
        written |= {f"the overlay of {name}": own_drawing(overlay, name) for name in several}
    refuse_overwriting(written, [Path(source) for source in sources.values()])
