"""Reads our PDF pages back from the operators of their content streams."""

from __future__ import annotations

import re

import numpy as np

from calibration.targets.printing import POINTS_A_MM
from model.pose import Array


def pages_in(data: bytes) -> list[tuple[Array, Array, list[str]]]:
    """Of every page: size [mm], shape (2,); black rectangles in mm from the top left; texts."""
    found = []
    boxes = re.findall(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", data)
    streams = re.findall(rb"stream\n(.*?)\nendstream", data, re.DOTALL)
    for box, stream in zip(boxes, streams, strict=True):
        size = np.array([float(x) for x in box]) / POINTS_A_MM
        text = stream.decode()
        a, b, c, d, e, f = map(float, re.search(r"([-\d. ]+) cm", text).group(1).split())
        assert b == c == e == 0.0
        sizes = np.array([[float(x) for x in m.split()] for m in re.findall(r"(.+) re", text)])
        left, top = sizes[:, 0] * a, size[1] * POINTS_A_MM - (sizes[:, 1] * d + f)
        rectangles = np.column_stack([left, top, sizes[:, 2] * a, -sizes[:, 3] * d]) / POINTS_A_MM
        found.append((size, rectangles, re.findall(r"\((.*)\) Tj", text)))
    return found


def discs_in(data: bytes) -> Array:
    """Centre and radius of the discs of a file's first page, mm from the top left, shape (n, 3).

    A disc is four curves from its rightmost point; their ends are opposite points of it.
    """
    text = re.search(rb"stream\n(.*?)\nendstream", data, re.DOTALL).group(1).decode()
    number = r"[-\d.]+"
    found = []
    for disc in re.findall(rf"{number} {number} m\n(?:.* c\n){{4}}", text):
        ends = np.array([[float(x) for x in line.split()[-3:-1]] for line in disc.splitlines()[1:]])
        low, high = ends.min(axis=0), ends.max(axis=0)
        found.append([*(low + high) / 2.0, (high - low).mean() / 2.0])
    return np.array(found)


def drawn(size_mm: Array, rectangles: Array, per_mm: float) -> np.ndarray:
    """A grey image of a page, ink 20 and paper 235."""
    width, height = np.round(size_mm * per_mm).astype(int)
    picture = np.full((height, width), 235, np.uint8)
    for x, y, w, h in rectangles * per_mm:
        picture[round(y) : round(y + h), round(x) : round(x + w)] = 20
    return picture
