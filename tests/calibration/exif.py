"""Images as rotated cameras store them."""

from __future__ import annotations

import struct

import cv2
import numpy as np


def rotated_by_exif(image: np.ndarray) -> bytes:
    """A JPEG with pixels rotated by 90° and the EXIF orientation 6."""
    rotated = np.ascontiguousarray(np.rot90(image))  # stored anticlockwise, shown rotated back
    data = cv2.imencode(".jpg", rotated, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    entry = struct.pack(">HHIHH", 0x0112, 3, 1, 6, 0)
    tiff = b"MM\x00\x2a" + struct.pack(">IH", 8, 1) + entry + struct.pack(">I", 0)
    body = b"Exif\x00\x00" + tiff
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:]
