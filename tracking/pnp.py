"""Rigid pose of a body from all its tags at once.

All squares in one plane allow two poses: with weak perspective, a plane looks the same reflected at
the image plane. The best pose is refined by Levenberg–Marquardt on the edges of all squares with
Huber's loss, and so is its mirror pose unless tags on several faces exclude it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from model.cameras import Z_95
from model.pose import Array, Pose, matrix_from_rotation_vector, moved, read_only
from model.rig import Camera, Tag
from tracking.camera_model import (
    image_slopes,
    pose_slopes,
    project_undistorted,
    reprojection_errors,
    rms,
)
from tracking.detection.tags import CORNER_SIGNS, tag_corners
from tracking.edges.refine import RefinedTag

#: Edge errors beyond this many deviations count linearly (Huber).
HUBER = 3.0
#: Weight of the edges' stated deviations, in residuals, when the covariance is scaled by their
#: misfit: few edges fit well by chance.
PRIOR_WEIGHT = 12.0
#: A cost above the expected one by this factor is significant; lower limit on the degrees of
#: freedom of Student's factor.
CHANCE, FEWEST = 1.3, 4
#: Coverage of the intervals.
COVERAGE = 0.95
#: With four edges in all, one of them is taken to be wrong if the cost exceeds the expected one by
#: this factor: the 99.9 % quantile of a chi-squared variable with two degrees of freedom.
ONE_WRONG = 6.9
#: Two results closer than this are the same, [m] and [rad].
SAME = (2e-3, 0.02)
#: Tags are in one plane if their scatter along its normal is below this share of that across it.
FLAT = 0.1
#: A prior decides between two poses if one is within this angle of it, [rad].
NEAR = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class TagView:
    """A tag of a body and its detection in an image."""

    tag: Tag
    seen: RefinedTag


@dataclass(frozen=True, eq=False)
class BundlePose:
    """The fitted pose of a body.

    Attributes:
        squares: The tags.
        camera_from_body: The pose.
        stated: Covariance of position [m] and rotation vector [rad] along the camera's axes, shape
            (6, 6), from the stated deviations of the edges.
        cost: Huber cost of the edges, in variances.
        second_best_cost: Cost of the second-best, or mirror, pose; infinite without one.
        freedom: Degrees of freedom: edge errors minus six.
        edge_errors: Of each tag's edges, in deviations, 0 where hidden, shape (t, 4).
        displaced: Numbers of tags left out because they are not where the pose puts them.
        second_best: The second-best pose, if there is one.
        without_one: Scatter of the poses without one edge each about this one, shape (6, 6), if
            one of four edges in all is wrong; else 0.
    """

    squares: Squares
    camera_from_body: Pose
    stated: Array
    cost: float
    second_best_cost: float
    freedom: int
    edge_errors: Array
    displaced: tuple[int, ...] = ()
    second_best: Pose | None = None
    without_one: Array = field(default_factory=lambda: np.zeros((6, 6)))

    def is_expected(self, prior: Pose | None) -> bool:
        """Whether a prior of the pose decides for it, and against the second-best one."""
        if prior is None:
            return False
        rival = math.inf if self.second_best is None else prior.angle_to(self.second_best)
        return prior.angle_to(self.camera_from_body) < min(NEAR, rival)

    def misfit(self, expected: float) -> float:
        """Ratio of the edges' actual variance to the stated one, from their misfit.

        If the misfit is significant, the stated noise is wrong and only the residuals count, with
        Student's factor for their number.

        Args:
            expected: The expected cost, such as `freedom`.
        """
        usual = (PRIOR_WEIGHT + self.cost) / (PRIOR_WEIGHT + expected)
        if self.cost <= CHANCE * expected:
            return usual
        factor = stdtrit(max(expected, FEWEST), 0.5 + COVERAGE / 2.0) / Z_95
        return max(usual, self.cost / max(expected, 1.0) * float(factor) ** 2)

    def covariance_if(self, expected: float) -> Array:
        """Covariance of the pose, shape (6, 6), widened by the misfit of its edges.

        Args:
            expected: The expected cost, `freedom` or more.
        """
        factor = min(self.misfit(self.freedom), max(self.misfit(expected), 1.0))
        return read_only(factor * self.stated + self.without_one)

    @cached_property
    def covariance(self) -> Array:
        """Covariance of position [m] and rotation vector [rad], camera axes, shape (6, 6)."""
        return self.covariance_if(self.freedom)

    # In the image: pixels of the fit are undistorted, and larger off the axis of a wide lens.

    @cached_property
    def _points(self) -> Array:
        return self.camera_from_body.apply(self.squares.corners)

    @cached_property
    def _variances(self) -> Array:
        """Of the edges' offsets and tilts, 0 where hidden, shape (t, 8), [px²]."""
        squares, depth = self.squares, self._points[..., 2, None, None]
        focal = squares.camera.matrix[[0, 1], [0, 1]]
        by_undistorted = image_slopes(squares.camera, self._points)[..., :2] * depth / focal
        whitening = squares.whitening.reshape(-1, 8, 4, 2).swapaxes(1, 2)
        information = np.sum((whitening @ np.linalg.inv(by_undistorted)) ** 2, axis=(1, 3))
        is_measured = np.repeat(squares.edges, 2, axis=1)
        variances = np.zeros(information.shape)
        np.divide(1.0, information, where=is_measured, out=variances)
        return variances

    @cached_property
    def certainties(self) -> Array:
        """Information of each tag's edges, shape (t,), [1/px²]."""
        return np.asarray(2.0 * self.squares.edges.sum(axis=1) / self._variances.sum(axis=1))

    @cached_property
    def reprojection(self) -> float:
        """RMS error of all tags' corners, each tag weighted by its certainty, [px].

        Of partly hidden tags, that of the measured edges.
        """
        squares, count = self.squares, self.squares.edges.sum(axis=1)
        corners = rms(reprojection_errors(squares.camera, self._points, squares.seen))
        offsets = (squares.errors(self.camera_from_body) ** 2 * self._variances)[:, ::2]
        squared = np.where(count == 4, corners**2, offsets.sum(axis=1) / count)
        return float(np.sqrt(np.average(squared, weights=self.certainties)))


