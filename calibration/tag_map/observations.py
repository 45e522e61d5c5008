"""Observations of a rig's tags in many images of one camera, and why others are unused."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from calibration.results import data_hash
from calibration.statistics import duplicate_views
from model.errors import BadInput
from model.pose import Array, Pose, moved
from model.rig import Camera, Rig, Tag
from tracking.camera_model import (
    Image,
    distort_pixels,
    point_slopes,
    project_undistorted,
    reprojection_errors,
    rms,
)
from tracking.detection.detector import Detection, make_detector
from tracking.detection.diagnostics import MIRRORED, UNMIRROR, are_mirrored, diagnose_tags
from tracking.detection.tags import CORNER_SIGNS, alike_in_mirror, modules_across
from tracking.edges.refine import RefinedTag, refine
from tracking.measurement import TrackerSettings
from tracking.pnp import BundlePose, TagView, solve_pnp, square_poses


@dataclass(frozen=True, slots=True, eq=False)
class TagObservations:
    """Tags detected completely, by image.

    Attributes:
        squares: Refined tag corners by tag number, by image name.
        unused: Why an image, or a tag in it, is not used, by name.
    """

    squares: Mapping[str, Mapping[int, RefinedTag]]
    unused: Mapping[str, str]

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of the observed tags."""
        return tuple(sorted({number for squares in self.squares.values() for number in squares}))

    def without(self, unused: Mapping[str, str]) -> TagObservations:
        """The observations without further images; ``unused`` has the reasons."""
        remaining = {name: squares for name, squares in self.squares.items() if name not in unused}
        return TagObservations(remaining, {**self.unused, **unused})

    def corners(self, camera: Camera) -> dict[str, dict[int, Array]]:
        """Corners in the image, shape (4, 2), [px], by tag number, by image name."""
        return {
            name: {number: distort_pixels(camera, square.corners) for number, square in one.items()}
            for name, one in self.squares.items()
        }

    def without_duplicates(self, camera: Camera) -> TagObservations:
        """Without images that duplicate the view of another image with as many tags or more."""
        return self.without(duplicate_views(self.corners(camera)))

    def data_hash(self) -> str:
        """Hash of the observations."""
        return data_hash(
            f"{name} {number}".encode() + np.round(square.corners, 6).tobytes()
            for name, squares in self.squares.items()
            for number, square in sorted(squares.items())
        )


def observe_tags(
    pictures: Iterable[tuple[str, Image]],
    rig: Rig,
    camera: Camera,
    wanted: Collection[int],
    unused: Mapping[str, str] | None = None,
) -> TagObservations:
    """Detects tags in images.

    A tag detected twice in an image is left out there: it is unknown which one is the rig's. A
    copy of an image is left out: it adds no information. Images of a camera at rest still differ
    by noise.

    Args:
        pictures: Names and grey images of the camera's size.
        rig: Gives the tag family and the detector.
        camera: Its matrix and distortion are taken as known.
        wanted: Numbers of the tags.
        unused: Images already left out, with the reasons.

    Raises:
        BadInput: No image shows any of them completely, or the images are mirrored.
    """
    family = rig.tag_family
    detector, modules = make_detector(rig.tag_detector, family), modules_across(family)
    alike, shown = alike_in_mirror(family), set[int]()
    found: dict[str, Mapping[int, RefinedTag]] = {}
    left_out = dict(unused or {})
    example: tuple[str, Image] | None = None
    names: dict[bytes, str] = {}
    for name, image in pictures:
        first = names.setdefault(hashlib.sha256(image.tobytes()).digest(), name)
        if first != name:
            left_out[name] = f"is the same image as {first}"
            continue
        mine = [d for d in detector.detect_all(image) if d.id in wanted]
        twice = [number for number, count in Counter(d.id for d in mine).items() if count > 1]
        left_out |= {f"{name}, tag {number}": "is detected more than once" for number in twice}
        squares = _whole(image, camera, [d for d in mine if d.id not in twice], modules)
        if squares:
            if shown <= alike and are_mirrored(image, detector, wanted):
                raise BadInput(
                    f"{MIRRORED}: {name} shows more tags of the rig if mirrored again",
                    where=f"camera {camera.name}",
                    next_step=UNMIRROR,
                )
            found[name] = squares
            shown |= squares.keys()
        elif not twice:
            left_out[name] = "shows no complete tag"
            example = example or (name, image)
    if not found:
        raise _nothing_seen(camera, family, wanted, left_out, example)
    return TagObservations(found, left_out)


