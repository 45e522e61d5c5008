"""Images as rotated cameras store them."""

from __future__ import annotations

import struct

import cv2
import numpy as np


def rotated_by_exif(image: np.ndarray) -> bytes:
    """A JPEG with pixels rotated by 90° and the EXIF orientation 6."""
    return jpeg(np.ascontiguousarray(np.rot90(image)), 6)  # anticlockwise, shown rotated back


def jpeg(image: np.ndarray, orientation: int) -> bytes:
    """A JPEG with an EXIF orientation."""
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    entry = struct.pack(">HHIHH", 0x0112, 3, 1, orientation, 0)
    tiff = b"MM\x00\x2a" + struct.pack(">IH", 8, 1) + entry + struct.pack(">I", 0)
    body = b"Exif\x00\x00" + tiff
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:]
