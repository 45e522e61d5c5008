"""Poses and rotations: unit quaternions (w, x, y, z), matrices and rotation vectors.

Rotation limits hold exactly along whole moves. Every orientation is a turn about the vertical
followed by a tilt, a rotation about a horizontal axis. With the unit quaternion (w, x, y, z) the
tilt is 2 asin √(x² + y²), the angle of the platform's z axis from the vertical, and the turn
2 atan(z / w). Along a move about a constant axis the quaternion moves on a circle: x² + y² is then
a constant plus a sinusoid of the angle, whose maximum is known in closed form, and z / w is
monotonic.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import BadInput, distinct_figures, require_types

Array = NDArray[np.float64]
_CROSS = np.cross(np.eye(3)[:, None], np.eye(3)).swapaxes(1, 2).reshape(3, 9)


def floats_of(values: ArrayLike) -> Array:
    """What a script passes as an array of numbers; a copy only where it is none yet.

    Raises:
        BadInput: It has masked values; NumPy would use the numbers behind the mask.
        TypeError: It has texts or complex numbers, which NumPy would convert.
    """
    require_real(values)
    return np.asarray(values, dtype=np.float64)


def require_real(values: object) -> None:
    """Requires an array, or a list of arrays, of real numbers; errors as for `floats_of`."""
    if isinstance(values, list | tuple):
        for one in values:
            require_real(one)
    elif isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        raise BadInput(
            "an array has masked values, which are not to be used as numbers",
            next_step="leave them out, or fill them with `numpy.ma.filled`",
        )
    elif isinstance(values, str | bytes | complex) or _is_converted(values):
        raise TypeError("not real numbers")


def _is_converted(values: object) -> bool:
    return getattr(getattr(values, "dtype", None), "kind", "") in ("U", "S", "c")


def read_only(values: ArrayLike) -> Array:
    """A float copy of ``values`` that cannot be written to; errors as for `floats_of`."""
    require_real(values)
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def point_of(name: str, given: ArrayLike) -> Array:
    """A point or a displacement, shape (3,), [m].

    Args:
        given: What a script passes for it.

    Raises:
        BadInput: It is something else, or a coordinate is not finite.
    """
    try:
        point = floats_of(given)
    except (TypeError, ValueError, OverflowError):
        point = np.empty(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise BadInput(
            f"{name} must be three finite numbers, x, y and z in metres; it is {given!r}"
        )
    return point


class ReadOnly:
    """Base of frozen dataclasses whose arrays are read-only: so are those of their copies.

    NumPy makes the array of a pickled or deeply copied object writeable.
    """

    __slots__ = ()

    def __reduce__(self) -> tuple[Callable[..., ReadOnly], tuple[object, ...]]:
        """Copies and pickles the fields alone; what was computed from them is left out."""
        names = [one.name for one in fields(self)]  # type: ignore[arg-type]
        return _remade, (type(self), {name: getattr(self, name) for name in names})


def _remade(kind: type[ReadOnly], values: dict[str, object]) -> ReadOnly:
    made = kind.__new__(kind)
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
        object.__setattr__(made, name, value)
    return made


def skew(vector: ArrayLike) -> Array:
    """Matrix of the cross product: ``skew(a) @ b == a × b``; shape (..., 3, 3) of (..., 3)."""
    vectors = np.asarray(vector, dtype=np.float64)
    return (vectors @ _CROSS).reshape(*vectors.shape, 3)


def points_by_twist(arms: ArrayLike) -> Array:
    """Velocities of points of a body by its twist, shape (..., 3, 6) of (..., 3); its axes, [m]."""
    turning = -skew(arms)
    return np.concatenate([np.broadcast_to(np.eye(3), turning.shape), turning], axis=-1)


def matrix_from_quaternion(quaternion: ArrayLike) -> Array:
    """Rotation matrix of a unit quaternion (w, x, y, z); shape (3, 3)."""
    w, x, y, z = np.asarray(quaternion, dtype=np.float64).tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_matrix(matrix: ArrayLike) -> Array:
    """Unit quaternion (w ≥ 0) of a rotation matrix; stable for every angle (Shepperd)."""
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(matrix, dtype=np.float64).tolist()
    trace = a + e + i
    largest = max(trace, a, e, i)
    if trace == largest:
        q = (1.0 + trace, h - f, c - g, d - b)
    elif a == largest:
        q = (h - f, 1.0 + 2.0 * a - trace, d + b, g + c)
    elif e == largest:
        q = (c - g, b + d, 1.0 + 2.0 * e - trace, h + f)
    else:
        q = (d - b, c + g, f + h, 1.0 + 2.0 * i - trace)
    length = math.hypot(*q)
    return np.array(q) / (length if q[0] >= 0.0 else -length)


def matrix_from_rotation_vector(vector: ArrayLike) -> Array:
    """Rotation matrix exp([vector]×), ``vector`` in rad; shape (3, 3)."""
    x, y, z = np.asarray(vector, dtype=np.float64).tolist()
    angle = math.hypot(x, y, z)
    if angle < 1e-6:  # series: the closed form loses digits near zero
        first, second = 1.0, 0.5
    else:
        first, second = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2
    xy, xz, yz = second * x * y, second * x * z, second * y * z
    xx, yy, zz = second * x * x, second * y * y, second * z * z
    return np.array(
        [
            [1.0 - yy - zz, xy - first * z, xz + first * y],
            [xy + first * z, 1.0 - xx - zz, yz - first * x],
            [xz - first * y, yz + first * x, 1.0 - xx - yy],
        ]
    )


def rotation_vector_from_matrix(matrix: ArrayLike) -> Array:
    """Rotation vector (axis times angle in [0, π]) of a rotation matrix; shape (3,), [rad]."""
    w, x, y, z = quaternion_from_matrix(matrix).tolist()
    sine = math.hypot(x, y, z)
    factor = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, w) / sine
    return np.array([factor * x, factor * y, factor * z])


_FOUR_DIGITS = 1e-3
"""Deviation of a quaternion's length, or of a matrix, that was written with four digits."""
_FARTHEST = 1e9
"""Sum of coordinates that a position stays below, [m]: files hold no larger numbers."""
_ROUND_OFF = 1e-9
"""Deviation up to which a rotation is used as it is; beyond, the nearest exact one replaces it."""


