"""Readout time of a camera from top row to bottom row, from images of a moving platform.

Each row is exposed slightly after the one above: a tag that moves down is stretched, one that moves
sideways is sheared. The estimated readout is that for which the edges of all tags in all images fit
rigid poses best; the platform's motion follows from the images before and after.

Source: Oth, Furgale, Kneip & Siegwart, "Rolling shutter camera calibration", CVPR 2013.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field
from scipy.optimize import minimize_scalar

from calibration.images import ImageSet
from calibration.intrinsics.result import camera_named, with_camera
from calibration.report import Section, interval_rows, page_of, table_of
from calibration.results import CalibrationVerdict, Issue, ResultDocument, beyond, common_keys
from calibration.statistics import Interval, student_factor
from calibration.tag_map.observations import TagObservations
from drivers.cameras.files import ImageFolder
from drivers.cameras.live import Frame, VideoFile
from model.errors import BadInput
from model.files.camera_file import Readout
from model.files.documents import AnyNonNegative, Positive
from model.files.reading import is_folder
from model.files.rig_file import RigDocument
from model.pose import Array, Pose
from model.progress import Listener
from model.rig import Camera, Rig
from tracking.camera_model import Image
from tracking.measurement import MEMORY
from tracking.pnp import TagView, refine_pnp, solve_pnp
from tracking.rolling_shutter import PlatformMotion, correct_rolling_shutter

LEAST = 5
"""Minimum number of images with a known motion; fewer do not show the scatter."""
GOOD = 20
_STEP = 2e-4
"""Step of the readout for finite differences, [s]."""
_LEAST_RATIO = 1.5
"""Of the times around an image for the second difference: at a lower one, noise would grow."""


def open_timed_images(
    source: Path, camera: Camera, rate: float | None, listener: Listener
) -> tuple[ImageSet, Mapping[str, float]]:
    """All images of a folder or a video, and the capture time of each image read so far.

    Args:
        source: The folder, or the file.
        camera: The rig's camera that took them.
        rate: Frame rate of a folder, or of a video without times, [Hz]; the camera's when left out.
        listener: Receives a remark if a video's rate is assumed.

    Returns:
        The images; their names begin with their times, such as ``0.100000 s a.png``. And times
        by name, since the first image, [s].

    Raises:
        BadInput: It is neither, its images are of another size, or a video states its times, but
            a rate is given.
    """
    times: dict[str, float] = {}
    if is_folder(source):
        folder = ImageFolder(source, camera, rate)
        return ImageSet(_named_by_time(folder, times), len(folder), folder.unused), times
    video = VideoFile(source, camera, rate)
    if video.remark:
        listener.remark(video.remark)
    return ImageSet(_named_by_time(video, times), len(video), video.unused), times


def _named_by_time(frames: Iterable[Frame], times: dict[str, float]) -> Iterator[tuple[str, Image]]:
    for frame in frames:
        name = f"{frame.time:.6f} s {frame.name}"
        times[name] = frame.time
        yield name, frame.image


@dataclass(frozen=True, slots=True, eq=False)
class ReadoutCalibration:
    """A camera's readout.

    Attributes:
        camera: As in the rig file.
        readout: From the exposure of the top row to that of the bottom row, [s].
        half_width: Of its 95 % interval, [s].
        speeds: Of the platform in each image used, by name, [m/s].
        before: RMS edge error with a global shutter, in standard deviations.
        after: The same with the readout.
        unused: Why other images are not used.
        data_hash: Of the observations.
    """

    camera: Camera
    readout: float
    half_width: float
    speeds: Mapping[str, float]
    before: float
    after: float
    unused: Mapping[str, str]
    data_hash: str

    def facts(self) -> list[tuple[str, str]]:
        """Human-readable details beside the estimate."""
        fastest, used = max(self.speeds.values()) * 1e3, len(self.speeds)
        off = f"error {self.before:.2f} standard deviations before, {self.after:.2f} after"
        return [
            ("images", f"{used} used, platform speed up to {fastest:.0f} mm/s"),
            ("edges", off),
        ]

    @property
    def intervals(self) -> dict[str, Interval]:
        """The readout with its 95 % interval by the key of result files, [ms]."""
        return {"readout_ms": Interval(self.readout * 1e3, self.half_width * 1e3)}


@dataclass(frozen=True, slots=True, eq=False)
class _Moving:
    """An image of the platform with a known motion."""

    views: list[TagView]
    pose: Pose
    camera_from_body: Pose
    motion: PlatformMotion

    def cost(self, camera: Camera) -> float:
        """Huber cost of the edges at the camera's readout, in variances."""
        views = correct_rolling_shutter(camera, self.views, self.pose, self.motion)
        found = refine_pnp(camera, views, self.camera_from_body)
        return float("inf") if found is None else found.cost


