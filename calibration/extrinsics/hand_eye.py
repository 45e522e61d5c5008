"""A camera's pose from the rig's own motion: platform tags observed at encoder poses.

With Z = world_from_camera, X = platform_from_tags, P the encoder pose and M = camera_from_tags,
Z M = P X in every image. X is known from the rig file up to a small error; motion without rotation
cannot separate it from Z, and then the rig file's X holds.

A focal length, a tag size or a unit that is wrong makes the camera's motion longer or shorter than
that of the poses, and the fit takes the rest as noise. So the same fit is repeated with X free and
with one more unknown; a value of it that is not by chance is an issue.

Source: Tsai & Lenz 1989; solved for both at once as in Zhuang & Shiu 1993, by least squares.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calibration.extrinsics.result import (
    SCALES,
    ExtrinsicCalibration,
    nearest_to_median,
    scaled_to,
    widths_of,
    workspace_corners,
)
from calibration.results import Issue
from calibration.statistics import Interval
from calibration.tag_map.observations import TagObservations, platform_pose, platform_views
from model.cameras import Z_95
from model.errors import BadInput
from model.pose import Array, Pose, moved, read_only, step_between
from model.rig import Camera, Rig
from tracking.shared_errors import moved_by_pixels, pixels_by_lens

LEAST_POSES = 8
"""Fewer poses do not show how accurate the rig's poses are."""
_LEAST_SPAN = 0.1
"""Required span of the positions along their longest axis, [m]."""
TAG_FRAME_DEVIATION = (1e-3, np.radians(0.5))
"""Standard deviation of the tags' frame from the rig file, [m] and [rad]."""
_NOMINAL = Pose.level(np.zeros(3))
_FREE = (1.0, np.radians(500.0))
"""Its deviation in tests: unknown, but defined without rotations."""
_FIRST = (1e-3, np.radians(0.2))
"""Initial standard deviation of encoder poses, [m] and [rad]; then from the residuals."""
_LEAST = (2e-5, np.radians(0.002))
_HUBER = 2.0
"""Errors beyond this many deviations count linearly."""
_DEFINED = 1e-3
"""Inverse deviation of a test value, for motion that says nothing about it."""
_CONTRADICTION = (10e-3, np.radians(2.0))
"""Poses with more noise than this are not those of the images, [m] and [rad]."""
_SIGNIFICANT = 4.0
"""Deviations from which a test value, or a number of the tags' frame, is not by chance."""
_LEAST_CHANGE = 2e-3
"""Smaller relative errors of distances do not matter."""
_BLOCKS = (5, 10)
"""Errors of encoder poses vary slowly, so that tests leave out whole blocks of images, too."""


@dataclass(frozen=True, slots=True, eq=False)
class _PoseObservation:
    """One image: encoder pose and camera pose; covariance in the camera's frame."""

    world_from_platform: Pose
    camera_from_tags: Pose
    covariance: Array
    corner_error: float
    numbers: tuple[int, ...]
    by_lens: Array  # (6, n), of camera_from_tags by the lens's parameters, camera axes


