"""Result file and report of a camera's matrix and lens distortion.

The report's figures show coverage, pixel uncertainty and corner errors.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from datetime import date
from html import escape
from typing import Annotated, ClassVar, Literal, Self

import cv2
import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from calibration.intrinsics.calibrate import CameraCalibration
from calibration.intrinsics.quality import (
    CameraQuality,
    corner_errors,
    image_grid,
    pixel_uncertainty,
)
from calibration.report import Section, drawing, interval_rows, page_of, table_of
from calibration.results import ResultDocument, common_keys
from calibration.targets.boards import DetectedBoard
from model.errors import BadInput
from model.files.camera_file import CameraDocument, LensCovariance, LensName
from model.files.documents import AnyNonNegative, AnyNumber, Positive
from model.files.rig_file import RigDocument
from model.pose import Array, rotation_vector_from_matrix
from tracking.camera_model import project, rays_of, rms

_WIDTH = 560.0
_MOST_ARROWS = 1500
"""More arrows overlap and make the page slow."""
_LONGEST = 0.04
"""Length of the arrow of the median error, as a share of the figure's width."""
_MAP = (16, 10)
"""Columns and rows of the map of uncertainty."""
_RINGS = 12


def coverage_map(result: CameraCalibration, quality: CameraQuality) -> str:
    """Figure of all detected corners, on cells shaded by their number of corners."""
    width, height = result.size
    scale = _WIDTH / width
    columns, rows = quality.coverage.shape
    most = max(float(quality.coverage.max()), 1.0)
    shapes = []
    for (i, j), count in np.ndenumerate(quality.coverage):
        shade = 0.0 if count == 0 else 0.15 + 0.45 * float(count) / most
        shapes.append(
            f'<rect x="{i * _WIDTH / columns:.1f}" y="{j * height * scale / rows:.1f}"'
            f' width="{_WIDTH / columns:.1f}" height="{height * scale / rows:.1f}"'
            f' fill="var(--encoder)" fill-opacity="{shade:.2f}" stroke="var(--line)"/>'
        )
    for seen in result.views.values():
        shapes += [
            f'<circle cx="{x * scale:.1f}" cy="{y * scale:.1f}" r="1.4" fill="var(--ink)"/>'
            for x, y in seen.corners
        ]
    label = f"Corners in the camera's image, in {quality.covered:.0%} of its cells."
    return drawing("".join(shapes), (_WIDTH, height * scale), label)


def tilt_figure(quality: CameraQuality) -> str:
    """Figure of the board's tilt in each image, about both axes, ± 50°."""
    dots = "".join(
        f'<circle cx="{140 + 2.4 * np.clip(y, -50, 50):.1f}"'
        f' cy="{140 - 2.4 * np.clip(x, -50, 50):.1f}" r="4" fill="var(--ink)"/>'
        for x, y in quality.tilts
    )
    rings = "".join(
        f'<circle cx="140" cy="140" r="{2.4 * ring}" fill="none" stroke="var(--muted)"/>'
        f'<text x="{144 + 2.4 * ring}" y="137">{ring}°</text>'
        for ring in (20, 40)
    )
    label = f"Tilt of the board in {len(quality.tilts)} images; rings at 20° and 40°."
    return drawing(rings + dots, (280, 280), label, "small")