def fit_readout(
    rig: Rig, camera: Camera, observations: TagObservations, times: Mapping[str, float]
) -> ReadoutCalibration:
    """Estimates the readout.

    Args:
        rig: Its platform carries the tags.
        camera: Its matrix and distortion are taken as known.
        observations: Tags in images of the moving platform.
        times: Capture times of the images, by name, [s].

    Raises:
        BadInput: Too few images show the platform in motion, or do not determine the readout.
    """
    moving, unused = _moving(rig, camera, observations, times)
    if len(moving) < LEAST:
        raise BadInput(
            f"{len(moving)} images show the platform between two others at most {MEMORY:g} s away;"
            f" {LEAST} are required",
            where=f"camera {camera.name!r}",
            next_step="record a video of the platform while it moves up and down and sideways",
        )
    longest = float(np.median(np.diff(sorted(times.values()))))

    def costs(readout: float) -> Array:
        rolling = replace(camera, readout=float(readout))
        return np.array([image.cost(rolling) for image in moving.values()])

    best = minimize_scalar(
        lambda readout: float(costs(readout).sum()),
        bounds=(-longest, longest),
        method="bounded",
        options={"xatol": 1e-6},
    )
    found = float(best.x)
    low, middle, high = (costs(found + step) for step in (-_STEP, 0.0, _STEP))
    bends, slopes = (high - 2.0 * middle + low) / _STEP**2, (high - low) / (2.0 * _STEP)
    edges = sum(2 * int(v.seen.edges.sum()) for image in moving.values() for v in image.views)
    freedom = max(edges - 6 * len(moving) - 1, 1)
    half_width = _half_width(bends, slopes, float(middle.sum()), freedom)
    if not half_width < 0.5 * longest:
        raise BadInput(
            f"the readout is between {(found - half_width) * 1e3:.2g} and"
            f" {(found + half_width) * 1e3:.2g} ms: these images do not determine it",
            where=f"camera {camera.name!r}",
            why="the platform hardly moves in them, or only along the camera's view",
            next_step="move it faster, up and down and sideways in the image",
        )
    return ReadoutCalibration(
        camera=camera,
        readout=found,
        half_width=half_width,
        speeds={n: float(np.linalg.norm(i.motion.velocity)) for n, i in moving.items()},
        before=float(np.sqrt(costs(0.0).sum() / edges)),
        after=float(np.sqrt(middle.sum() / edges)),
        unused={**observations.unused, **unused},
        data_hash=observations.data_hash(),
    )


def _moving(
    rig: Rig, camera: Camera, observations: TagObservations, times: Mapping[str, float]
) -> tuple[dict[str, _Moving], dict[str, str]]:
    """Images with a known motion from their neighbours, and why others are not used."""
    tags = {tag.id: tag for tag in rig.platform_tags}
    seen: list[tuple[str, list[TagView], Pose]] = []
    unused = {}
    for name in sorted(observations.squares, key=lambda n: times[n]):
        views = [TagView(tags[k], square) for k, square in observations.squares[name].items()]
        bundle = solve_pnp(camera, views, seen[-1][2] if seen else None)
        if bundle is None:
            unused[name] = "no pose fits its tags"
        else:
            seen.append((name, views, bundle.camera_from_body))
    moments = [times[name] for name, _, _ in seen]
    poses = [camera.world_from_camera.compose(here) for _, _, here in seen]
    found = {}
    for k, (name, views, here) in list(enumerate(seen))[1:-1]:
        between = moments[k + 1] - moments[k - 1]
        if not 0.0 < between <= 2.0 * MEMORY:
            unused[name] = f"its neighbours are {between:.2g} s apart"
            continue
        found[name] = _Moving(views, poses[k], here, _motion_at(k, poses, moments))
    return found, unused


def _motion_at(k: int, poses: Sequence[Pose], moments: Sequence[float]) -> PlatformMotion:
    """Motion in an image, from the two before and the two after it where they are near.

    Neighbours alone state the mean speed between them, which is too low while the platform
    oscillates; their next ones show by how much (Richardson extrapolation).

    Args:
        k: Index of the image, neither the first nor the last.
        poses: Of all images, ``world_from_platform``.
        moments: Their times, [s].
    """
    between = moments[k + 1] - moments[k - 1]
    near = PlatformMotion.between(poses[k - 1], poses[k + 1], between)
    if not 2 <= k < len(poses) - 2:
        return near
    around = moments[k + 2] - moments[k - 2]
    ratio = around / between
    if not (ratio >= _LEAST_RATIO and around <= 2.0 * MEMORY):
        return near
    far, share = PlatformMotion.between(poses[k - 2], poses[k + 2], around), 1.0 / (ratio**2 - 1.0)
    return PlatformMotion(
        near.velocity + share * (near.velocity - far.velocity),
        near.turning + share * (near.turning - far.turning),
    )