@dataclass(frozen=True, slots=True, eq=False)
class _Stack:
    """n observations as arrays."""

    encoder: Array  # (n, 3, 3), rotations world_from_platform
    encoder_position: Array  # (n, 3)
    camera: Array  # (n, 3, 3), rotations camera_from_tags
    camera_position: Array  # (n, 3)
    covariance: Array  # (n, 6, 6)
    shifts: Array  # (n, 6, k), of camera_from_tags by k test values, camera axes

    @classmethod
    def of(cls, samples: Sequence[_PoseObservation]) -> _Stack:
        encoder = _as_arrays([s.world_from_platform for s in samples])
        camera = _as_arrays([s.camera_from_tags for s in samples])
        covariance = np.array([s.covariance for s in samples])
        return cls(*encoder, *camera, covariance, np.zeros((len(samples), 6, 0)))

    def gaps(self, cameras: Sequence[Pose], tags: Sequence[Pose], tests: Array) -> Array:
        """Tag poses from the encoders minus those from the camera, shape (b, n, 6), [m, rad].

        Args:
            cameras: ``world_from_camera``, of b guesses.
            tags: ``platform_from_tags`` of each.
            tests: Test values of each, shape (b, k).
        """
        (camera, eye), (tag, origin) = _as_arrays(cameras), _as_arrays(tags)
        there = (self.encoder @ origin[:, None, :, None])[..., 0] + self.encoder_position
        shift = (self.shifts @ tests[:, None, :, None])[..., 0]
        here = (self.camera_position + shift[..., :3]) @ camera.transpose(0, 2, 1) + eye[:, None]
        seen = self.camera
        if tests.shape[1]:
            rotations = Rotation.from_rotvec(shift[..., 3:].reshape(-1, 3)).as_matrix()
            seen = rotations.reshape(*there.shape, 3) @ seen
        turns = self.encoder @ tag[:, None] @ (camera[:, None] @ seen).transpose(0, 1, 3, 2)
        vectors = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec()
        return np.concatenate([there - here, vectors.reshape(there.shape)], axis=-1)

    def whitening(self, camera: Pose, noise: tuple[float, float]) -> Array:
        """Whitening of the gaps, shape (n, 6, 6); ``noise`` is that of the encoder poses."""
        turn = np.kron(np.eye(2), camera.rotation)
        covariance = turn @ self.covariance @ turn.T + np.diag(np.repeat(np.square(noise), 3))
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def _as_arrays(poses: Sequence[Pose]) -> tuple[Array, Array]:
    """Rotations and positions."""
    return np.array([p.rotation for p in poses]), np.array([p.position for p in poses])


@dataclass(frozen=True, slots=True, eq=False)
class _HandEyeFit:
    """A fit of u = 12 + k unknowns: camera's pose, tags' frame, k test values."""

    world_from_camera: Pose
    platform_from_tags: Pose
    test: Array  # (k,)
    noise: tuple[float, float]  # of encoder poses, [m] and [rad]
    prior: Array  # (u,), inverse deviations
    slopes: Array  # (n, 6, u), whitened and weighted
    errors: Array  # (n, 6), whitened and weighted
    whitening: Array  # (n, 6, 6), of the gaps, weighted

    @property
    def information(self) -> Array:
        """Information on all unknowns, shape (u, u)."""
        flat = self.slopes.reshape(-1, len(self.prior))
        return np.asarray(flat.T @ flat + np.diag(self.prior**2))

    def without_each(self, blocks: int) -> list[Array]:
        """Changes of the unknowns without each block of images, to first order, shape (u,)."""
        whole, changes = self.information, list[Array]()
        for part in np.array_split(np.arange(len(self.errors)), blocks):
            slope, error = self.slopes[part].reshape(-1, len(whole)), self.errors[part].ravel()
            changes.append(np.asarray(np.linalg.solve(whole - slope.T @ slope, slope.T @ error)))
        return changes

    def by_tags(self, shifts: Array) -> Array:
        """Change of the unknowns with the tags' poses in the camera frame, to first order.

        Args:
            shifts: Of those poses by each of k causes, camera axes, shape (n, 6, k), [m, rad].

        Returns:
            Shape (u, k); shifts and rotations are along the world's axes.
        """
        turn = np.kron(np.eye(2), self.world_from_camera.rotation)
        causes = np.einsum("nji,njk->ik", self.slopes, self.whitening @ turn @ shifts)
        return np.asarray(np.linalg.solve(self.information, causes))

    def deviations(self, camera: Camera, by_lens: Array) -> Array:
        """Standard deviations of the unknowns, shape (u,), with those from a stated lens.

        Args:
            by_lens: As `_PoseObservation.by_lens`, of all images, shape (n, 6, m).
        """
        covariance, count = np.asarray(np.linalg.inv(self.information)), len(self.errors)
        parts = {count, *(min(blocks, count) for blocks in _BLOCKS)}
        widths = [widths_of(covariance, self.without_each(blocks)) for blocks in parts]
        variance = np.square(np.max(widths, axis=0) / Z_95)
        if camera.lens_covariance is not None:
            slopes = self.by_tags(by_lens)
            variance = variance + np.diag(slopes @ camera.lens_covariance @ slopes.T)
        return np.asarray(np.sqrt(variance))


