"""A camera's pose relative to another: both see the platform's tags, or a board, at the same time.

Each pair of images gives the pose of the common body in either camera, with its covariance; the
camera's pose is the best fit to all pairs. The body may be anywhere, independent of the encoders.
Errors of the other camera's pose carry over to this one.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calibration.extrinsics.result import (
    ExtrinsicCalibration,
    ExtrinsicsOutcome,
    judged_extrinsics,
    nearest_to_median,
    scaled_to,
    widths_of,
    workspace_corners,
)
from calibration.images import (
    DEFAULT_IMAGES,
    ImageSet,
    ImageSource,
    open_source,
    same_images,
)
from calibration.intrinsics.calibrate import NOT_FOUND
from calibration.results import Destination, Issue, data_hash
from calibration.statistics import duplicate_reason, has_not_moved
from calibration.tag_map.bundle_adjustment import require_tags
from calibration.tag_map.observations import (
    TagObservations,
    observe_tags,
    platform_pose,
    platform_views,
)
from calibration.targets.boards import Board, Charuco, DetectedBoard
from calibration.targets.grids import TagGrid
from executor.kernels import ready_to_measure
from model.cameras import Z_95
from model.errors import BadInput, positive_number, require_text, require_types
from model.pose import Array, Pose, matrix_from_rotation_vector, moved, read_only
from model.progress import SILENT, Listener
from model.rig import Camera, Rig
from model.scene import require_unaltered
from tracking.camera_model import (
    Image,
    lever_arm_matrix,
    pose_slopes,
    project_undistorted,
    reprojection_errors,
    rms,
    undistort_pixels,
    undistorted_slopes,
)
from tracking.shared_errors import moved_by_pixels, pixels_by_lens, split_extrinsics

LEAST_PAIRS = 4
GOOD_PAIRS = 12
_HUBER = 2.0
"""Errors beyond this many deviations count linearly."""
_LEAST_SCATTER = 0.02
"""Lower bound on the scatter of board corners, RMS along an axis, [px]."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyObservation:
    """Observation of a rigid body in one image.

    Attributes:
        camera_from_body: Its pose in the camera frame.
        covariance: Of position and rotation vector along the camera's axes, shape (6, 6), [m, rad].
        error: RMS of its corners in the image, [px].
        corners: Of each tag or point of it, shape (4, 2) or (2,), [px].
        by_lens: Derivatives of the pose by the n parameters of the camera's lens, camera axes,
            shape (6, n); None where their errors are unknown.
    """

    camera_from_body: Pose
    covariance: Array
    error: float
    corners: Mapping[Hashable, Array] = field(default_factory=dict)
    by_lens: Array | None = None

    def duplicates(self, before: BodyObservation) -> bool:
        """Whether what is seen of the body in both images did not move."""
        return has_not_moved(self.corners, before.corners)


def observe_platform(
    rig: Rig, camera: Camera, observations: TagObservations
) -> dict[str, BodyObservation]:
    """The platform in every image in which its tags give a unique pose."""
    found, corners = {}, observations.corners(camera)
    for name, squares in observations.squares.items():
        bundle = platform_pose(rig, camera, squares)
        if bundle is None:
            continue
        by_lens = None
        if camera.lens_covariance is not None:
            views = platform_views(rig, squares)
            shifts = pixels_by_lens(camera, views)
            by_lens = moved_by_pixels(camera, views, bundle.camera_from_body, shifts)
        found[name] = BodyObservation(
            bundle.camera_from_body,
            bundle.covariance,
            bundle.reprojection,
            dict(corners[name].items()),
            by_lens,
        )
    return found


def require_oriented(board: Board) -> None:
    """Refuses boards without a unique orientation: two cameras may disagree about it.

    Raises:
        BadInput: The board looks the same when rotated by 180°.
    """
    if not isinstance(board, (Charuco, TagGrid)):
        raise BadInput(
            f"two cameras may see {board} rotated by 180° relative to each other",
            next_step="use --board charuco or tags, or the tags of the platform",
        )


def observe_board(board: Board, camera: Camera, image: Image) -> BodyObservation | None:
    """Detects a board in an image; None where it is not found."""
    seen = board.find(image, camera)
    return None if seen is None else _board_pose(seen, camera)