@dataclass(frozen=True, eq=False)
class Squares:
    """Corners of all tags on the body and their measured edges, stacked."""

    camera: Camera
    corners: Array  # (t, 4, 3)
    whitening: Array  # (t, 8, 8)
    target: Array  # (t, 8)
    seen: Array  # (t, 4, 2)
    edges: NDArray[np.bool_]  # (t, 4)

    @classmethod
    def of(cls, camera: Camera, views: Sequence[TagView]) -> Squares:
        """The corners and edges of views."""
        return cls(
            camera,
            np.array([tag_corners(v.tag) for v in views]),
            np.array([v.seen.whitening for v in views]),
            np.array([v.seen.target for v in views]),
            np.array([v.seen.corners for v in views]),
            np.array([v.seen.edges for v in views]),
        )

    @cached_property
    def normal(self) -> Array | None:
        """Normal of the plane of all tags in the body's frame; None if they are in no plane."""
        points = self.corners.reshape(-1, 3)
        arms = points - points.mean(axis=0)
        variances, axes = np.linalg.eigh(arms.T @ arms)
        return axes[:, 0] if variances[0] < FLAT**2 * variances[1] else None

    def errors(self, pose: Pose) -> Array:
        """Whitened errors of the edges, shape (t, 8)."""
        pixels = project_undistorted(self.camera, pose.apply(self.corners))
        return self._whitened(pixels.reshape(-1, 8)) - self.target

    def _whitened(self, flat: Array) -> Array:
        return np.asarray(np.einsum("tij,tj->ti", self.whitening, flat))

    def jacobian(self, pose: Pose) -> Array:
        """Derivatives of the errors by shift [m] and rotation [rad] about the camera's axes."""
        slopes = pose_slopes(self.camera, self.corners, pose)
        return np.asarray(self.whitening @ slopes.reshape(len(self.corners), 8, 6))


def solve_pnp(
    camera: Camera, views: Sequence[TagView], prior: Pose | None = None
) -> BundlePose | None:
    """The pose of a body from its detected tags.

    Args:
        camera: The camera; its pose is not used.
        views: One or more tags.
        prior: A guess of ``camera_from_body``, used as a further start.

    Returns:
        The best pose, or None if no start leads to one in front of the camera.
    """
    squares = Squares.of(camera, views)
    starts = [pose for view in views for pose in square_poses(camera, view)]
    starts += [prior] if prior is not None else []
    starts = [pose for pose in starts if _in_front(squares, pose)]
    ranked = sorted(starts, key=lambda pose: _huber(squares.errors(pose)))
    rivals = _different(ranked[1:], ranked[:1])[:1] if squares.normal is None else []
    return _best(squares, ranked[:1] + rivals)


