"""Pictures and parts of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cdpr.errors import BadInput
from cdpr.rig import Camera

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Region:
    """A rectangle of pixels, right and bottom not included."""

    left: int
    top: int
    right: int
    bottom: int


def refuse_wrong_picture(image: Image, camera: Camera, rig: str) -> None:
    """A picture of another kind than the camera was calibrated for would measure wrongly.

    Args:
        image: The picture.
        camera: Whose it should be.
        rig: Name of the rig that has it.

    Raises:
        BadInput: It is not a grey one of 8 bits, or not of the camera's size.
    """
    wanted = (camera.height, camera.width)
    if image.shape != wanted or image.dtype != np.uint8:
        size = " x ".join(map(str, image.shape[1::-1] if image.ndim > 1 else image.shape))
        raise BadInput(
            f"a picture has {size} px ({image.dtype}, {image.ndim} dimensions); camera"
            f" {camera.name!r} takes grey 8-bit pictures of {wanted[1]} x {wanted[0]} px",
            where=f"rig {rig}",
            next_step="use pictures of this camera in full size, or mend the rig file",
        )