def _board_pose(seen: DetectedBoard, camera: Camera) -> BodyObservation | None:
    undistorted = undistort_pixels(camera, seen.corners)
    good, turn, origin = cv2.solvePnP(seen.points, undistorted, camera.matrix, np.zeros(4))
    if not good:
        return None
    turn, origin = cv2.solvePnPRefineLM(
        seen.points, undistorted, camera.matrix, np.zeros(4), turn, origin
    )
    pose = Pose(np.ravel(origin).astype(np.float64), matrix_from_rotation_vector(np.ravel(turn)))
    slopes = pose_slopes(camera, seen.points, pose).reshape(-1, 6)
    errors = undistorted - project_undistorted(camera, pose.apply(seen.points))
    freedom = max(errors.size - 6, 1)
    scatter = max(float(np.sum(errors**2)) / freedom, _LEAST_SCATTER**2)
    error = float(rms(reprojection_errors(camera, pose.apply(seen.points), undistorted)))
    covariance = np.asarray(scatter * np.linalg.inv(slopes.T @ slopes))
    corners = zip(map(tuple, seen.points.tolist()), seen.corners, strict=True)
    by_lens = None
    if camera.lens_covariance is not None:
        shifts = undistorted_slopes(camera, undistorted).reshape(len(slopes), -1)
        by_lens = read_only(np.linalg.lstsq(slopes, shifts, rcond=None)[0])
    return BodyObservation(pose, covariance, error, dict(corners), by_lens)


def locate_by_pairs(
    rig: Rig,
    camera: Camera,
    reference: Camera,
    pairs: Mapping[str, tuple[BodyObservation, BodyObservation]],
    unused: Mapping[str, str],
    hash_of_data: str,
) -> ExtrinsicCalibration:
    """Finds a camera's pose from that of another.

    Pairs of a body at rest have errors in common, so only the first of them counts.

    Args:
        rig: Its workspace is where errors are assessed.
        camera: Its matrix and distortion are taken as known; its pose in the rig file is not used.
        reference: Its pose is taken as known.
        pairs: Observations by this camera and by the other at the same time, by image name.
        unused: Why other images are not used.

    Raises:
        BadInput: Too few pairs.
    """
    pairs, duplicates = _without_duplicates(pairs)
    unused = {**{f"{camera.name}: {name}": why for name, why in duplicates.items()}, **unused}
    if len(pairs) < LEAST_PAIRS:
        raise BadInput(
            f"too few pairs of images show the same body: {len(pairs)} of {LEAST_PAIRS} required",
            where=f"cameras {camera.name} and {reference.name}",
            why="; ".join(f"{name} {why}" for name, why in list(unused.items())[:4])
            or "no name is in both folders",
            next_step="take images at the same times, with the same name in both folders, of tags"
            " that both cameras see, at other poses each time",
        )
    observed = list(pairs.values())
    fit = _fit(observed)
    turn = np.kron(np.eye(2), reference.world_from_camera.rotation)
    whole = fit.information.sum(axis=0)
    relative = turn @ np.linalg.inv(whole) @ turn.T
    without = [
        np.asarray(turn @ np.linalg.solve(whole - own, score), dtype=np.float64)
        for own, score in zip(fit.information, fit.scores, strict=True)
    ]
    world_from_camera = reference.world_from_camera.compose(fit.reference_from_camera)
    covariance = scaled_to(relative, widths_of(relative, without))
    by_lens, by_reference_lens = (
        None if by is None else turn @ by for by in fit.by_lenses(observed)
    )
    covariance = covariance + _reference_covariance(reference, world_from_camera, by_reference_lens)
    if by_lens is not None and camera.lens_covariance is not None:
        covariance = covariance + by_lens @ camera.lens_covariance @ by_lens.T
    issues = []
    if len(pairs) < GOOD_PAIRS:
        what = f"{len(pairs)} pairs of images were used; {GOOD_PAIRS} are required"
        issues.append(Issue(what, "take more, all over what both cameras see"))
    if reference.pose_covariance is None:
        what = f"the pose covariance of camera {reference.name!r} is unknown"
        issues.append(Issue(what, "calibrate its extrinsics, and pass that result's file too"))
    error = float(np.sqrt(np.mean([body.error**2 for body, _ in observed])))
    return ExtrinsicCalibration(
        camera=replace(camera, world_from_camera=world_from_camera),
        by="another camera",
        covariance=read_only(covariance),
        by_lens=None if by_lens is None else read_only(by_lens),
        half_widths=read_only(Z_95 * np.sqrt(np.diag(covariance))),
        points=workspace_corners(rig),
        tag_errors={} if not rig.platform_tags else {rig.platform_tags[0].id: error},
        pictures=len(pairs),
        unused=unused,
        issues=tuple(issues),
        data_hash=hash_of_data,
        reference_camera=reference.name,
    )