def solve_near(camera: Camera, views: Sequence[TagView], start: Pose) -> BundlePose | None:
    """Refines a pose, or its mirror pose if tags in one plane fit that better."""
    return _best(Squares.of(camera, views), [start])


def _best(squares: Squares, starts: list[Pose]) -> BundlePose | None:
    """The best of the refined poses and, of tags in one plane, of their mirror poses."""
    found = _costed(squares, starts)
    if found and squares.normal is not None:
        found += _costed(squares, [_mirrored(squares, found[0][1], squares.normal)])
    if not found:
        return None
    found.sort(key=lambda item: item[0])
    cost, best = found[0]
    for other, rival in found[1:]:
        if not _same(rival, best):
            return replace(_result(squares, best, cost, other), second_best=rival)
    return _result(squares, best, cost, math.inf)


def _costed(squares: Squares, starts: Sequence[Pose]) -> list[tuple[float, Pose]]:
    """The refined poses, and their costs, of those starts that are in front of the camera."""
    poses = [_refined(squares, start) for start in starts if _in_front(squares, start)]
    return [(_huber(squares.errors(pose)), pose) for pose in poses]


def _mirrored(squares: Squares, pose: Pose, normal: Array) -> Pose:
    """A pose reflected at the image plane, and at the tags' own plane, which they do not show.

    Source: Oberkampf, DeMenthon & Davis, "Iterative pose estimation using coplanar feature points",
    CVIU 63, 1996.
    """
    centre = pose.apply(squares.corners).reshape(-1, 3).mean(axis=0)
    sight, across = centre / np.linalg.norm(centre), pose.rotation @ normal
    turn = (np.eye(3) - 2.0 * np.outer(sight, sight)) @ (np.eye(3) - 2.0 * np.outer(across, across))
    return Pose(centre + turn @ (pose.position - centre), turn @ pose.rotation)


def refine_pnp(camera: Camera, views: Sequence[TagView], start: Pose) -> BundlePose | None:
    """Refines a pose known to be the right one; considers no alternative."""
    squares = Squares.of(camera, views)
    for cost, pose in _costed(squares, [start]):
        return _result(squares, pose, cost, math.inf)
    return None


def square_poses(camera: Camera, view: TagView) -> list[Pose]:
    """Both candidates of ``camera_from_body`` from a single square."""
    half = view.tag.size / 2.0
    square = np.column_stack([CORNER_SIGNS * half, np.zeros(4)])
    count, turns, shifts, _ = cv2.solvePnPGeneric(
        square,
        np.ascontiguousarray(view.seen.corners),
        camera.matrix,
        np.zeros(4),
        flags=cv2.SOLVEPNP_IPPE_SQUARE,
    )
    tag_from_body = view.tag.pose.inverse()
    poses = []
    for turn, shift in zip(turns[:count], shifts[:count], strict=True):
        rotation = matrix_from_rotation_vector(np.ravel(turn))
        pose = Pose(np.ravel(shift).astype(np.float64), rotation).compose(tag_from_body)
        if np.all(np.isfinite(pose.matrix())):
            poses.append(pose)
    return poses


# Outlier edges.


#: An edge is an outlier if its error exceeds this many times the median error.
FAR = 4.5


def _without_outliers(views: list[TagView], bundle: BundlePose) -> list[TagView] | None:
    """Views without outlier edges, or None if there are no outliers.

    Of four edges or fewer none is left out: the others fit exactly, whichever it is.
    """
    errors = bundle.edge_errors
    measured = np.array([view.seen.edges for view in views])
    if bundle.freedom <= 2:
        return None
    usual = max(1.0, float(np.median(errors[measured])) / 1.18)  # median of Rayleigh's distribution
    off = measured & (errors > FAR * usual)
    if not off.any():
        return None
    kept = []
    for view, wrong in zip(views, off, strict=True):
        edges = view.seen.edges & ~wrong
        if edges.sum() < 2:
            continue
        keep = np.repeat(edges, 2)
        seen = replace(
            view.seen,
            edges=edges,
            whitening=read_only(view.seen.whitening * keep[:, None]),
            target=read_only(view.seen.target * keep),
        )
        kept.append(TagView(view.tag, seen))
    return kept