def locate_by_motion(
    rig: Rig, camera: Camera, observations: TagObservations, poses: Mapping[str, Pose]
) -> ExtrinsicCalibration:
    """Finds a camera's pose from images of the platform at known poses.

    Args:
        camera: Its matrix and distortion are taken as known; its pose in the rig file is not used.
        poses: ``world_from_platform`` at each image.

    Raises:
        BadInput: Too few images have a pose.
    """
    observations = observations.without_duplicates(camera)
    unknown = {name: "has no pose" for name in observations.squares if name not in poses}
    observations = observations.without(unknown)
    found = {
        name: _observe(rig, camera, observations, name, poses[name])
        for name in observations.squares
    }
    unsure = {name: "allows no unique pose" for name, one in found.items() if one is None}
    observations = observations.without(unsure)
    samples = [one for one in found.values() if one is not None]
    if len(samples) < 3:
        raise BadInput(
            f"{len(samples)} images show the platform at a known pose; at least 3 are required",
            where=f"camera {camera.name}",
            why="; ".join(f"{name} {why}" for name, why in list(observations.unused.items())[:4]),
            next_step="take images at more poses, and list each in the pose file",
        )
    stack = _Stack.of(samples)
    guesses = [s.world_from_platform.compose(s.camera_from_tags.inverse()) for s in samples]
    start = nearest_to_median(guesses)
    best = _reweighted_fit(stack, start, _NOMINAL, TAG_FRAME_DEVIATION)
    scatter = np.asarray(np.linalg.inv(best.information))[:6, :6]
    without = [change[:6] for change in best.without_each(len(samples))]
    covariance = scaled_to(scatter, widths_of(scatter, without))
    by_lens = None
    if camera.lens_covariance is not None:
        by_lens = read_only(best.by_tags(np.array([one.by_lens for one in samples]))[:6])
        covariance = covariance + by_lens @ camera.lens_covariance @ by_lens.T
    contradictions, details = _consistency(camera, stack, samples, best)
    return ExtrinsicCalibration(
        camera=replace(camera, world_from_camera=best.world_from_camera),
        by="rig motion",
        covariance=read_only(covariance),
        half_widths=read_only(Z_95 * np.sqrt(np.diag(covariance))),
        by_lens=by_lens,
        points=workspace_corners(rig),
        tag_errors=_tag_errors(samples),
        pictures=len(samples),
        unused=observations.unused,
        issues=contradictions or tuple(_issues(samples)),
        data_hash=observations.data_hash(),
        is_contradictory=bool(contradictions),
        details=details,
    )


def _observe(
    rig: Rig, camera: Camera, observations: TagObservations, name: str, pose: Pose
) -> _PoseObservation | None:
    squares = observations.squares[name]
    found = platform_pose(rig, camera, squares)
    if found is None:
        return None
    seen, views = found.camera_from_body, platform_views(rig, squares)
    by_lens = moved_by_pixels(camera, views, seen, pixels_by_lens(camera, views))
    return _PoseObservation(
        pose, seen, found.covariance, found.reprojection, tuple(squares), by_lens
    )


def _reweighted_fit(
    stack: _Stack, start: Pose, tags: Pose, deviations: tuple[float, float], rounds: int = 4
) -> _HandEyeFit:
    """The fit, with the noise of the encoder poses estimated from residuals.

    Args:
        start: Initial ``world_from_camera``.
        tags: Initial ``platform_from_tags``.
        deviations: Of the tags' frame from the rig file, [m] and [rad].
        rounds: Number of such estimates.
    """
    fit = _fit(stack, start, tags, np.zeros(stack.shifts.shape[2]), _FIRST, deviations)
    for _ in range(rounds):
        gaps = np.abs(stack.gaps([fit.world_from_camera], [fit.platform_from_tags], fit.test[None]))
        noise = (
            max(float(1.4826 * np.median(gaps[..., :3])), _LEAST[0]),
            max(float(1.4826 * np.median(gaps[..., 3:])), _LEAST[1]),
        )
        fit = _fit(stack, fit.world_from_camera, tags, fit.test, noise, deviations)
    return fit