def _deviation(matrix: Array) -> float:
    """How far a matrix is from a rotation: its rows' lengths, and the third from their product."""
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    lengths = abs(a * a + b * b + c * c - 1.0) + abs(d * d + e * e + f * f - 1.0)
    third = abs(b * f - c * e - g) + abs(c * d - a * f - h) + abs(a * e - b * d - i)
    return float(lengths + third)


def _floats(values: ArrayLike, name: str) -> Array:
    try:
        return read_only(values)
    except (TypeError, ValueError):
        raise BadInput(
            f"the {name} of a pose does not consist of numbers: {str(values)[:60]}",
            where="Pose(position, rotation)",
            next_step="pass a list or an array of numbers",
        ) from None


@dataclass(frozen=True, slots=True, eq=False)
class Pose(ReadOnly):
    """Position and orientation of a frame in another, usually ``world_from_platform``.

    Poses of the same numbers are equal; `distance_to` and `angle_to` compare within a tolerance.

    Attributes:
        position: Shape (3,), [m].
        rotation: Rotation matrix, shape (3, 3); orthonormal to round-off. One that was written with
            few decimals is replaced by the nearest rotation.

    Raises:
        BadInput: A wrong shape, a value that is not a finite number, or no rotation: a reflection,
            a scaled matrix.
    """

    position: Array
    rotation: Array

    if TYPE_CHECKING:

        def __init__(self, position: ArrayLike, rotation: ArrayLike) -> None: ...

    def __post_init__(self) -> None:
        """Copies the arrays and makes them read-only."""
        object.__setattr__(self, "position", _floats(self.position, "position"))
        object.__setattr__(self, "rotation", _floats(self.rotation, "rotation"))
        if self.position.shape != (3,) or self.rotation.shape != (3, 3):
            raise BadInput(
                f"position and rotation of a pose have shapes {self.position.shape} and"
                f" {self.rotation.shape}, not (3,) and (3, 3)",
                where="Pose(position, rotation)",
                next_step="pass a position of shape (3,) [m] and a rotation of shape (3, 3)",
            )
        if not sum(map(abs, self.position.tolist())) < _FARTHEST:
            raise BadInput(
                f"the position {self.position.tolist()} m of a pose is not finite, or too far away",
                where="Pose(position, rotation)",
                next_step="pass three numbers, in metres",
            )
        off = _deviation(self.rotation)
        if not off < _FOUR_DIGITS:
            raise BadInput(
                "the matrix of a pose is not a rotation",
                where="Pose(position, rotation)",
                why="its rows are not of length 1, not at right angles, or mirrored",
                next_step="compute it from a unit quaternion: Pose.from_quaternion(position, wxyz)",
            )
        if off > _ROUND_OFF:
            left, _, right = np.linalg.svd(self.rotation)
            object.__setattr__(self, "rotation", read_only(left @ right))

    def __eq__(self, other: object) -> bool:
        """Whether every number is the same."""
        if not isinstance(other, Pose):
            return NotImplemented
        return np.array_equal(self.position, other.position) and np.array_equal(
            self.rotation, other.rotation
        )

    def __hash__(self) -> int:
        """Equal for equal poses."""
        return hash((*self.position.tolist(), *self.rotation.ravel().tolist()))

    @classmethod
    def level(cls, position: ArrayLike) -> Pose:
        """A pose without rotation at ``position`` [m]."""
        return cls(_floats(position, "position"), np.eye(3))

    @classmethod
    def from_quaternion(cls, position: ArrayLike, quaternion: ArrayLike) -> Pose:
        """A pose from ``position`` [m] and a unit quaternion (w, x, y, z).

        Raises:
            BadInput: The length of the quaternion is not 1 to about 1e-3, or as for `Pose`.
        """
        wxyz = _floats(quaternion, "quaternion")
        length = math.hypot(*wxyz.tolist()) if wxyz.shape == (4,) else math.nan
        if not abs(length - 1.0) < _FOUR_DIGITS:
            raise BadInput(
                f"{wxyz.tolist()} is not a unit quaternion (w, x, y, z)",
                where="Pose.from_quaternion(position, quaternion)",
                why=f"its length is {length:.6g}" if wxyz.shape == (4,) else "it needs 4 numbers",
                next_step="divide it by its length; [1, 0, 0, 0] is the level orientation",
            )
        if abs(length - 1.0) > _ROUND_OFF:
            wxyz = read_only(wxyz / length)
        return cls(_floats(position, "position"), matrix_from_quaternion(wxyz))

    @property
    def quaternion(self) -> Array:
        """Unit quaternion (w, x, y, z), w ≥ 0."""
        return quaternion_from_matrix(self.rotation)

    @property
    def tilt(self) -> float:
        """Angle between the z axes of both frames, [rad]."""
        return float(np.arccos(np.clip(self.rotation[2, 2], -1.0, 1.0)))

    @property
    def turn(self) -> float:
        """Angle about z that is left without the tilt, as in `RotationLimits`, −π to π, [rad]."""
        w, _, _, z = self.quaternion
        return 2.0 * math.atan2(z, w)

    def apply(self, points: ArrayLike) -> Array:
        """Maps points, shape (..., 3), [m], of the inner frame into the outer one.

        Raises:
            BadInput: They are something else.
        """
        try:
            given = floats_of(points)
        except (TypeError, ValueError):
            given = np.empty(0)
        if given.shape[-1:] != (3,):
            raise BadInput(
                f"points must be numbers of shape (..., 3): {str(points)[:60]}",
                where="Pose.apply(points)",
                next_step="pass x, y and z of each point, in metres",
            )
        return np.asarray(given @ self.rotation.T + self.position)

    def compose(self, other: Pose) -> Pose:
        """``a_from_b.compose(b_from_c)`` is ``a_from_c``."""
        require_types((other, Pose))
        return Pose(self.apply(other.position), self.rotation @ other.rotation)

    def inverse(self) -> Pose:
        """``a_from_b.inverse()`` is ``b_from_a``."""
        return Pose(-self.rotation.T @ self.position, self.rotation.T)

    def matrix(self) -> Array:
        """Homogeneous matrix, shape (4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.position
        return matrix

    def angle_to(self, other: Pose) -> float:
        """Angle of the rotation between two poses, [rad]."""
        require_types((other, Pose))
        relative = self.rotation.T @ other.rotation
        return float(np.linalg.norm(rotation_vector_from_matrix(relative)))

    def distance_to(self, other: Pose) -> float:
        """Distance of the origins, [m]."""
        require_types((other, Pose))
        return float(np.linalg.norm(other.position - self.position))


def interpolate(start: Pose, end: Pose, fraction: float) -> Pose:
    """Pose between two poses: straight line and constant-axis rotation.

    Args:
        start: Pose at fraction 0.
        end: Pose at fraction 1.
        fraction: Between 0 and 1.
    """
    position = start.position + fraction * (end.position - start.position)
    turn = rotation_vector_from_matrix(start.rotation.T @ end.rotation)
    if not turn.any():
        return Pose(position, start.rotation)
    return Pose(position, start.rotation @ matrix_from_rotation_vector(fraction * turn))


def moved(pose: Pose, step: Array) -> Pose:
    """The pose after a shift [m] and rotation [rad] along the outer frame's axes, shape (6,)."""
    return Pose(pose.position + step[:3], matrix_from_rotation_vector(step[3:]) @ pose.rotation)