def platform_pose(rig: Rig, camera: Camera, squares: Mapping[int, RefinedTag]) -> BundlePose | None:
    """The platform's pose in the camera frame from its tags; None if it is ambiguous.

    Args:
        rig: Its platform carries the tags.
        camera: Its matrix and distortion are taken as known.
        squares: Refined corners in one image, by tag number.
    """
    found = solve_pnp(camera, platform_views(rig, squares))
    if found is None or not np.isfinite(found.covariance).all():
        return None
    margin = found.second_best_cost - found.cost
    return None if margin < TrackerSettings().single_tag_margin else found


def platform_views(rig: Rig, squares: Mapping[int, RefinedTag]) -> list[TagView]:
    """The platform's tags with their corners in one image, by tag number."""
    tags = {tag.id: tag for tag in rig.platform_tags}
    return [TagView(tags[number], square) for number, square in squares.items()]


def _whole(
    image: Image, camera: Camera, detections: list[Detection], modules: int
) -> dict[int, RefinedTag]:
    corners = np.array([d.corners for d in detections]).reshape(-1, 4, 2)
    squares = refine(image, camera, corners, modules)
    pairs = zip(detections, squares, strict=True)
    return {d.id: square for d, square in pairs if square is not None and square.whole}


def _nothing_seen(
    camera: Camera,
    family: str,
    wanted: Collection[int],
    unused: Mapping[str, str],
    example: tuple[str, Image] | None,
) -> BadInput:
    why = "; ".join(f"{name} {reason}" for name, reason in list(unused.items())[:4])
    if example is not None:
        name, image = example
        why += f"; {name} shows {diagnose_tags(image, family, list(wanted))}"
    step = (
        "check that the camera sees them, that the light suffices, and that the rig file has the"
        " family and numbers of the printed tags"
    )
    return BadInput(
        f"none of the {family} tags {', '.join(map(str, wanted))} is completely visible",
        where=f"camera {camera.name}",
        why=why,
        next_step=UNMIRROR if MIRRORED in why else step,
    )


# Locatable tags: those that images connect to each other, whichever image is left out. What hangs
# on one image alone has no jackknife, and an error of that image would go unnoticed.


def connected_tags(pictures: Sequence[Iterable[int]], fixed: int | None = None) -> list[int]:
    """The largest group of tags that stay connected without any one of the images.

    Args:
        pictures: Tag numbers in each image.
        fixed: Select the group of this tag instead.

    Returns:
        Their numbers in order; empty when no two images show the same tag.
    """
    counts = Counter(frozenset(numbers) for numbers in pictures)
    groups = _groups(counts)
    for single in [numbers for numbers, count in counts.items() if count == 1]:
        parts = _groups(counts.keys() - {single})
        groups = [group & part for group in groups for part in parts if group & part]
    if fixed is not None:
        groups = [group for group in groups if fixed in group]
    largest: set[int] = max(groups, key=lambda group: (len(group), -min(group)), default=set())
    return sorted(largest)


def _groups(pictures: Iterable[frozenset[int]]) -> list[set[int]]:
    """Groups of tags that images connect."""
    groups: list[set[int]] = []
    for numbers in pictures:
        tied = [group for group in groups if group & numbers]
        groups = [group for group in groups if not group & numbers]
        groups.append(set(numbers).union(*tied))
    return groups


# Layout from the images alone.


_ORIGIN = Pose.level([0.0, 0.0, 0.0])
_APART = 0.5
"""Rotation [rad] plus shift [tag sizes] between two relative poses that do not agree."""


def initial_layout(
    camera: Camera, nominal: Mapping[int, Tag], observations: TagObservations
) -> dict[int, Tag]:
    """Tags at poses from the images alone, whatever the rig file states; sizes are its.

    Each tag in an image has two candidate poses. Of two tags, the relative pose that most images
    share is the right one. Tags that no images connect to each other have different frames.
    """
    relative: dict[tuple[int, int], list[list[Pose]]] = {}
    for squares in observations.squares.values():
        alone = {
            number: square_poses(camera, TagView(replace(nominal[number], pose=_ORIGIN), square))
            for number, square in squares.items()
        }
        for pair in combinations(sorted(number for number in alone if alone[number]), 2):
            found = [a.inverse().compose(b) for a in alone[pair[0]] for b in alone[pair[1]]]
            relative.setdefault(pair, []).append(found)
    edges: dict[tuple[int, int], tuple[float, Pose]] = {}
    for pair, candidates in relative.items():
        size = sum(nominal[number].size for number in pair) / 2.0
        shared, pose = _most_shared(candidates, size)
        edges |= {pair: (shared, pose), pair[::-1]: (shared, pose.inverse())}
    poses: dict[int, Pose] = {}
    for first in observations.numbers:
        poses.setdefault(first, _ORIGIN)
        while links := [p for p in edges if p[0] in poses and p[1] not in poses]:
            one, other = max(links, key=lambda pair: edges[pair][0])
            poses[other] = poses[one].compose(edges[one, other][1])
    return {number: replace(nominal[number], pose=pose) for number, pose in poses.items()}