def uncertainty_figure(result: CameraCalibration, quality: CameraQuality) -> str:
    """Map of the half widths of pixels' 95 % intervals, labelled in every third cell."""
    (width, height), (columns, rows) = result.size, _MAP
    scale = _WIDTH / width
    across = (np.arange(columns) + 0.5) / columns * width
    down = (np.arange(rows) + 0.5) / rows * height
    pixels = np.array([(x, y) for y in down for x in across])
    found = pixel_uncertainty(result, pixels)
    least, most = float(np.nanmin(found)), float(np.nanmax(found))  # NaN where no ray is
    cell = (_WIDTH / columns, height * scale / rows)
    focal = float(np.sqrt(result.matrix[0, 0] * result.matrix[1, 1]))
    shapes = []
    for k, (value, (x, y)) in enumerate(zip(found, pixels * scale, strict=True)):
        if np.isnan(value):
            continue
        shade = 0.05 + 0.7 * float(np.sqrt(value / max(most, 1e-12)))
        shapes.append(
            f'<rect x="{x - cell[0] / 2:.1f}" y="{y - cell[1] / 2:.1f}" width="{cell[0]:.1f}"'
            f' height="{cell[1]:.1f}" fill="var(--limit)" fill-opacity="{shade:.2f}"/>'
        )
        if (k // columns) % 3 == 0 and (k % columns) % 3 == 0:
            shapes.append(
                f'<text x="{x:.1f}" y="{y + 4:.1f}" text-anchor="middle">{value:.2g}</text>'
            )
    at = quality.distance / focal * 1e3
    label = (
        f"Uncertainty of pixels over the image, {least:.2g} to {most:.2g} px, which are"
        f" {least * at:.2g} to {most * at:.2g} mm at {quality.distance:.2g} m."
    )
    return drawing("".join(shapes), (_WIDTH, height * scale), label) + _caption(label)


def residual_arrows(result: CameraCalibration) -> str:
    """Figure of the corner errors of all images, magnified."""
    corners, errors = corner_errors(result)
    every = -(-len(corners) // _MOST_ARROWS)
    scale = _WIDTH / result.size[0]
    usual = float(np.median(np.linalg.norm(errors, axis=1)))
    by = _LONGEST * _WIDTH / max(usual, 1e-9)
    shapes = _arrows((corners - errors)[::every] * scale, errors[::every] * by)
    label = f"Errors of corners, {by / scale:.3g} times as long; half are above {usual:.2g} px."
    return drawing(shapes, (_WIDTH, result.size[1] * scale), label) + _caption(label)


def _caption(text: str) -> str:
    return f'<p class="quiet">{escape(text)}</p>'


def _arrows(begins: Array, offsets: Array) -> str:
    """Lines with a dot at their start; both in figure coordinates, shape (n, 2)."""
    return "".join(
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x + dx:.1f}" y2="{y + dy:.1f}"'
        f' stroke="var(--ink)"/><circle cx="{x:.1f}" cy="{y:.1f}" r="1" fill="var(--limit)"/>'
        for (x, y), (dx, dy) in zip(begins, offsets, strict=True)
    )


def radial_pattern(result: CameraCalibration) -> str:
    """Mean radial error in rings around the principal point, with its 95 % interval."""
    corners, errors = corner_errors(result)
    away = corners - result.matrix[:2, 2]
    distance = np.linalg.norm(away, axis=1)
    radial = np.sum(errors * away, axis=1) / np.maximum(distance, 1e-9)
    order = np.argsort(distance)
    rings = [part for part in np.array_split(order, _RINGS) if len(part) > 1]
    means = np.array([radial[part].mean() for part in rings])
    doubts = np.array([1.96 * radial[part].std(ddof=1) / np.sqrt(len(part)) for part in rings])
    radii = np.array([distance[part].mean() for part in rings])
    top = max(float(np.max(np.abs(means) + doubts)), 1e-9)
    x = 80.0 + (_WIDTH - 100.0) * radii / float(distance.max())
    y, spread = 110.0 - 90.0 * means / top, 90.0 * doubts / top
    shapes = f'<line x1="80" y1="110" x2="{_WIDTH:.0f}" y2="110" stroke="var(--muted)"/>'
    for value, at in ((top, 24), (0.0, 114), (-top, 204)):
        shapes += f'<text x="74" y="{at}" text-anchor="end">{value:+.2g} px</text>'
    shapes += "".join(
        f'<line x1="{a:.1f}" y1="{b - c:.1f}" x2="{a:.1f}" y2="{b + c:.1f}" stroke="var(--muted)"/>'
        f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3.5" fill="var(--ink)"/>'
        for a, b, c in zip(x, y, spread, strict=True)
    )
    last = f"{distance.max():.0f} px"
    shapes += f'<text x="{_WIDTH - 4:.0f}" y="226" text-anchor="end">radius up to {last}</text>'
    label = f"Mean radial error by radius up to {last}, at most {np.abs(means).max():.2g} px."
    return drawing(shapes, (_WIDTH, 232.0), label)


def worst_image(result: CameraCalibration) -> Sequence[Section]:
    """The image with the largest error and the fitted board; empty without images."""
    name = max(result.view_errors, key=lambda key: result.view_errors[key])
    image = result.previews.get(name)
    if image is None:
        return []
    scale = _WIDTH / result.size[0]
    size = (_WIDTH, result.size[1] * scale)
    seen, pose = result.views[name], result.boards[name]
    turn = rotation_vector_from_matrix(pose.rotation)
    there = result.lens.slopes(seen.points, turn, pose.position, result.matrix, result.distortion)[
        0
    ]
    data = base64.b64encode(cv2.imencode(".jpg", image)[1].tobytes()).decode()
    area = f'width="{size[0]:.0f}" height="{size[1]:.1f}"'
    shapes = f'<image href="data:image/jpeg;base64,{data}" {area}/>'
    projected = there * scale
    for a, b in _neighbours(seen):
        (x1, y1), (x2, y2) = projected[a], projected[b]
        shapes += (
            f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"'
            ' stroke="var(--encoder)" stroke-opacity="0.8"/>'
        )
    errors = seen.corners - there
    usual = float(np.median(np.linalg.norm(errors, axis=1)))
    by = _LONGEST * _WIDTH / max(usual, 1e-9)
    shapes += "".join(
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x + dx:.1f}" y2="{y + dy:.1f}"'
        ' stroke="var(--limit)" stroke-width="1.5"/>'
        for (x, y), (dx, dy) in zip(projected, errors * by, strict=True)
    )
    label = (
        f"{name}: {result.view_errors[name]:.2f} px; the fitted board, and errors drawn"
        f" {by / scale:.3g} times as long."
    )
    return [Section("The worst image", drawing(shapes, size, label), label)]