def step_between(before: Pose, after: Pose) -> Array:
    """Shift [m] and rotation [rad] along the outer frame's axes, shape (6,); inverts `moved`."""
    turn = rotation_vector_from_matrix(after.rotation @ before.rotation.T)
    return np.concatenate([after.position - before.position, turn])


# Limits on the platform's tilt and turn, exact along whole moves.


_AT_LIMIT = 3e-6
"""Tolerance of a limit, [rad]: six decimals of a quaternion in a file round by up to 2e-6."""


@dataclass(frozen=True, slots=True)
class RotationLimits:
    """The orientations that a scene allows, measured from the level, unrotated platform.

    Attributes:
        tilt: Largest angle between the platform's z axis and the vertical, [rad]; π for any.
        turn: Largest turn about the vertical, in either direction, [rad]; π for any.
    """

    tilt: float
    turn: float

    def excess(self, start: Pose, end: Pose) -> Excess | None:
        """The limit that a straight move between two poses exceeds; None where it keeps both."""
        tilt, turn = largest_rotations(start.quaternion, end.quaternion)
        if not tilt <= self.tilt + _AT_LIMIT:
            return Excess("tilted", tilt, self.tilt)
        if not turn <= self.turn + _AT_LIMIT:
            return Excess("rotated", turn, self.turn)
        return None


