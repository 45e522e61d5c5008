"""Measures a whole source of images, for ``cdpr track``."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations
from time import monotonic
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from model.cameras import exchanged_sources
from model.clearance import ClearanceModel
from model.errors import BadInput
from model.pose import Array, Pose
from model.rig import Camera, Rig, Tag
from tracking.camera_model import Image, pixels_of
from tracking.clearance import MeasuredClearance, clearance_of, require_stated_errors
from tracking.detection.diagnostics import MIRRORED, SOFT, UNMIRROR, diagnose_tags, edge_width
from tracking.detection.tags import mounted_rotated, tag_corners
from tracking.fusion import DISAGREE, MultiCameraFusion, synchronize_frames
from tracking.measurement import (
    ROTATED,
    SEEN_TWICE,
    UNCERTAIN,
    UNSHARP,
    Observation,
    PoseMeasurement,
    exchanged_cameras,
)
from tracking.pose_log import LoggedImage
from tracking.shared_errors import PERHAPS_MOVED
from tracking.tracker import Tracker


class SourceImage(Protocol):
    """An image of a source, such as a `drivers.cameras.live.Frame`."""

    @property
    def time(self) -> float:
        """Capture time, [s]."""

    @property
    def image(self) -> Image:
        """Grey image."""

    @property
    def name(self) -> str:
        """File name or number."""

    @property
    def number(self) -> int:
        """Number in the source, from 0."""


class NoPlatformSeen(BadInput):
    """No image of a source gave a pose."""

    code = "no_platform_seen"


@dataclass(slots=True)
class TrackCount:
    """Images and poses of a source so far, and the measuring time of each image, [s]."""

    pictures: int = 0
    poses: int = 0
    seconds: list[float] = field(default_factory=list)


def track(
    source: Iterable[SourceImage],
    tracker: Tracker,
    count: TrackCount | None = None,
    give_up_after: int | None = None,
    model: ClearanceModel | None = None,
    on_image: Callable[[SourceImage, LoggedImage], None] | None = None,
) -> Iterator[LoggedImage]:
    """Measures the images of a source one by one.

    Args:
        source: Images in order of time.
        tracker: Keeps the last pose between images.
        count: Updated with each image.
        give_up_after: Ends an endless source after this many images without any pose.
        model: Of the obstacles, to measure the clearance as well.
        on_image: Called with each image and its measurement.

    Raises:
        NoPlatformSeen: At the end, if no image gave a pose.
        BadInput: An image has another size than the camera's.
        CameraMoved: The frame tags are not at their expected positions.
    """
    if model is not None and model.obstacle_names:
        require_stated_errors(tracker.rig, [tracker.camera])
    count = count or TrackCount()
    reasons = NoPoseReasons()
    last: SourceImage | None = None
    seen: set[int] = set()
    for picture in source:
        start = monotonic()
        observation = tracker.observe(picture.image, picture.time)
        count.seconds.append(monotonic() - start)
        count.pictures += 1
        clearance: MeasuredClearance | None = None
        if isinstance(observation, PoseMeasurement):
            count.poses += 1
            clearance = clearance_of(model, observation) if model is not None else None
        else:
            reasons.add(observation.reason)
            seen.update(observation.seen)
            last = picture
        logged = LoggedImage(picture.name, observation, clearance, picture.number)
        if on_image is not None:
            on_image(picture, logged)
        yield logged
        if count.poses == 0 and count.pictures == give_up_after:
            break
    if count.poses == 0:
        raise _nothing_seen(tracker, count.pictures, reasons, last, seen)


_NUMBER = re.compile(r"\d+(\.\d+)?")


class NoPoseReasons:
    """Reasons for missing poses; those that differ in numbers only are one."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._first: dict[str, str] = {}

    def add(self, reason: str) -> None:
        """Counts a reason."""
        kind = _NUMBER.sub("#", reason)
        self._counts[kind] += 1
        self._first.setdefault(kind, reason)

    def most_frequent(self) -> str:
        """The first text of the most frequent reason."""
        return self._first[self._counts.most_common(1)[0][0]]


