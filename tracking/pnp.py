"""Rigid pose of a body from all its tags at once.

Each square alone allows two poses. The best of all these are refined by Levenberg–Marquardt on the
edges of all squares with Huber's loss, so a single square's mirror pose is rejected as soon as more
than one tag is visible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.special import ndtr, stdtrit

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
        second_best_cost: Cost of the second-best pose; infinite without one.
        freedom: Degrees of freedom: edge errors minus six.
        edge_errors: Of each tag's edges, in deviations, 0 where hidden, shape (t, 4).
        corner_errors: RMS error of each tag's corners, shape (t,), [px]; of partly hidden tags, of
            the measured edges.
        certainties: Information of each tag's edges, shape (t,), [1/px²].
        displaced: Numbers of tags left out because they are not where the pose puts them.
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


@dataclass(frozen=True, slots=True, eq=False)
class _Squares:
    """Corners of all tags on the body and their measured edges, stacked."""

    camera: Camera
    corners: Array  # (t, 4, 3)
    whitening: Array  # (t, 8, 8)
    target: Array  # (t, 8)

    @classmethod
    def of(cls, camera: Camera, views: Sequence[TagView]) -> _Squares:
        return cls(
            camera,
            np.array([tag_corners(v.tag) for v in views]),
            np.array([v.seen.whitening for v in views]),
            np.array([v.seen.target for v in views]),
        )

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
    squares = _Squares.of(camera, views)
    starts = [pose for view in views for pose in square_poses(camera, view)]
    starts += [prior] if prior is not None else []
    starts = [pose for pose in starts if _in_front(squares, pose)]
    ranked = sorted(starts, key=lambda pose: _huber(squares.errors(pose)))
    found: list[tuple[float, Pose]] = []
    rivals = _different(ranked[1:], ranked[:1])[:1]
    for start in ranked[:1] + rivals:
        pose = _refined(squares, start)
        found.append((_huber(squares.errors(pose)), pose))
    if not found:
        return None
    found.sort(key=lambda item: item[0])
    cost, best = found[0]
    others = [c for c, pose in found[1:] if not _same(pose, best)]
    return _result(squares, views, best, cost, min(others, default=float("inf")))


def refine_pnp(camera: Camera, views: Sequence[TagView], start: Pose) -> BundlePose | None:
    """Refines a pose known to be the right one; considers no alternative."""
    squares = _Squares.of(camera, views)
    if not _in_front(squares, start):
        return None
    pose = _refined(squares, start)
    return _result(squares, views, pose, _huber(squares.errors(pose)), float("inf"))


def moved_by_pixels(camera: Camera, views: Sequence[TagView], pose: Pose, shifts: Array) -> Array:
    """Change of a fitted pose with shifts of its corners, to first order.

    Args:
        camera: The camera.
        views: The tags.
        pose: ``camera_from_body`` that fits them.
        shifts: Of each tag's undistorted corners by each of k causes, shape (t, 8, k), [px].

    Returns:
        Shift [m] and rotation [rad] along the camera's axes, shape (6, k).
    """
    return _by_pixels(_Squares.of(camera, views), pose, shifts)[0]


def expected_cost(camera: Camera, views: Sequence[TagView], pose: Pose, shifts: Array) -> float:
    """Expected cost of a fitted pose whose corners have known errors beside their scatter.

    Args:
        camera: The camera.
        views: The tags.
        pose: ``camera_from_body`` that fits them.
        shifts: Of each tag's undistorted corners by each of k independent causes of unit variance,
            shape (t, 8, k), [px].
    """
    left = _by_pixels(_Squares.of(camera, views), pose, shifts)[1]
    measured = np.array([view.seen.edges for view in views])
    scatter = max(1.0 - 3.0 / np.count_nonzero(measured), 0.0)  # the pose absorbs six errors
    variances = scatter + np.mean(np.sum(left**2, axis=1).reshape(-1, 4, 2), axis=2)[measured]
    # Mean Huber cost of a pair of normal errors of equal variance: Rayleigh's distribution.
    near = 2.0 * variances * -np.expm1(-0.5 * HUBER**2 / np.maximum(variances, 1e-12))
    beyond = 2.0 * HUBER * np.sqrt(2.0 * np.pi * variances)
    return float(np.sum(near + beyond * ndtr(-HUBER / np.sqrt(np.maximum(variances, 1e-12)))))


def _by_pixels(squares: _Squares, pose: Pose, shifts: Array) -> tuple[Array, Array]:
    """Change of a pose with its corners, (6, k), and remaining edge errors, (8 t, k)."""
    slopes = squares.jacobian(pose).reshape(-1, 6)
    causes = (squares.whitening @ shifts).reshape(len(slopes), -1)
    weighted = slopes * _weights(squares.errors(pose))[:, None]
    steps = np.asarray(np.linalg.solve(slopes.T @ weighted, weighted.T @ causes))
    return steps, causes - slopes @ steps


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
        solve = solve_pnp if len(views) == 1 else refine_pnp  # a single tag has a mirror pose
        bundle = solve(camera, views, start) if views else None
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
    errors = _edge_sizes(_Squares.of(camera, views).errors(pose))
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


def _in_front(squares: _Squares, pose: Pose) -> bool:
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


def _weights(errors: Array) -> Array:
    """Huber weight of every error, shape (8 t,)."""
    size = np.maximum(_edge_sizes(errors), 1e-12)
    return np.repeat(np.minimum(1.0, HUBER / size).reshape(-1), 2)


def _refined(squares: _Squares, pose: Pose) -> Pose:
    """Levenberg–Marquardt from an initial pose."""
    errors = squares.errors(pose)
    cost, damping = _huber(errors), 1e-4
    for _ in range(40):
        jacobian = squares.jacobian(pose).reshape(-1, 6)
        weighted = jacobian * _weights(errors)[:, None]
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
    squares: _Squares, views: Sequence[TagView], pose: Pose, cost: float, rival: float
) -> BundlePose:
    errors = squares.errors(pose)
    jacobian = squares.jacobian(pose).reshape(-1, 6)
    normal = jacobian.T @ (jacobian * _weights(errors)[:, None])
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


def _corner_errors(squares: _Squares, views: Sequence[TagView], pose: Pose) -> Array:
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