def _fit(
    stack: _Stack,
    start: Pose,
    tags: Pose,
    test: Array,
    noise: tuple[float, float],
    deviations: tuple[float, float],
) -> _HandEyeFit:
    """Fits all unknowns with Huber's loss."""
    whitening = stack.whitening(start, noise)
    prior = np.concatenate(
        [np.zeros(6), 1.0 / np.repeat(deviations, 3), np.full(len(test), _DEFINED)]
    )

    def own(xs: Array) -> Array:  # many guesses in one call: its overhead is most of its time
        cameras = [moved(start, x[:6]) for x in xs]
        gaps = stack.gaps(cameras, [moved(_NOMINAL, x[6:12]) for x in xs], xs[:, 12:])
        return np.asarray(np.einsum("nij,bnj->bni", whitening, gaps))

    def residuals(xs: Array) -> Array:
        return np.hstack([own(xs).reshape(len(xs), -1), prior[6:] * xs[:, 6:]])

    found = least_squares(
        lambda x: residuals(x[None])[0],
        np.concatenate([np.zeros(6), step_between(_NOMINAL, tags), test]),
        loss="huber",
        f_scale=_HUBER,
        x_scale=1e-3,
        xtol=1e-12,
        workers=lambda _, xs: residuals(np.array(list(xs))),
    )
    x, errors, steps = found.x, own(found.x[None])[0], 1e-6 * np.eye(len(prior))
    slopes = np.stack([*(own(x + steps) - own(x - steps)) / 2e-6], axis=-1)
    weight = np.sqrt(np.minimum(1.0, _HUBER / np.maximum(np.abs(errors), 1e-12)))
    return _HandEyeFit(
        moved(start, x[:6]),
        moved(_NOMINAL, x[6:12]),
        x[12:],
        noise,
        prior,
        slopes * weight[..., None],
        errors * weight,
        whitening * weight[..., None],
    )


# Whether poses and images are of the same motion.


def _consistency(
    camera: Camera, stack: _Stack, samples: Sequence[_PoseObservation], best: _HandEyeFit
) -> tuple[tuple[Issue, ...], tuple[tuple[str, str], ...]]:
    """Contradictions between poses and images, and the measured values as text."""
    by_lens = np.array([one.by_lens for one in samples])
    scaled = np.hstack([stack.camera_position, np.zeros((len(samples), 3))])
    longer = by_lens[:, :, :2] @ np.diag(camera.matrix)[:2]
    distances, focal = (
        _reweighted_fit(
            replace(stack, shifts=shifts[..., None]),
            best.world_from_camera,
            best.platform_from_tags,
            _FREE,
            rounds=2,
        )
        for shifts in (scaled, longer)
    )
    off, turn = best.noise[0] * 1e3, np.degrees(best.noise[1])
    details = [("poses", f"scatter {off:.2g} mm, {turn:.2g}° about the images")]
    if all(np.greater(one.noise, _CONTRADICTION).any() for one in (best, distances, focal)):
        what = f"poses and images contradict each other by {off:.1f} mm, {turn:.1f}°"
        return (Issue(what, _CONVENTIONS),), tuple(details)
    if len(samples) < LEAST_POSES:
        return (), tuple(details)
    by_distance, by_focal = (one.deviations(camera, by_lens) for one in (distances, focal))
    likelier = [(distances, by_distance, _distance_issue), (focal, by_focal, _focal_issue)]
    likelier.sort(key=lambda one: -abs(one[0].test[0]) / one[1][12])
    issues = [
        issue(float(fit.test[0]))
        for fit, deviations, issue in likelier
        if abs(fit.test[0]) > max(_SIGNIFICANT * deviations[12], _LEAST_CHANGE)
    ][:1]
    fit, deviations, _ = likelier[0]
    offset = step_between(_NOMINAL, fit.platform_from_tags)
    allowed = np.hypot(np.repeat(TAG_FRAME_DEVIATION, 3), deviations[6:12])
    turns = [step_between(_NOMINAL, one.world_from_platform)[3:] for one in samples]
    if np.linalg.norm(np.std(turns, axis=0)) < 10.0 * fit.noise[1]:  # too little to locate it
        allowed[:3] = np.inf
    if (np.abs(offset) > _SIGNIFICANT * allowed).any():
        issues.append(_frame_issue(offset))
    ratio = 1.0 / (1.0 + distances.test[0])
    width = Z_95 * float(by_distance[12]) * ratio**2
    details += [
        ("distances", f"{Interval(float(ratio), width)} by the camera relative to the poses"),
        ("tags' frame", _frame_text(offset, Z_95 * deviations[6:12])),
    ]
    return tuple(issues), tuple(details)