def _nothing_seen(
    tracker: Tracker,
    pictures: int,
    reasons: NoPoseReasons,
    last: SourceImage | None,
    seen: set[int],
) -> NoPlatformSeen:
    where = f"camera {tracker.camera.name!r}"
    if last is None:
        return NoPlatformSeen("the source has no images", where=where)
    wanted, mine = ", ".join(map(str, tracker.expected_tags)), seen & {*tracker.expected_tags}
    instead = diagnose_tags(last.image, tracker.rig.tag_family, tracker.expected_tags)
    next_step = (
        "check that the camera sees the platform, that the light suffices, and that the rig file"
        " has the family and numbers of the printed tags"
    )
    reason, why = reasons.most_frequent(), ""
    soft = edge_width(last.image) > SOFT
    if MIRRORED in instead:
        next_step = UNMIRROR
    elif SEEN_TWICE in reason:
        why = "another print of these tags is in view, such as that of a spare platform"
        next_step = "remove or cover the second print, or print its tags with other numbers"
    elif UNCERTAIN in reason and not soft:
        next_step = "focus the camera, bring it nearer, or make more tags of the platform visible"
    elif PERHAPS_MOVED in reason:
        next_step = "take more images: the next one that shows the frame tags decides"
    elif UNSHARP in reason or soft:
        next_step = (
            "focus the camera on the platform, add light to shorten the exposure, and clear the"
            " edges of the tags"
        )
    elif ROTATED in reason:
        next_step = (
            "rotate the platform back; if it is not rotated so far, check rotation_wxyz of"
            " tags.platform and platform.home in the rig file"
        )
        if len(tracker.rig.cameras) > 1:
            next_step += ", and that the source is not that of another camera"
    elif len(mine) > 1:
        next_step = "check size_mm, position_mm and rotation_wxyz of tags.platform in the rig file"
        rotated = _rotated_tags(tracker, last)
        if rotated is not None:
            why, next_step = rotated
    if not why:
        why = f"expected {tracker.rig.tag_family} tags {wanted}"
        if not mine or MIRRORED in instead:
            why += f"; {last.name} shows {instead}"
    return NoPlatformSeen(
        f"none of {pictures} image{'s' if pictures != 1 else ''} gives a pose of the platform:"
        f" {reason}",
        where=where,
        why=why,
        next_step=next_step,
        values={"pictures": pictures, "family": tracker.rig.tag_family, "expected": wanted},
    )


def _rotated_tags(tracker: Tracker, picture: SourceImage) -> tuple[str, str] | None:
    """Cause and remedy, if two or more platform tags fit rotated about their normals."""

    def fit(tags: tuple[Tag, ...]) -> bool:
        rig = replace(tracker.rig, platform_tags=tags, frame_tags=())
        found = Tracker(rig, tracker.camera, tracker.settings).observe(picture.image, picture.time)
        return isinstance(found, PoseMeasurement) and len(found.tags) > 1

    return mounted_rotated(tracker.rig.platform_tags, tracker.rig.tag_family, fit)


# Several cameras at once.


@dataclass(slots=True)
class MultiCameraCount:
    """Poses that could not be fused so far.

    Attributes:
        without_partner: Images without an image of another camera at about the same time.
        apart: Frame sets with a pose dropped because its image is too far from the others in time.
        without_speed: Frame sets with a pose dropped because its velocity is unknown.
        remarks: Pairs of cameras whose clocks differ, cameras without a pose and disagreement, one
            sentence each; known at the end.
    """

    without_partner: int = 0
    apart: int = 0
    without_speed: int = 0
    remarks: list[str] = field(default_factory=list)


def track_cameras(
    rig: Rig,
    streams: Mapping[str, Iterator[LoggedImage]],
    within: float,
    count: MultiCameraCount,
    model: ClearanceModel | None = None,
) -> Iterator[tuple[LoggedImage, dict[str, LoggedImage]]]:
    """The fused pose of all cameras, by frame set, until the last source ends.

    Args:
        rig: With these cameras.
        streams: Output of `track` for each camera, by the camera's name.
        within: Images farther than this from the median time of a frame set are not fused with the
            others, [s].
        count: Updated with each frame set.
        model: Of the obstacles, to measure the clearance as well.

    Returns:
        The fused measurement, and that of each camera with an image in the frame set, all with the
        number of the frame set.

    Raises:
        NoPlatformSeen: At the end, if no camera gave a pose.
        BadInput: An image has another size than its camera's.
        CameraMoved: Frame tags are not at their expected positions.
    """
    poses, reason, common = 0, "the sources have no images", MultiCameraFusion(within)
    exchanged: tuple[str, str] | None = None
    disagreed = agreed = 0
    blind: dict[str, str] = {}
    running = {name: _seeing(name, stream, blind) for name, stream in streams.items()}
    for frame, images in enumerate(synchronize_frames(running, 2.0 * within)):
        alone = {name: replace(one, frame=frame) for name, one in images.items()}
        observed = {name: one.observation for name, one in alone.items()}
        found = common.of(observed)
        count.without_partner += len(alone) == 1
        count.apart, count.without_speed = common.apart, common.without_speed
        clearance = None
        if isinstance(found, PoseMeasurement):
            poses += 1
            agreed += sum(isinstance(one, PoseMeasurement) for one in observed.values()) > 1
            clearance = clearance_of(model, found) if model is not None else None
        else:
            contradicts = DISAGREE in found.reason
            if contradicts or not disagreed:
                reason = found.reason
            if contradicts:
                disagreed += 1
                exchanged = exchanged_cameras(rig, observed) or exchanged
        yield LoggedImage(next(iter(alone.values())).name, found, clearance, frame), alone
    count.remarks = common.clock_remarks()
    if poses:
        count.remarks += [f"camera {name}: {why}" for name, why in blind.items()]
    if disagreed and agreed:
        count.remarks.append(f"cameras disagreed at {disagreed} of {frame + 1} times")
    if not poses or (disagreed and not agreed):
        why, next_step = (
            "; ".join(count.remarks),
            "check that each camera has its own source and sees the platform; `cdpr track` with a"
            " single source gives details",
        )
        if exchanged is not None:
            why, next_step = exchanged_sources(*exchanged)
        elif DISAGREE in reason:
            next_step = (
                "check that simultaneous images have the same name (in videos the same time), then"
                " calibrate the cameras' poses again"
            )
        raise NoPlatformSeen(
            f"no camera gives a platform pose: {reason}",
            where=f"cameras {', '.join(streams)}",
            why=why,
            next_step=next_step,
        )