def fit_inliers(
    camera: Camera, views: list[TagView], start: Pose
) -> tuple[list[TagView], BundlePose] | None:
    """The views without outlier edges and their pose near another; None if nothing fits."""
    for _ in range(4):
        bundle = solve_near(camera, views, start) if views else None
        if bundle is None:
            return None
        kept = _without_outliers(views, bundle)
        if kept is None:
            return views, bundle
        views, start = kept, bundle.camera_from_body
    return None


def scatter_without_one(bundle: BundlePose, expected: float) -> Array:
    """Mean square of the steps to the poses without one of four edges each, shape (6, 6).

    Any three edges fit exactly. So if the misfit of four is significant, any one of them may carry
    all of it, however little of it the pose leaves over. Otherwise the result is 0.

    Args:
        bundle: A pose from four edges.
        expected: The expected cost, `freedom` or more.
    """
    if bundle.cost <= ONE_WRONG * expected:
        return np.zeros((6, 6))
    squares, pose = bundle.squares, bundle.camera_from_body
    edges = squares.edges.reshape(-1)
    errors = squares.errors(pose).reshape(-1, 2)[edges]
    slopes = squares.jacobian(pose).reshape(-1, 2, 6)[edges]
    rest = [np.delete(np.arange(4), k) for k in range(4)]
    try:
        steps = np.linalg.solve(slopes[rest].reshape(4, 6, 6), errors[rest].reshape(4, 6, 1))
    except np.linalg.LinAlgError:  # three of the edges do not determine the pose
        return np.full((6, 6), np.inf)
    return read_only(np.mean(steps @ steps.swapaxes(1, 2), axis=0))


def _in_front(squares: Squares, pose: Pose) -> bool:
    return bool(np.all(pose.apply(squares.corners)[..., 2] > 1e-3))


def _same(a: Pose, b: Pose) -> bool:
    return a.distance_to(b) < SAME[0] and a.angle_to(b) < SAME[1]


def _different(poses: Sequence[Pose], from_: Sequence[Pose]) -> list[Pose]:
    """Poses whose rotation clearly differs from all of ``from_``."""
    return [p for p in poses if all(p.angle_to(q) > 0.05 for q in from_)]


def edge_sizes(errors: Array) -> Array:
    """Size of each edge's error in deviations, shape (t, 4)."""
    return np.asarray(np.linalg.norm(errors.reshape(-1, 4, 2), axis=2))


def _huber(errors: Array) -> float:
    size = edge_sizes(errors)
    near = np.minimum(size, HUBER)
    return float(np.sum(near * (2.0 * size - near)))


def huber_weights(errors: Array) -> Array:
    """Huber weight of every error, shape (8 t,)."""
    size = np.maximum(edge_sizes(errors), 1e-12)
    return np.repeat(np.minimum(1.0, HUBER / size).reshape(-1), 2)


def _refined(squares: Squares, pose: Pose) -> Pose:
    """Levenberg–Marquardt from an initial pose."""
    errors = squares.errors(pose)
    cost, damping = _huber(errors), 1e-4
    for _ in range(40):
        jacobian = squares.jacobian(pose).reshape(-1, 6)
        weighted = jacobian * huber_weights(errors)[:, None]
        normal, gradient = jacobian.T @ weighted, weighted.T @ errors.reshape(-1)
        damped = normal + damping * np.diag(np.diag(normal) + 1e-9)
        step: Array = np.asarray(-np.linalg.solve(damped, gradient), dtype=np.float64)
        candidate = moved(pose, step)
        if _in_front(squares, candidate):
            trial = squares.errors(candidate)
            trial_cost = _huber(trial)
            if trial_cost <= cost:
                settled = cost - trial_cost < 1e-7 * (1.0 + cost)
                pose, errors, cost = candidate, trial, trial_cost
                damping = max(damping / 10.0, 1e-12)
                if settled:
                    break
                continue
        damping *= 10.0
        if damping > 1e8:
            break
    return pose


def _result(squares: Squares, pose: Pose, cost: float, rival: float) -> BundlePose:
    errors = squares.errors(pose)
    jacobian = squares.jacobian(pose).reshape(-1, 6)
    normal = jacobian.T @ (jacobian * huber_weights(errors)[:, None])
    freedom = 2 * int(squares.edges.sum()) - 6
    try:
        covariance: Array = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    except np.linalg.LinAlgError:  # too few edges for six parameters
        covariance = np.full((6, 6), np.inf)
    return BundlePose(
        squares,
        pose,
        read_only(covariance),
        cost,
        rival,
        max(freedom, 0),
        read_only(edge_sizes(errors)),
    )