def _most_shared(candidates: Sequence[Sequence[Pose]], size: float) -> tuple[float, Pose]:
    """How many images share a relative pose, and the one that most share."""
    poses = [pose for one in candidates for pose in one]
    turns = np.array([pose.rotation for pose in poses])
    shifts = np.array([pose.position for pose in poses])
    cosines = (np.einsum("aij,bij->ab", turns, turns) - 1.0) / 2.0
    gaps = np.arccos(np.clip(cosines, -1.0, 1.0))
    gaps += np.linalg.norm(shifts[:, None] - shifts, axis=-1) / size
    agreement = np.maximum(1.0 - gaps / _APART, 0.0)
    first = np.cumsum([0, *(len(one) for one in candidates)])[:-1]
    support = np.maximum.reduceat(agreement, first, axis=1).sum(axis=1)
    best = int(np.argmax(support))
    return float(support[best]), poses[best]


# Bundle adjustment of all tags in all images: residuals, Jacobians, information.


def moved_tags(tags: Sequence[Tag], steps: Array) -> tuple[Tag, ...]:
    """Tags after shifts [m] and rotations [rad] along their body's axes, shape (6 t,)."""
    return tuple(
        replace(tag, pose=moved(tag.pose, step))
        for tag, step in zip(tags, steps.reshape(-1, 6), strict=True)
    )