def _without_duplicates(
    pairs: Mapping[str, tuple[BodyObservation, BodyObservation]],
) -> tuple[dict[str, tuple[BodyObservation, BodyObservation]], dict[str, str]]:
    """The pairs between which the body moved for both cameras, and why others are left out."""
    kept: dict[str, tuple[BodyObservation, BodyObservation]] = {}
    unused = {}
    for name, (near, far) in pairs.items():
        alike = (n for n, (a, b) in kept.items() if near.duplicates(a) or far.duplicates(b))
        first = next(alike, None)
        if first is None:
            kept[name] = (near, far)
        else:
            unused[name] = duplicate_reason(first)
    return kept, unused


def _reference_covariance(
    reference: Camera, world_from_camera: Pose, by_lens: Array | None
) -> Array:
    """Covariance of a pose from the reference camera's pose and lens, (6, 6); 0 if not stated.

    Its lens shifts what it measures and, if its own pose was found with it, that pose too.
    """
    by_position = lever_arm_matrix(
        world_from_camera.position - reference.world_from_camera.position
    )
    extrinsics, extrinsics_by_lens = split_extrinsics(reference)
    covariance = by_position @ extrinsics @ by_position.T
    if by_lens is not None and reference.lens_covariance is not None:
        by_both = by_lens + by_position @ extrinsics_by_lens
        covariance = covariance + by_both @ reference.lens_covariance @ by_both.T
    return np.asarray(covariance)


@dataclass(frozen=True, slots=True, eq=False)
class _PairsFit:
    """The fit to n pairs.

    Attributes:
        reference_from_camera: The pose.
        information: Of each pair, shape (n, 6, 6).
        scores: Half gradient of each pair's squares, shape (n, 6).
        gains: Change of the pose with each pair's gap, reference's axes, shape (n, 6, 6).
    """

    reference_from_camera: Pose
    information: Array
    scores: Array
    gains: Array

    def by_lenses(
        self, observed: Sequence[tuple[BodyObservation, BodyObservation]]
    ) -> tuple[Array | None, Array | None]:
        """Derivatives of the pose by either lens, reference's axes, (6, n); None if unknown."""
        turn = np.kron(np.eye(2), self.reference_from_camera.rotation)
        own = [near.by_lens for near, _ in observed if near.by_lens is not None]
        other = [far.by_lens for _, far in observed if far.by_lens is not None]
        return (
            np.einsum("nij,njk->ik", self.gains @ turn, own) if own else None,
            -np.einsum("nij,njk->ik", self.gains, other) if other else None,
        )


def _fit(observed: Sequence[tuple[BodyObservation, BodyObservation]]) -> _PairsFit:
    """The best ``reference_from_camera``, with the noise from the residuals if that is larger."""
    start = nearest_to_median(
        [b.camera_from_body.compose(a.camera_from_body.inverse()) for a, b in observed]
    )
    turn = np.kron(np.eye(2), start.rotation)
    covariances = [far.covariance + turn @ near.covariance @ turn.T for near, far in observed]
    whitening = np.linalg.inv(np.linalg.cholesky(covariances))

    def errors(x: Array) -> Array:
        camera = moved(start, x)
        gaps = [_gap(camera.compose(near.camera_from_body), far) for near, far in observed]
        return np.asarray(np.einsum("nij,nj->ni", whitening, gaps))

    def fitted(x: Array) -> Array:
        loss = {"loss": "huber", "f_scale": _HUBER, "x_scale": 1e-3}
        return np.asarray(least_squares(lambda x: errors(x).ravel(), x, **loss).x)

    x = fitted(np.zeros(6))
    # Errors of the tags' layout and print are not among those stated.
    whitening /= max(1.4826 * float(np.median(np.abs(errors(x)))), 1.0)
    x = fitted(x)
    steps = 1e-6 * np.eye(6)
    slopes = np.stack([(errors(x + d) - errors(x - d)) / 2e-6 for d in steps], axis=-1)
    residuals = errors(x)
    weight = np.minimum(1.0, _HUBER / np.maximum(np.abs(residuals), 1e-12))
    scale = max(float(np.sum(weight * residuals**2)) / max(residuals.size - 6, 1), 1.0)
    weighted = np.swapaxes(slopes * weight[..., None], 1, 2)
    information = weighted @ slopes / scale
    scores = np.einsum("nij,nj->ni", weighted, residuals) / scale
    by_gaps = weighted @ whitening / scale
    gains = -np.linalg.solve(information.sum(axis=0), by_gaps)
    return _PairsFit(moved(start, x), information, scores, gains)