@dataclass(frozen=True, slots=True)
class Excess:
    """A rotation limit that a move exceeds.

    Attributes:
        how: "tilted" or "rotated".
        measured: Largest value on the move, [rad].
        limit: Limit of the scene, [rad].
    """

    how: str
    measured: float
    limit: float

    def sentence(self) -> str:
        """In words, with figures."""
        measured, limit = distinct_figures(np.degrees([self.measured, self.limit]).tolist(), 4, "g")
        return f"{self.how} by {measured} deg, rotation_limits allow {limit} deg"


def largest_rotations(start: Array, end: Array) -> tuple[float, float]:
    """The largest tilt and turn on the shortest rotation between two orientations, [rad].

    Args:
        start: Unit quaternion (w, x, y, z), shape (4,).
        end: Unit quaternion (w, x, y, z), shape (4,).
    """
    first = start if start[0] >= 0.0 else -start
    last = end if float(first @ end) >= 0.0 else -end
    across = last - (first @ last) * first
    sine = float(np.linalg.norm(across))
    span = 2.0 * math.atan2(sine, float(first @ last))  # of the angle that x² + y² depends on
    squares = [float(q[1] ** 2 + q[2] ** 2) for q in (first, last)]
    if sine > 0.0:
        across = across / sine
        mean = (squares[0] + float(across[1] ** 2 + across[2] ** 2)) / 2.0
        cosine_part, sine_part = squares[0] - mean, float(first[1:3] @ across[1:3])
        if 0.0 <= math.atan2(sine_part, cosine_part) % (2.0 * math.pi) <= span:
            squares.append(mean + math.hypot(cosine_part, sine_part))
    tilt = 2.0 * math.asin(min(math.sqrt(max(squares)), 1.0))
    if last[0] <= 0.0:
        return tilt, math.pi
    return tilt, max(2.0 * math.atan2(abs(float(q[3])), float(q[0])) for q in (first, last))