@dataclass(frozen=True, slots=True, eq=False)
class TagViews:
    """v views of t tags in p images.

    Attributes:
        camera: Of all images.
        picture: Image index of each view, shape (v,).
        tag: Tag index of each view, shape (v,).
        whitening: Shape (v, 8, 8), [1/px].
        target: Shape (v, 8).
    """

    camera: Camera
    picture: NDArray[np.int64]
    tag: NDArray[np.int64]
    whitening: Array
    target: Array

    @classmethod
    def of(cls, camera: Camera, observations: TagObservations, tags: Sequence[Tag]) -> TagViews:
        """Stacks the observations of those tags."""
        numbers = [tag.id for tag in tags]
        found = [
            (k, numbers.index(number), square)
            for k, squares in enumerate(observations.squares.values())
            for number, square in squares.items()
        ]
        return cls(
            camera,
            np.array([k for k, _, _ in found], dtype=np.int64),
            np.array([which for _, which, _ in found], dtype=np.int64),
            np.array([square.whitening for _, _, square in found]),
            np.array([square.target for _, _, square in found]),
        )

    def errors(self, cameras: Sequence[Pose], tags: Sequence[Tag]) -> Array:
        """Whitened errors of the edges, shape (v, 8)."""
        points, _, _ = self._points(cameras, tags)
        pixels = project_undistorted(self.camera, points).reshape(-1, 8)
        return np.asarray(np.einsum("vij,vj->vi", self.whitening, pixels) - self.target)

    def slopes(self, cameras: Sequence[Pose], tags: Sequence[Tag]) -> tuple[Array, Array]:
        """Jacobians of the errors by camera pose and by tag pose, shape (v, 8, 6) each."""
        points, arms_camera, arms_tag = self._points(cameras, tags)
        by_point = point_slopes(self.camera, points)
        turn = np.array([pose.rotation for pose in cameras])[self.picture]
        by_position = np.einsum("vcij,vjk->vcik", by_point, turn)
        by_camera = np.concatenate([by_point, np.cross(arms_camera[:, :, None], by_point)], -1)
        by_tag = np.concatenate([by_position, np.cross(arms_tag[:, :, None], by_position)], -1)
        return (
            np.asarray(self.whitening @ by_camera.reshape(-1, 8, 6)),
            np.asarray(self.whitening @ by_tag.reshape(-1, 8, 6)),
        )

    def dense_slopes(self, cameras: Sequence[Pose], tags: Sequence[Tag]) -> Array:
        """Jacobian of all errors by camera poses, then tag poses, shape (8 v, 6 p + 6 t)."""
        by_camera, by_tag = self.slopes(cameras, tags)
        whole = np.zeros((len(self.tag), 8, 6 * (len(cameras) + len(tags))))
        six = np.arange(6)
        view = np.arange(len(self.tag))[:, None, None]
        row = np.arange(8)[None, :, None]
        whole[view, row, (6 * self.picture[:, None] + six)[:, None, :]] = by_camera
        column = 6 * (len(cameras) + self.tag[:, None]) + six
        whole[view, row, column[:, None, :]] = by_tag
        return whole.reshape(8 * len(self.tag), -1)

    def size_slopes(self, cameras: Sequence[Pose], tags: Sequence[Tag]) -> Array:
        """Jacobian of all errors by the logarithms of the tags' sizes, shape (8 v, t)."""
        points, arms_camera, _ = self._points(cameras, tags)
        turn = np.array([pose.rotation for pose in cameras])[self.picture]
        middle = np.array([tag.pose.position for tag in tags])[self.tag]
        arms = arms_camera - np.einsum("vij,vj->vi", turn, middle)[:, None]
        by_size = np.einsum("vcij,vcj->vci", point_slopes(self.camera, points), arms)
        whole = np.zeros((len(self.tag), 8, len(tags)))
        view = np.arange(len(self.tag))
        whole[view, :, self.tag] = np.einsum("vij,vj->vi", self.whitening, by_size.reshape(-1, 8))
        return whole.reshape(8 * len(self.tag), -1)

    def tag_information(
        self, cameras: Sequence[Pose], tags: Sequence[Tag], huber: float
    ) -> tuple[list[Array], list[Array], float]:
        """Each image's information on the tags' poses, its camera pose projected out.

        Returns:
            Information, shape (6 t, 6 t), and score, shape (6 t,), of each image; and the sum of
            squared errors, in variances, per degree of freedom.
        """
        errors = self.errors(cameras, tags)
        weight = np.sqrt(np.minimum(1.0, huber / np.maximum(np.abs(errors), 1e-12)))
        errors = errors * weight
        by_camera, by_tag = (part * weight[..., None] for part in self.slopes(cameras, tags))
        informations, scores = [], []
        for k in range(len(cameras)):
            mine = np.flatnonzero(self.picture == k)
            wide = np.zeros((len(mine), 8, 6 * len(tags)))
            for row, view in enumerate(mine.tolist()):
                column = 6 * int(self.tag[view])
                wide[row, :, column : column + 6] = by_tag[view]
            base = np.linalg.qr(by_camera[mine].reshape(-1, 6))[0]
            flat = wide.reshape(-1, 6 * len(tags))
            remaining = flat - base @ (base.T @ flat)
            informations.append(remaining.T @ remaining)
            scores.append(-remaining.T @ errors[mine].ravel())
        freedom = errors.size - 6 * len(cameras) - 6 * (len(tags) - 1)
        return informations, scores, float(np.sum(errors**2)) / max(freedom, 1)

    def image_errors(self, cameras: Sequence[Pose], tags: Sequence[Tag]) -> list[float]:
        """RMS corner error in each image, [px]."""
        points, _, _ = self._points(cameras, tags)
        measured: Array = np.asarray(np.linalg.solve(self.whitening, self.target[..., None]))
        errors = reprojection_errors(self.camera, points, measured.reshape(-1, 4, 2))
        return [float(rms(errors[self.picture == k].reshape(-1, 2))) for k in range(len(cameras))]

    def _points(self, cameras: Sequence[Pose], tags: Sequence[Tag]) -> tuple[Array, Array, Array]:
        """Corners in the camera frame, (v, 4, 3); lever arms of camera and tag rotations."""
        tag_turn = np.array([tag.pose.rotation for tag in tags])[self.tag]
        tag_position = np.array([tag.pose.position for tag in tags])[self.tag]
        turn = np.array([pose.rotation for pose in cameras])[self.picture]
        position = np.array([pose.position for pose in cameras])[self.picture]
        halves = np.array([tag.size / 2.0 for tag in tags])[self.tag]
        flat = halves[:, None, None] * np.column_stack([CORNER_SIGNS, np.zeros(4)])
        arms_tag = np.einsum("vij,vcj->vci", tag_turn, flat)
        arms_camera = np.einsum("vij,vcj->vci", turn, arms_tag + tag_position[:, None])
        return arms_camera + position[:, None], arms_camera, arms_tag
