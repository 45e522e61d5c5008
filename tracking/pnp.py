"""Rigid pose of a body from all its tags at once.

All squares in one plane allow two poses: with weak perspective, a plane looks the same reflected at
the image plane. The best pose is refined by Levenberg–Marquardt on the edges of all squares with
Huber's loss, and so is its mirror pose unless tags on several faces exclude it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy.special import stdtrit

from model.cameras import Z_95
from model.pose import Array, Pose, matrix_from_rotation_vector, moved, read_only
from model.rig import Camera, Tag
from tracking.camera_model import project_undistorted
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


@dataclass(frozen=True, slots=True, eq=False)
class BundlePose:
    """The fitted pose of a body.

    Attributes:
        camera_from_body: The pose.
        covariance: Of position [m] and rotation vector [rad] along the camera's axes, shape (6, 6).
        cost: Huber cost of the edges, in variances.
        second_best_cost: Cost of the second-best, or mirror, pose; infinite without one.
        freedom: Degrees of freedom: edge errors minus six.
        edge_errors: Of each tag's edges, in deviations, 0 where hidden, shape (t, 4).
        corner_errors: RMS error of each tag's corners, shape (t,), [px]; of partly hidden tags, of
            the measured edges.
        certainties: Information of each tag's edges, shape (t,), [1/px²].
        displaced: Numbers of tags left out because they are not where the pose puts them.
        second_best: The second-best pose, if there is one.
    """

    camera_from_body: Pose
    covariance: Array
    cost: float
    second_best_cost: float
    freedom: int
    edge_errors: Array
    corner_errors: Array
    certainties: Array
    displaced: tuple[int, ...] = ()
    second_best: Pose | None = None

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

    @property
    def reprojection(self) -> float:
        """RMS error of all tags' corners, each tag weighted by its edges' information, [px]."""
        return float(np.sqrt(np.average(self.corner_errors**2, weights=self.certainties)))


def pose_slopes(camera: Camera, points: Array, pose: Pose) -> Array:
    """Derivatives of undistorted pixels by shift [m] and rotation [rad], camera axes.

    Args:
        camera: The camera.
        points: In the body's frame, shape (..., 3), [m].
        pose: ``camera_from_body``.

    Returns:
        Shape (..., 2, 6), [px].
    """
    arms = points @ pose.rotation.T
    there = arms + pose.position
    by_point = np.zeros((*there.shape[:-1], 2, 3))
    depth = there[..., 2]
    for axis in range(2):
        focal = camera.matrix[axis, axis]
        by_point[..., axis, axis] = focal / depth
        by_point[..., axis, 2] = -focal * there[..., axis] / depth**2
    by_turn = _cross(arms[..., None, :], by_point)  # d(turn × arm) seen through by_point
    return np.concatenate([by_point, by_turn], axis=-1)


@dataclass(frozen=True, eq=False)
class Squares:
    """Corners of all tags on the body and their measured edges, stacked."""

    camera: Camera
    corners: Array  # (t, 4, 3)
    whitening: Array  # (t, 8, 8)
    target: Array  # (t, 8)

    @classmethod
    def of(cls, camera: Camera, views: Sequence[TagView]) -> Squares:
        """The corners and edges of views."""
        return cls(
            camera,
            np.array([tag_corners(v.tag) for v in views]),
            np.array([v.seen.whitening for v in views]),
            np.array([v.seen.target for v in views]),
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
    return _best(squares, views, ranked[:1] + rivals)


def solve_near(camera: Camera, views: Sequence[TagView], start: Pose) -> BundlePose | None:
    """Refines a pose, or its mirror pose if tags in one plane fit that better."""
    squares = Squares.of(camera, views)
    return _best(squares, views, [start] if _in_front(squares, start) else [])


def _best(squares: Squares, views: Sequence[TagView], starts: list[Pose]) -> BundlePose | None:
    """The best of the refined poses and, of tags in one plane, of their mirror poses."""
    found = [_costed(squares, start) for start in starts]
    if found and squares.normal is not None:
        mirror = _mirrored(squares, found[0][1], squares.normal)
        found += [_costed(squares, mirror)] if _in_front(squares, mirror) else []
    if not found:
        return None
    found.sort(key=lambda item: item[0])
    cost, best = found[0]
    for other, rival in found[1:]:
        if not _same(rival, best):
            result = _result(squares, views, best, cost, other)
            return replace(result, second_best=rival)
    return _result(squares, views, best, cost, math.inf)


def _costed(squares: Squares, start: Pose) -> tuple[float, Pose]:
    pose = _refined(squares, start)
    return _huber(squares.errors(pose)), pose


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
    if not _in_front(squares, start):
        return None
    cost, pose = _costed(squares, start)
    return _result(squares, views, pose, cost, math.inf)


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


# Outlier edges and displaced tags.


#: An edge is an outlier if its error exceeds this many times the median error.
FAR = 4.5
#: An intact square is elsewhere if the error of an edge exceeds this many expected deviations. A
#: rolling shutter in unknown motion causes 9 of them, a size that is 1 % wrong mostly 13 or more.
ELSEWHERE = 10.0


def _without_outliers(views: list[TagView], bundle: BundlePose) -> list[TagView] | None:
    """Views without outlier edges, or None if there are no outliers."""
    errors = bundle.edge_errors
    measured = np.array([view.seen.edges for view in views])
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


def displaced_tag(
    camera: Camera, views: Sequence[TagView], pose: Pose, expected: float, contradiction: float
) -> TagView | None:
    """The tag with the largest errors whose square is intact, but not where a pose puts it.

    What hides an edge of a tag or is mistaken for one does not leave a square. A tag of another
    size, number or pose is a square: its edges fit each other at some pose, but not at this one.

    Args:
        camera: The camera.
        views: Tags with all their measured edges.
        pose: ``camera_from_body``.
        expected: Squared error of an edge, in variances.
        contradiction: Limit of the misfit of a tag's own edges, in `expected`.
    """
    errors = _edge_sizes(Squares.of(camera, views).errors(pose))
    off = np.any(errors > ELSEWHERE * np.sqrt(expected), axis=1)
    for index in map(int, np.argsort(-errors.sum(axis=1))):
        view = views[index]
        alone = solve_pnp(camera, [view]) if off[index] else None
        if alone is not None and alone.cost <= contradiction * expected * max(1, alone.freedom):
            return view
    return None


def _cross(a: Array, b: Array) -> Array:
    """Cross product along the last axis; np.cross takes four times as long on small arrays."""
    return np.stack(
        [
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ],
        axis=-1,
    )


def _in_front(squares: Squares, pose: Pose) -> bool:
    return bool(np.all(pose.apply(squares.corners)[..., 2] > 1e-3))


def _same(a: Pose, b: Pose) -> bool:
    return a.distance_to(b) < SAME[0] and a.angle_to(b) < SAME[1]


def _different(poses: Sequence[Pose], from_: Sequence[Pose]) -> list[Pose]:
    """Poses whose rotation clearly differs from all of ``from_``."""
    return [p for p in poses if all(p.angle_to(q) > 0.05 for q in from_)]


def _edge_sizes(errors: Array) -> Array:
    """Size of each edge's error in deviations, shape (t, 4)."""
    return np.asarray(np.linalg.norm(errors.reshape(-1, 4, 2), axis=2))