def _half_width(bends: Array, slopes: Array, cost: float, freedom: int) -> float:
    """Half width of the 95 % interval: the larger of scatter and jackknife over images."""
    whole, count = float(bends.sum()), len(bends)
    if not whole > 0.0:
        return float("inf")
    by_scatter = 2.0 / whole * max(cost / freedom, 1.0)
    rest = whole - bends
    steps = slopes / np.where(rest > 0.0, rest, np.nan)
    spread = steps - np.nanmean(steps)
    by_images = (count - 1) / count * float(np.nansum(spread**2))
    quantile = student_factor(count - 1)
    return quantile * float(np.sqrt(max(by_scatter, by_images)))


def judge_readout(found: ReadoutCalibration, wanted: float, speed: float) -> CalibrationVerdict:
    """The verdict on a readout.

    Args:
        wanted: Required error, [m].
        speed: Platform speed for which the error is stated, [m/s].
    """
    error = 0.5 * found.half_width * speed  # rows at an edge of the image
    issues = []
    step = "record more images of a faster platform, with tags all over the image's height"
    if len(found.speeds) < GOOD:
        issues.append(Issue(f"{len(found.speeds)} images were used; {GOOD} are required", step))
    if not error <= wanted:
        what = f"the error is {beyond(error, wanted)}"
        issues.append(Issue(what, step))
    where = f"at {speed * 1e3:.0f} mm/s"
    return CalibrationVerdict.of(error, wanted, where, issues)


class ReadoutResult(ResultDocument):
    """A camera's readout, in the key of the rig file's ``cameras`` section."""

    order: ClassVar[int] = 1

    kind: Literal["readout"] = "readout"
    readout_ms: Readout
    speed_mm_s: Positive = Field(description="of the platform, for which error_mm is stated")
    pictures: int
    edges_before: AnyNonNegative = Field(
        description="RMS error of edges in standard deviations, as if all rows were exposed at once"
    )
    edges_after: AnyNonNegative = Field(description="the same with readout_ms")

    def apart_mm(self, other: Self) -> float:
        """Distance between measurements at this speed at the image border, [mm]."""
        return abs(self.readout_ms - other.readout_ms) / 2e3 * self.speed_mm_s

    def corrected(self, rig: RigDocument) -> RigDocument:
        """The rig file's content with this readout.

        Raises:
            BadInput: The rig has no such camera.
        """
        camera = camera_named(rig, self.name)
        return with_camera(rig, camera.model_copy(update={"readout_ms": self.readout_ms}))


def readout_result(
    found: ReadoutCalibration, verdict: CalibrationVerdict, speed: float, on: date
) -> ReadoutResult:
    """The result file's content; the speed is that of the verdict, [m/s]."""
    return ReadoutResult(
        **common_keys(
            found.camera.name,
            on,
            found.data_hash,
            found.intervals,
            verdict,
            found.unused,
        ),
        readout_ms=round(found.readout * 1e3, 6),
        speed_mm_s=speed * 1e3,
        pictures=len(found.speeds),
        edges_before=found.before,
        edges_after=found.after,
    )


def readout_page(found: ReadoutCalibration, verdict: CalibrationVerdict, on: str) -> str:
    """The report page."""
    unused = {name.partition(", tag ")[0] for name in found.unused} - set(found.speeds)
    images: Sequence[tuple[str, str]] = [
        (name, f"{speed * 1e3:.0f} mm/s") for name, speed in found.speeds.items()
    ]
    errors = [
        ("edge error, global shutter", f"{found.before:.2f} standard deviations"),
        ("edge error, with the readout", f"{found.after:.2f} standard deviations"),
    ]
    return page_of(
        f"Readout of camera {found.camera.name}",
        f"{on}, {len(found.speeds)} images used, {len(unused)} not",
        verdict,
        [
            Section("Readout", table_of([*interval_rows(found.intervals), *errors])),
            Section("Images used", table_of(images, ("image", "platform speed"))),
            Section("Images not used", table_of(found.unused.items())),
        ],
    )