def _gap(here: Pose, there: BodyObservation) -> Array:
    """Body pose by this camera minus that by the other, shape (6,), [m, rad]."""
    pose = there.camera_from_body
    turn = Rotation.from_matrix(here.rotation @ pose.rotation.T).as_rotvec()
    return np.concatenate([here.position - pose.position, turn])


def locate_camera_by_another(
    rig: Rig,
    source: ImageSource,
    reference_source: ImageSource,
    *,
    reference: str,
    camera: str | None = None,
    board: Board | None = None,
    pictures: int | None = None,
    wanted: float = 1e-3,
    output: Destination | str | Path | None = None,
    listener: Listener = SILENT,
) -> ExtrinsicsOutcome:
    """Finds a camera's pose from what another camera sees at the same time.

    Args:
        rig: The robot.
        source: A folder of images, or a video file.
        reference_source: As `source`, of the other camera; simultaneous images have the same name,
            in videos the same number.
        reference: The other camera of the rig; its pose is taken as known, too.
        camera: Which of the rig's cameras is located; the first when left out. Its matrix and
            distortion are taken as known.
        board: The board that both see; the tags of the platform when left out.
        pictures: Number of images from each video; 20 when left out.
        wanted: Required error in the work space, 95 %, [m].
        output: Folder for the result file and its report; nothing is written when left out.
        listener: Receives the progress.

    Raises:
        BadInput: Both are one camera, the board has no unique orientation, a source is a live
            camera, or too few pairs.
    """
    require_types((rig, Rig), (listener, Listener), optional=[(board, Board)])
    require_unaltered(rig)
    wanted = positive_number("wanted", wanted, "m")
    require_text(reference=reference)
    both = located, other = rig.camera(camera), rig.camera(reference)
    if located is other:
        raise BadInput(
            f"camera {located.name!r} cannot be located relative to itself",
            next_step="choose another camera of the rig whose pose is known",
        )
    if board is None:
        require_tags(rig, None)
    else:
        require_oriented(board)
    to = Destination.of(output).require_free("extrinsics", located.name)
    ready_to_measure(listener)
    seen: list[dict[str, BodyObservation]] = []
    unused: dict[str, str] = {}
    opened = [
        open_source(images, one, pictures, DEFAULT_IMAGES)
        for one, images in zip(both, (source, reference_source), strict=True)
    ]
    _require_recorded(both, opened)
    for one, images in zip(both, same_images(opened), strict=True):
        found_by_one, left_out = _observations(rig, one, images, board, listener)
        seen.append(found_by_one)
        unused |= {f"{one.name}: {name}": why for name, why in left_out.items()}
    own, others = seen
    alone = [name for name in own if name not in others]
    unused |= {f"{located.name}: {n}": f"no observation by camera {other.name}" for n in alone}
    pairs = {name: (body, others[name]) for name, body in own.items() if name in others}
    numbers = (
        name.encode() + np.round(body.camera_from_body.matrix(), 9).tobytes()
        for name, pair in pairs.items()
        for body in pair
    )
    found = locate_by_pairs(rig, located, other, pairs, unused, data_hash(numbers))
    return judged_extrinsics(found, rig, located, wanted, to)


def _require_recorded(cameras: Sequence[Camera], opened: Sequence[ImageSet]) -> None:
    """Refuses live cameras: all images of the first would be older than those of the second."""
    for camera, pictures in zip(cameras, opened, strict=True):
        if pictures.is_live:
            raise BadInput(
                "images of a live camera cannot be paired with those of another",
                where=f"camera {camera.name}",
                why="the cameras would take their images one after the other, not at the same"
                " times",
                next_step="save images of both while nothing moves, with the same name for each"
                " pair, and pass the two folders",
            )


def _observations(
    rig: Rig, camera: Camera, pictures: ImageSet, board: Board | None, listener: Listener
) -> tuple[dict[str, BodyObservation], dict[str, str]]:
    """Observations of a camera by image, and why other images are not used."""
    found: dict[str, BodyObservation] = {}
    unused = dict(pictures.unused)
    with pictures.reported(f"camera {camera.name}", listener) as images:
        if board is None:
            numbers = [tag.id for tag in rig.platform_tags]
            observations = observe_tags(images, rig, camera, numbers, unused)
            found, unused = observe_platform(rig, camera, observations), dict(observations.unused)
            unused |= {n: "allows no unique pose" for n in observations.squares if n not in found}
            return found, unused
        for name, image in images:
            body = observe_board(board, camera, image)
            if body is None:
                unused[name] = NOT_FOUND
            else:
                found[name] = body
    return found, unused