def _huber(errors: Array) -> float:
    size = _edge_sizes(errors)
    near = np.minimum(size, HUBER)
    return float(np.sum(near * (2.0 * size - near)))


def huber_weights(errors: Array) -> Array:
    """Huber weight of every error, shape (8 t,)."""
    size = np.maximum(_edge_sizes(errors), 1e-12)
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


def _result(
    squares: Squares, views: Sequence[TagView], pose: Pose, cost: float, rival: float
) -> BundlePose:
    errors = squares.errors(pose)
    jacobian = squares.jacobian(pose).reshape(-1, 6)
    normal = jacobian.T @ (jacobian * huber_weights(errors)[:, None])
    freedom = 2 * sum(int(v.seen.edges.sum()) for v in views) - 6
    try:
        covariance: Array = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    except np.linalg.LinAlgError:  # too few edges for six parameters
        covariance = np.full((6, 6), np.inf)
    found = BundlePose(
        pose,
        covariance,
        cost,
        rival,
        max(freedom, 0),
        read_only(_edge_sizes(errors)),
        read_only(_corner_errors(squares, views, pose)),
        read_only(np.array([_certainty(view.seen) for view in views])),
    )
    return replace(found, covariance=read_only(found.misfit(found.freedom) * covariance))


def _certainty(seen: RefinedTag) -> float:
    """Inverse variance of a tag's corners from its edges' offsets and tilts, [1/px²]."""
    rows = np.sum(seen.whitening**2, axis=1)[np.repeat(seen.edges, 2)]
    return float(1.0 / np.mean(1.0 / rows))


def _corner_errors(squares: Squares, views: Sequence[TagView], pose: Pose) -> Array:
    """RMS error of the corners of each tag, shape (t,), [px]."""
    pixels = project_undistorted(squares.camera, pose.apply(squares.corners))
    result = []
    for view, corners, errors in zip(views, pixels, squares.errors(pose), strict=True):
        if view.seen.whole:
            gap = corners - view.seen.corners
            result.append(float(np.sqrt(np.mean(np.sum(gap**2, axis=1)))))
            continue
        # For a partly hidden square: offsets of its visible edges, in pixels.
        rows = np.linalg.norm(view.seen.whitening[::2], axis=1)[view.seen.edges]
        result.append(float(np.sqrt(np.mean((errors[::2][view.seen.edges] / rows) ** 2))))
    return np.array(result)