def _seeing(
    name: str, stream: Iterator[LoggedImage], blind: dict[str, str]
) -> Iterator[LoggedImage]:
    """Ends the stream of a camera without any pose, with the reason: the others may have poses."""
    try:
        yield from stream
    except NoPlatformSeen as error:
        blind[name] = error.what


# Drawing of measurements into images.


#: Colours, blue green red.
USED, BOX, TEXT = (80, 220, 60), (230, 160, 40), (255, 255, 255)
AXES = ((60, 60, 235), (60, 200, 60), (235, 120, 40))
FONT = cv2.FONT_HERSHEY_SIMPLEX
#: Drawing takes coordinates in sixteenths of a pixel.
_SHIFT = 4


def draw_measurement(
    image: Image,
    rig: Rig,
    camera: Camera,
    found: Observation,
    clearance: MeasuredClearance | None = None,
) -> NDArray[np.uint8]:
    """The image in colour with the platform's box, axes, tags and measured values.

    Args:
        image: Grey image of the camera.
        found: The measurement in the image.
        clearance: At the measured pose, if the scene has obstacles.

    Returns:
        Shape (height, width, 3), blue green red.
    """
    canvas = draw_outline(image, rig, camera, found)
    _draw_text(canvas, _lines(found, clearance))
    return canvas


def draw_outline(image: Image, rig: Rig, camera: Camera, found: Observation) -> NDArray[np.uint8]:
    """The image in colour with the platform's box, axes and tags; see `draw_measurement`."""
    canvas = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    if isinstance(found, PoseMeasurement):
        camera_from_platform = camera.world_from_camera.inverse().compose(found.pose)
        _draw_box(canvas, rig, camera, camera_from_platform)
        for tag in rig.platform_tags:
            if tag.id in found.tags:
                _draw_line(canvas, camera, camera_from_platform.apply(tag_corners(tag)), USED, True)
    return canvas


def _draw_box(canvas: NDArray[np.uint8], rig: Rig, camera: Camera, pose: Pose) -> None:
    corners = rig.platform_corners
    for a, b in combinations(corners, 2):
        if np.count_nonzero(a != b) == 1:
            _draw_line(canvas, camera, pose.apply(np.array([a, b])), BOX)
    length = float(rig.half_size.max()) * 1.4
    for axis, colour in zip(np.eye(3) * length, AXES, strict=True):
        _draw_line(canvas, camera, pose.apply(np.array([np.zeros(3), axis])), colour)


def _draw_line(
    canvas: NDArray[np.uint8],
    camera: Camera,
    points_in_camera: Array,
    colour: tuple[int, ...],
    closed: bool = False,
) -> None:
    if np.any(points_in_camera[:, 2] < 0.02):
        return
    fine = np.round(pixels_of(camera, points_in_camera) * 2**_SHIFT).astype(np.int32)
    cv2.polylines(canvas, [fine], closed, colour, 1, cv2.LINE_AA, _SHIFT)


def _lines(found: Observation, clearance: MeasuredClearance | None) -> list[str]:
    """Lines of text for the image, in ASCII, as OpenCV's fonts require."""
    head = f"t {found.time:.3f} s"
    if not isinstance(found, PoseMeasurement):
        return [head, f"no pose: {found.reason}"]
    position, spread = found.pose.position * 1e3, found.position_deviation * 1e3
    text = [
        f"{head}  tags {' '.join(map(str, found.tags))}  {found.reprojection:.3f} px",
        *(
            f"{axis} {value:9.2f} +- {deviation:.2f} mm"
            for axis, value, deviation in zip("xyz", position, spread, strict=True)
        ),
    ]
    if clearance is not None:
        nearest = min(clearance.nearest, key=lambda n: n.distance)
        low, high = clearance.distance - clearance.uncertainty, clearance.at_most
        text.append(
            f"clearance {clearance.distance * 1e3:.1f} mm, bounds {low * 1e3:.1f} to"
            f" {high * 1e3:.1f}  {nearest.first} to {nearest.second}"
        )
    return text


def _draw_text(canvas: NDArray[np.uint8], lines: list[str]) -> None:
    """White letters on a darkened corner of the image."""
    scale = max(0.4, canvas.shape[0] / 1400.0)
    step = round(34 * scale)
    ascii_only = [line.encode("ascii", "replace").decode() for line in lines]
    sizes = [cv2.getTextSize(line, FONT, scale, 1)[0][0] for line in ascii_only]
    corner = canvas[: step * len(lines) + step // 2, : max(sizes) + step]
    corner[:] = corner // 3
    for number, line in enumerate(ascii_only, start=1):
        at = (step // 2, step * number)
        cv2.putText(canvas, line, at, FONT, scale, TEXT, 1, cv2.LINE_AA)
