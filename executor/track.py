"""Measures the platform in folders of images, videos, live and synthetic cameras."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from itertools import islice, takewhile
from pathlib import Path

import numpy as np

from drivers.cameras.files import ImageFolder, ImageOutput, natural_order
from drivers.cameras.frame_reader import CopyCheck
from drivers.cameras.live import Frame, LiveCamera, VideoFile
from executor.cameras.sources import (
    SYNTHETIC,
    cycles_per_image,
    report_different_videos,
    report_gap,
    require_camera_source,
    require_one_kind,
    require_plan_used,
)
from executor.kernels import ready_to_measure
from executor.recording.clearance import source_of
from executor.recording.mcap import write_track_mcap
from executor.trajectory.setpoints import prepare
from model.clearance import ClearanceModel
from model.errors import BadInput, CdprError, StoppedByOperator, path_of
from model.files.reading import is_folder
from model.pages.page import FactsDisplay
from model.plan import Plan, require_same_rig
from model.pose import Pose
from model.progress import SILENT, Listener, skipped_files
from model.rig import Camera, Rig
from model.scene import Scene
from planner.check import verify
from simulation.camera.camera import ImageSequence
from simulation.factory import make_synthetic_camera
from tracking.measurement import FrameRate, PoseMeasurement
from tracking.pose_log import LoggedImage, write_pose_log
from tracking.track import (
    MultiCameraCount,
    SourceImage,
    TrackCount,
    draw_measurement,
    track,
    track_cameras,
)
from tracking.tracker import Tracker

#: Images without a tag after which tracking with a live camera ends.
PATIENCE = 50
_LABELS = {  # of key figures in text; their names in JSON stay
    "moments_apart": "frame sets with images too far apart in time",
    "moments_without_speed": "frame sets with a pose of unknown velocity",
    "common_deviation_mm": "deviation common to all images mm",
}


@dataclass(slots=True)
class TrackResult(FactsDisplay):
    """Result of tracking.

    Attributes:
        pictures: Measurements of all cameras, fused, in order of time.
        by_camera: Measurements of each of several cameras, by its name; empty for one camera.
        count: Number of measured images, and time per image.
        together: Images of several cameras without partners; None for one camera.
        unused: Why files were not used, by camera and name.
        with_clearance: Whether obstacles are known.
        began: Time 0 of the measurements, [ns since 1970]; for live cameras that of their clock.
        seconds: Total time, [s].
    """

    pictures: list[LoggedImage] = field(default_factory=list)
    by_camera: dict[str, list[LoggedImage]] = field(default_factory=dict)
    count: TrackCount = field(default_factory=TrackCount)
    together: MultiCameraCount | None = None
    unused: dict[str, dict[str, str]] = field(default_factory=dict)
    with_clearance: bool = False
    began: int = field(default_factory=time.time_ns)
    seconds: float = 0.0

    @property
    def poses(self) -> list[PoseMeasurement]:
        """All poses found."""
        found = (logged.observation for logged in self.pictures)
        return [one for one in found if isinstance(one, PoseMeasurement)]

    def __repr__(self) -> str:
        """Numbers of images and poses."""
        return f"<TrackResult {len(self.poses)} poses in {len(self.pictures)} images>"

    def facts(self) -> list[tuple[str, str]]:
        """The summary as text."""
        known = ((_LABELS.get(k, k.replace("_", " ")), v) for k, v in self.summary().items())
        return [(k.replace("picture", "image"), "–" if v is None else str(v)) for k, v in known]

    def summary(self) -> dict[str, int | float | str | None]:
        """Key figures, with units in their names; None where there is no pose or no image."""
        poses, logged = self.poses, self.pictures
        deviations = [float(np.linalg.norm(p.position_deviation)) for p in poses]
        facts: dict[str, int | float | str | None] = {
            "pictures": len(logged),
            "poses": len(poses),
            "position_deviation_mm": _median(deviations, 1000, 4),
            "reprojection_px": _median([p.reprojection for p in poses], 1, 4),
            "pictures_per_second": round(len(logged) / self.seconds, 1) if self.seconds else None,
            "measuring_ms": _median(self.count.seconds, 1000, 2),
        }
        if self.together is not None:
            facts["pictures_without_partner"] = self.together.without_partner
            facts["moments_apart"] = self.together.apart
            facts["moments_without_speed"] = self.together.without_speed
        common = [float(np.sqrt(np.trace(p.shared[:3, :3]))) for p in poses if not p.unstated]
        if common:
            facts["common_deviation_mm"] = _median(common, 1000, 4)
        # Cameras that contradict each other have no fused pose, but one of them may be right.
        sources = [("tag", logged), *((source_of(n), of) for n, of in self.by_camera.items())]
        clearances = [(p.clearance, name) for name, of in sources for p in of if p.clearance]
        if clearances:
            nearest, source = min(clearances, key=lambda c: c[0].distance)
            facts["smallest_clearance_mm"] = round(nearest.distance * 1000, 3)
            facts["clearance_uncertainty_mm"] = round(nearest.uncertainty * 1000, 3)
            facts["clearance_at_most_mm"] = round(nearest.at_most * 1000, 3)
            if self.by_camera:
                facts["clearance_source"] = source
        return facts

    def unused_files(self) -> dict[str, str]:
        """Why files were not used, by name; for several cameras by ``NAME/FILE``."""
        several = len(self.unused) > 1
        return {
            f"{camera}/{name}" if several else name: why
            for camera, files in self.unused.items()
            for name, why in files.items()
        }

    def save(self, path: Path | str, mcap: Path | str | None = None) -> None:
        """Writes the pose log, one more for each of several cameras, and MCAP.

        Raises:
            BadInput: A file cannot be written.
            Fault: The disk is full or gone.
        """
        path = path_of(path)
        for name, logged in self.by_camera.items():
            write_pose_log(own_file(path, name), logged, with_clearance=self.with_clearance)
        write_pose_log(path, self.pictures, with_clearance=self.with_clearance)
        if mcap is not None:
            write_track_mcap(path_of(mcap), self.pictures, self.by_camera, self.began)


def _median(values: Sequence[float], scale: int, digits: int) -> float | None:
    return round(float(np.median(values)) * scale, digits) if values else None


def own_file(path: Path, name: str) -> Path:
    """File of one of several cameras: ``poses-front.csv`` beside ``poses.csv``."""
    return path.with_name(f"{path.stem}-{name}{path.suffix}")


def own_drawing(overlay: Path, name: str) -> Path:
    """Overlay of one of several cameras: a video beside the given one, or a subfolder."""
    return overlay / name if is_folder(overlay) or not overlay.suffix else own_file(overlay, name)


def track_sources(
    rig: Rig,
    sources: Mapping[Camera, str],
    *,
    scene: Scene | None = None,
    plan: Plan | None = None,
    pictures: int | None = None,
    overlay: Path | None = None,
    replace_overlay: bool = False,
    stopped: Callable[[], bool] = lambda: False,
    keep: Callable[[TrackResult], None] = lambda _partial: None,
    listener: Listener = SILENT,
) -> TrackResult:
    """Measures the platform's pose image by image, by one camera or several together.

    Args:
        sources: A folder, a video file, a camera's index or address, or ``synthetic``, for each
            camera; see `executor.cameras.sources.parse_camera_sources`.
        scene: Obstacles for the clearance; None for the plan's.
        plan: Motion of the platform for synthetic cameras.
        pictures: Largest number of images per camera.
        overlay: Folder or video for the images with measurements drawn in.
        replace_overlay: Whether it may exist.
        stopped: Called before each image, and while a live camera delivers none; True ends
            tracking.
        keep: Called with what was measured before an error that ends tracking, unless no image gave
            a pose or, with several cameras, no frame set was complete; the error is then raised.
        listener: Receives progress, files that are not used, and remarks on times.

    Raises:
        NoPlatformSeen: No image gave a pose.
        BadInput: A source cannot be used, or an image is of another size.
        HardwareMissing: A camera does not open.
        CameraMoved: Frame tags differ from their positions in the rig file.
        StoppedByOperator: Stopped before the first image.
    """
    require_plan_used(sources.values(), plan)
    require_one_kind({camera.name: source for camera, source in sources.items()})
    the_scene = plan.scene if scene is None and plan is not None else scene
    ready_to_measure(listener)
    several = len(sources) > 1
    model = ClearanceModel(rig, the_scene) if the_scene and the_scene.obstacles else None
    result = TrackResult(
        by_camera={camera.name: [] for camera in sources} if several else {},
        together=MultiCameraCount() if several else None,
        with_clearance=model is not None,
    )
    opened = [
        _opened(rig, the_scene, camera, source, plan, stopped, listener)
        for camera, source in sources.items()
    ]
    result.unused = {
        camera.name: frames.unused if isinstance(frames, ImageFolder | VideoFile) else {}
        for camera, (frames, _) in zip(sources, opened, strict=True)
    }
    opened, within = _simultaneous(list(sources), opened, listener)
    copies = [CopyCheck() for _ in opened]
    is_live = any(length is None for _, length in opened)  # then times are of the monotonic clock
    total = None if is_live else max(length or 0 for _, length in opened)
    result.began = time.time_ns() - (time.monotonic_ns() if is_live else 0)
    with ExitStack() as drawing, listener.progress("tracking", pictures or total) as advance:
        streams: dict[str, Iterator[LoggedImage]] = {}
        for camera, (frames, length), check in zip(sources, opened, copies, strict=True):
            target = own_drawing(overlay, camera.name) if overlay and several else overlay
            rate = frames.rate if isinstance(frames, VideoFile) else camera.rate
            draw = drawing.enter_context(_overlay(target, rig, camera, rate, replace_overlay))
            new = frames if sources[camera] == SYNTHETIC else _without_copies(frames, check)
            streams[camera.name] = track(
                takewhile(lambda _: not stopped(), islice(new, pictures)),
                Tracker(rig, camera),
                result.count,
                give_up_after=PATIENCE if length is None and not several else None,
                model=model,
                on_image=draw,
            )
        try:
            _measure(_together(rig, streams, within, result.together, model), result, advance)
        except (CdprError, KeyboardInterrupt):
            if result.count.poses and result.pictures:
                keep(result)
            if not result.count.pictures and stopped():
                raise StoppedByOperator("stopped before the first image") from None
            raise
        finally:
            for text in skipped_files(result.unused_files()):
                listener.remark(text)
            for text in result.together.remarks if result.together is not None else ():
                listener.remark(text)
            for camera, (frames, _), check in zip(sources, opened, copies, strict=True):
                live = (frames.late, frames.truncated) if isinstance(frames, LiveCamera) else (0, 0)
                for text in _not_measured(check.count, *live):
                    listener.remark(f"camera {camera.name}: {text}")
    return result


def _not_measured(copies: int, late: int, truncated: int) -> Iterator[str]:
    """Why images of a camera were not measured, and how many."""
    if copies:
        are = "1 image is an exact copy" if copies == 1 else f"{copies} images are exact copies"
        yield (
            f"{are} of the one before and {'was' if copies == 1 else 'were'} not measured:"
            " some recorders and converters repeat an image in place of a lost one"
        )
    if late:
        were = "1 image came late and was" if late == 1 else f"{late} images came late and were"
        yield f"{were} skipped, as the delay in the network or the computer is unknown"
    if truncated:
        were = "1 image was" if truncated == 1 else f"{truncated} images were"
        yield f"{were} truncated and not measured: the camera or the network is overloaded"


def _simultaneous(
    cameras: Sequence[Camera],
    opened: list[tuple[Iterable[SourceImage], int | None]],
    listener: Listener,
) -> tuple[list[tuple[Iterable[SourceImage], int | None]], float]:
    """The opened sources with times common to all cameras.

    Returns:
        The sources, and the distance from the median time within which images are fused, [s]; 0
        for folders, whose simultaneous images have the same name.
    """
    named = {camera.name: frames for camera, (frames, _) in zip(cameras, opened, strict=True)}
    folders = {name: one for name, one in named.items() if isinstance(one, ImageFolder)}
    videos = {name: one for name, one in named.items() if isinstance(one, VideoFile)}
    times = _times_by_name(folders, listener) if len(folders) > 1 else {}
    names = list(times) or [name for folder in folders.values() for name in folder.names]
    report_gap(names, listener)
    if times:
        return [
            ((replace(frame, time=times[frame.name]) for frame in folder), len(folder))
            for folder in folders.values()
        ], 0.0
    report_different_videos({name: (len(one), one.rate) for name, one in videos.items()}, listener)
    # The fastest camera defines the time window of simultaneous images.
    return opened, 0.5 / max(camera.rate for camera in cameras)


def _times_by_name(folders: Mapping[str, ImageFolder], listener: Listener) -> dict[str, float]:
    """Times of the images of several cameras: those with the same name are simultaneous.

    All names are numbered together, so that an image that one camera lost shifts no other. The
    rate is the highest at which no camera exceeds its own.

    Args:
        folders: Of each camera, by its name.
        listener: Receives a remark if the cameras' rates contradict the numbers of their images.

    Returns:
        By file name, increasing in the order of each folder, [s].
    """
    names = {camera: folder.names for camera, folder in folders.items()}
    count = Counter(name for own in names.values() for name in own)
    for camera, own in names.items():
        possible = min(len(own), max(len(one) for other, one in names.items() if other != camera))
        common = sum(count[name] > 1 for name in own)
        if 2 * common < possible:
            raise BadInput(
                f"{common} of the {len(own)} images of camera {camera!r} have the name of an image"
                " of another camera",
                where=", ".join(f"{other}: {one[0]} … {one[-1]}" for other, one in names.items()),
                why="images are paired by their names, as a folder does not contain their times",
                next_step="give images taken at the same time the same name in every folder",
            )
    order = {name: k for k, name in enumerate(sorted(count, key=natural_order(count)))}
    rates = {
        camera: folders[camera].rate * float(np.median(np.diff([order[name] for name in own])))
        for camera, own in names.items()
        if len(own) > 1
    } or {camera: folder.rate for camera, folder in folders.items()}
    rate = min(rates.values())
    if max(rates.values()) > 1.4 * rate:
        listener.remark(
            f"images with the same name are taken as simultaneous, {rate:.6g} per second; by their"
            f" own rate_hz it would be {', '.join(f'{n} {one:.6g}' for n, one in rates.items())}"
        )
    return {name: k / rate for name, k in order.items()}


def _measure(
    measured: Iterator[tuple[LoggedImage, dict[str, LoggedImage]]],
    result: TrackResult,
    advance: Callable[[float, str], None],
) -> None:
    """Adds all measurements to the result."""
    pace, began = FrameRate(), time.monotonic()
    for found, alone in measured:
        result.pictures.append(found)
        for name in result.by_camera.keys() & alone:
            result.by_camera[name].append(alone[name])
        now = time.monotonic()
        result.seconds = now - began
        pace.take(now, result.count.seconds[-1])
        tags = found.observation.tags if isinstance(found.observation, PoseMeasurement) else ()
        advance(len(result.pictures), pace.text(len(tags)))


def _together(
    rig: Rig,
    streams: dict[str, Iterator[LoggedImage]],
    within: float,
    count: MultiCameraCount | None,
    model: ClearanceModel | None,
) -> Iterator[tuple[LoggedImage, dict[str, LoggedImage]]]:
    """Fused measurements, with those of each camera."""
    if count is not None:
        return track_cameras(rig, streams, within, count, model)
    return ((found, {name: found}) for name, stream in streams.items() for found in stream)


def _without_copies(frames: Iterable[SourceImage], check: CopyCheck) -> Iterator[SourceImage]:
    return (frame for frame in frames if not check.is_copy(frame.image))


@contextmanager
def _overlay(
    target: Path | None, rig: Rig, camera: Camera, rate: float, replace: bool
) -> Iterator[Callable[[SourceImage, LoggedImage], None] | None]:
    """A function that writes images with measurements drawn in; None without a target."""
    if target is None:
        yield None
        return
    with ImageOutput(target, rate, replace) as out:

        def draw(picture: SourceImage, logged: LoggedImage) -> None:
            found, clearance = logged.observation, logged.clearance
            out.write(draw_measurement(picture.image, rig, camera, found, clearance), picture.name)

        yield draw


def _opened(
    rig: Rig,
    scene: Scene | None,
    camera: Camera,
    source: str,
    plan: Plan | None,
    stopped: Callable[[], bool],
    listener: Listener,
) -> tuple[Iterable[SourceImage], int | None]:
    """The images of a source, and their number if known."""
    if source == SYNTHETIC:
        if plan is None or scene is None:
            raise BadInput(
                "the synthetic camera needs a path to render",
                where=f"track, camera {camera.name!r}",
                next_step="pass `plan=`, the path of the platform",
            )
        timed_poses = _poses_in_time(rig, camera, plan)
        return _rendered(rig, scene, camera, timed_poses), len(timed_poses)
    path = path_of(source)
    if is_folder(path):
        folder = ImageFolder(path, camera, cameras=rig.cameras)
        return folder, len(folder)
    if path.is_file():
        video = VideoFile(path, camera, cameras=rig.cameras)
        if video.remark:
            listener.remark(video.remark)
        return video, len(video)
    require_camera_source(source)
    return LiveCamera(source, camera, stopped=stopped, cameras=rig.cameras), None


def _poses_in_time(rig: Rig, camera: Camera, plan: Plan) -> list[tuple[float, Pose]]:
    """Times and poses of the synthetic camera's images along a run of the plan."""
    require_same_rig(plan, rig, f"plan for {plan.rig.name}")
    table = prepare(verify(plan, rig), rig).checked.table
    poses = table.poses()
    every = cycles_per_image(camera.rate, table.cycle)
    return [(row * table.cycle, poses[row]) for row in range(0, len(table), every)]


def _rendered(
    rig: Rig, scene: Scene, camera: Camera, timed_poses: list[tuple[float, Pose]]
) -> Iterable[SourceImage]:
    film = ImageSequence(make_synthetic_camera(rig, scene, camera))
    for number, (at, pose) in enumerate(timed_poses):
        yield Frame(at, film.image(at, pose, number), f"rendered {number}", number)