_CONVENTIONS = (
    "check the poses' columns (qw comes first), units, axes (right-handed) and direction"
    " (world_from_platform, not its inverse), and which image each belongs to"
)
_SCALES_TO_CHECK = "the units of the poses, size_mm of the tags and the camera's matrix"
_METRES = 1000.0
"""Positions in metres that are read as millimetres: times as far by the camera."""


def _distance_issue(value: float) -> Issue:
    """That distances of the camera are to be multiplied by 1 + ``value``."""
    ratio = 1.0 / (1.0 + value)
    if 0.5 < ratio < 2.0:
        size = f"{abs(ratio - 1.0):.1%} {'larger' if ratio > 1.0 else 'smaller'}"
        what = f"the camera measures the platform's motion {size} than the poses"
    else:
        what = f"by the camera, the platform moves {ratio:.3g} times as far as by the poses"
    step = _CONVENTIONS if ratio < 0.0 else f"check {_SCALES_TO_CHECK}"
    if abs(ratio / _METRES - 1.0) < 0.1:
        step = "write x_mm, y_mm and z_mm of the poses in millimetres: they seem to be in metres"
    return Issue(what, step)


def _focal_issue(value: float) -> Issue:
    """That the poses fit a focal length of 1 + ``value`` times the camera's."""
    size = f"{abs(value):.1%} {'longer' if value > 0.0 else 'shorter'}"
    what = f"the poses fit a focal length that is {size} than in the camera's matrix"
    return Issue(what, f"check {_SCALES_TO_CHECK} (focus, zoom, image size)")


def _frame_issue(offset: Array) -> Issue:
    """That the tags' frame is so far from the rig file, shape (6,), [m, rad]."""
    off, turn = (float(np.linalg.norm(part)) for part in (offset[:3], offset[3:]))
    most = _SIGNIFICANT * np.array(TAG_FRAME_DEVIATION)
    what = (
        f"the tags fit the poses only {off * 1e3:.1f} mm and {np.degrees(turn):.1f}° from the rig"
        f" file; {most[0] * 1e3:.1f} mm and {np.degrees(most[1]):.1f}° are allowed"
    )
    step = (
        "check the tags' positions in the rig file, and that the poses are those of the platform's"
        " frame, not of another body on it and not inverse"
    )
    return Issue(what, step)


def _frame_text(offset: Array, half_widths: Array) -> str:
    """Distance and angle from the rig file, with the largest interval of an axis."""
    off, turn = (
        Interval(
            float(np.linalg.norm(offset[part])) * scale, float(half_widths[part].max()) * scale
        )
        for part, scale in ((slice(3), SCALES[0]), (slice(3, 6), SCALES[3]))
    )
    return f"{off} mm, {turn}° from the rig file"


def _tag_errors(samples: Sequence[_PoseObservation]) -> dict[int, float]:
    numbers = sorted({number for s in samples for number in s.numbers})
    return {
        number: float(np.sqrt(np.mean([s.corner_error**2 for s in samples if number in s.numbers])))
        for number in numbers
    }


def _issues(samples: Sequence[_PoseObservation]) -> list[Issue]:
    issues = []
    if len(samples) < LEAST_POSES:
        what = f"{len(samples)} poses were observed; {LEAST_POSES} are required"
        issues.append(Issue(what, "take images at more poses, far apart"))
    positions = np.array([s.world_from_platform.position for s in samples])
    span = float(np.ptp(positions, axis=0).max())
    if span < _LEAST_SPAN:
        what = f"all poses lie within {span * 1e3:.0f} mm; {_LEAST_SPAN * 1e3:.0f} mm are required"
        issues.append(Issue(what, "take images at more poses, far apart"))
    return issues