def _neighbours(seen: DetectedBoard) -> list[tuple[int, int]]:
    """Pairs of neighbouring points of a board."""
    gaps = np.linalg.norm(seen.points[:, None] - seen.points[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    near = gaps < 1.05 * np.median(gaps.min(axis=1))
    return [(int(a), int(b)) for a, b in np.argwhere(np.triu(near))]


# Result file.


Pixels = Annotated[int, Field(ge=1, le=16384)]


class CameraResult(ResultDocument):
    """A camera's matrix and distortion, in the keys of the rig file's ``cameras`` section."""

    order: ClassVar[int] = 0

    kind: Literal["camera"] = "camera"
    width_px: Pixels
    height_px: Pixels
    fx_px: Positive
    fy_px: Positive
    cx_px: AnyNumber
    cy_px: AnyNumber
    distortion: list[AnyNumber]
    lens: LensName = "pinhole"
    lens_covariance: LensCovariance | None = Field(
        default=None, description="of fx_px, fy_px, cx_px, cy_px and distortion"
    )
    rms_px: AnyNonNegative
    distance_m: Positive = Field(description="for which error_mm is stated")
    halves_apart_mm: AnyNonNegative = Field(
        description="difference between two halves of the images"
    )
    covered: AnyNonNegative = Field(description="share of the image covered by the board")
    pictures_used: int
    view_errors_px: dict[str, AnyNonNegative]

    @property
    def matrix(self) -> Array:
        """Camera matrix, shape (3, 3), [px]."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    def apart_mm(self, other: Self) -> float:
        """RMS distance over the image between points at the stated distance by both, [mm].

        Like ``error_mm`` it is from pixels. A rotation between both cameras is removed: the
        extrinsics compensate for it.

        Raises:
            BadInput: The images are of different sizes.
        """
        size = (self.width_px, self.height_px)
        if size != (other.width_px, other.height_px):
            raise BadInput(
                f"one camera's images have {size[0]} x {size[1]} px, the other's"
                f" {other.width_px} x {other.height_px} px",
                next_step="compare results for one image size",
            )
        flat = [
            rays_of(r.lens, r.matrix, np.array(r.distortion), image_grid(size))
            for r in (self, other)
        ]
        rays = [np.column_stack([part, np.ones(len(part))]) for part in flat]
        units = [part / np.linalg.norm(part, axis=1, keepdims=True) for part in rays]
        turn = Rotation.align_vectors(units[0], units[1])[0].as_matrix()
        own, others = (
            project(self.lens, self.matrix, np.array(self.distortion), points)
            for points in (rays[0], rays[1] @ turn.T)
        )
        pixels = rms(others - own)
        return float(pixels / np.sqrt(self.fx_px * self.fy_px)) * self.distance_m * 1e3

    def corrected(self, rig: RigDocument) -> RigDocument:
        """The rig file's content with this camera's parameters.

        With another lens, the errors stated for the former one are left out: the pose's and the
        operator's ``error_mm``.

        Raises:
            BadInput: The rig has no camera of this name, or one of another size.
        """
        camera = camera_named(rig, self.name)
        if (camera.width_px, camera.height_px) != (self.width_px, self.height_px):
            raise BadInput(
                f"this result is for images of {self.width_px} x {self.height_px} px, camera"
                f" {self.name!r} takes {camera.width_px} x {camera.height_px} px",
                where=f"calibration {self.kind} {self.name}, {self.date}",
                next_step="calibrate the camera at the image size in use",
            )
        keys = ("fx_px", "fy_px", "cx_px", "cy_px", "distortion", "lens", "lens_covariance")
        lens = {k: getattr(self, k) for k in keys}
        if all(getattr(camera, key) == value for key, value in lens.items()):
            return rig
        left_out = dict.fromkeys(("pose_by_lens", "pose_covariance", "error_mm"))
        return with_camera(rig, camera.model_copy(update=lens | left_out))


def camera_result(
    result: CameraCalibration, quality: CameraQuality, name: str, on: date
) -> CameraResult:
    """The result file's content.

    Args:
        name: Of the camera in the rig file.
    """
    m, verdict, unused = result.matrix, quality.verdict, _left_out(result)
    return CameraResult(
        **common_keys(name, on, result.data_hash, result.intervals, verdict, unused),
        width_px=result.size[0],
        height_px=result.size[1],
        fx_px=float(m[0, 0]),
        fy_px=float(m[1, 1]),
        cx_px=float(m[0, 2]),
        cy_px=float(m[1, 2]),
        distortion=[float(x) for x in result.distortion],
        lens=result.lens.kind,
        lens_covariance=result.uncertainty.stated_covariance.tolist(),
        rms_px=result.error,
        distance_m=quality.distance,
        halves_apart_mm=quality.halves * 1e3,
        covered=quality.covered,
        pictures_used=len(result.views),
        view_errors_px={k: float(v) for k, v in result.view_errors.items()},
    )


def camera_named(rig: RigDocument, name: str) -> CameraDocument:
    """The camera of a name in a rig file.

    Raises:
        BadInput: There is none of this name; the existing names are listed.
    """
    for camera in rig.cameras:
        if camera.name == name:
            return camera
    names = ", ".join(camera.name for camera in rig.cameras) or "none"
    raise BadInput(
        f"unknown camera {name!r}",
        where=f"rig {rig.name}",
        why=f"the rig's cameras: {names}",
        next_step="name one of them, or add the camera to the rig file",
    )


def with_camera(rig: RigDocument, changed: CameraDocument) -> RigDocument:
    """The rig file's content with the camera of the same name replaced."""
    cameras = [changed if camera.name == changed.name else camera for camera in rig.cameras]
    return rig.model_copy(update={"cameras": cameras})


def _left_out(result: CameraCalibration) -> dict[str, str]:
    """Why images, and markers in the images used, are not used, by name."""
    again = "is detected more than once"
    twice = {f"{name}, {k}": again for name, seen in result.views.items() for k in seen.twice}
    return {**result.unused, **twice}


# Report.


def camera_page(result: CameraCalibration, quality: CameraQuality, name: str, date: str) -> str:
    """The report page."""
    lead = (
        f"{date}, {result.size[0]} × {result.size[1]} px, {len(result.views)} images used,"
        f" {len(result.unused)} not"
    )
    covered = f"{quality.covered:.0%} of the image's cells contain corners"
    tilted = "One dot per image: forward and backward tilt vertically, left and right horizontally."
    sure = (
        "Half widths of the 95 % intervals of points seen there, without a common rotation of the"
        " camera."
    )
    arrows = "From the expected towards the detected corner."
    along = (
        "Mean error away from the principal point, in rings of equal numbers of corners; bars are"
        " 95 % intervals of the mean. With the right lens model it is zero."
    )
    used = "Error, corners, and change of fx without the image."
    return page_of(
        f"Calibration of camera {name}",
        lead,
        quality.verdict,
        [
            Section("Parameters, with 95 % intervals", _numbers(result, quality)),
            Section("Where the board was seen", coverage_map(result, quality), covered),
            Section("Uncertainty of pixels", uncertainty_figure(result, quality), sure),
            Section("Errors of corners", residual_arrows(result), arrows),
            Section("Radial errors", radial_pattern(result), along),
            *worst_image(result),
            Section("Tilt of the board", tilt_figure(quality), tilted),
            Section("Images used", _image_table(result), used),
            Section("Images not used", table_of(_left_out(result).items())),
        ],
    )


def _numbers(result: CameraCalibration, quality: CameraQuality) -> str:
    verdict = quality.verdict
    return table_of(
        [
            *interval_rows(result.intervals),
            ("lens model", f"{result.lens.name}, radial share of errors {quality.radial:.0%}"),
            ("reprojection error, RMS", f"{result.error:.3f} px"),
            (f"a point {verdict.where}", f"within {verdict.error * 1e3:.2g} mm (95 %)"),
            ("board distance", f"{quality.nearest:.3g} to {quality.farthest:.3g} m"),
            ("two halves of the images", f"{quality.halves * 1e3:.2g} mm apart there"),
            ("bow of the board", f"{quality.bow * 1e3:.2g} mm, {quality.bent:.0%} of the errors"),
            ("data", result.data_hash[:23]),
        ]
    )


def _image_table(result: CameraCalibration) -> str:
    """Table with the error of each image and its influence on the focal length."""
    change = result.uncertainty.without[:, 0]
    rows = [
        (name, f"{error:.3f} px", f"{len(seen.corners)}", f"{without:+z.2f} px")
        for (name, error), seen, without in zip(
            result.view_errors.items(), result.views.values(), change, strict=True
        )
    ]
    return table_of(rows, ("image", "error, RMS", "corners", "fx without it"))
