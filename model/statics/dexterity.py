"""Dexterity: how evenly the cables turn tensions into wrenches."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.errors import BadInput
from model.statics.wrench_sets import WRENCH_SIZE, checked_structure_matrix, with_scaled_moments


def condition_number(
    structure_matrix: ArrayLike, characteristic_length: float
) -> NDArray[np.float64]:
    """Return the condition number of the structure matrix, 1 at best.

    Forces and moments have different units, so the number means something only together with
    the length that the moments are divided by; hence no default.

    Args:
        structure_matrix: shape (..., 6, m); force rows [-], moment rows [m].
        characteristic_length: [m]; `rms_anchor_radius` gives the usual one.

    Returns:
        σ_max / σ_min, shape (...); infinite where the matrix has no full rank.

    Raises:
        BadInput: A shape is wrong, a value is not finite, or the length is not positive.

    Source: Xu & Park, Eq. 4, with the ratio as the singular values of a 6×m matrix need it.
    """
    matrix = checked_structure_matrix(structure_matrix)
    scaled = with_scaled_moments(matrix, characteristic_length)
    if matrix.shape[-1] < WRENCH_SIZE:
        return np.full(matrix.shape[:-2], np.inf)
    singular_values = np.linalg.svd(scaled, compute_uv=False)
    largest, smallest = singular_values[..., 0], singular_values[..., -1]
    round_off = np.finfo(np.float64).eps * matrix.shape[-1] * largest
    ratio = np.full(matrix.shape[:-2], np.inf)
    np.divide(largest, smallest, out=ratio, where=smallest > round_off)
    return ratio


def rms_anchor_radius(anchors_in_platform: ArrayLike) -> float:
    """Return the root mean square distance of the anchors from the platform origin.

    Args:
        anchors_in_platform: shape (m, 3), [m], platform frame.

    Returns:
        The radius [m], the usual characteristic length.

    Raises:
        BadInput: The shape is another one, or a value is not finite.
    """
    anchors = np.asarray(anchors_in_platform, dtype=np.float64)
    if anchors.ndim != 2 or anchors.shape[1] != 3 or len(anchors) == 0:
        raise BadInput(f"the anchors have shape {anchors.shape}, not (m, 3)")
    if not np.isfinite(anchors).all():
        raise BadInput("the anchors hold a value that is not a finite number")
    return float(np.sqrt(np.mean(np.sum(anchors**2, axis=1))))
