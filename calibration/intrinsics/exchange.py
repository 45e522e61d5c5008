"""Camera files of other programs: OpenCV's YAML and ROS's camera_info, written and read.

Neither holds how sure its numbers are. Both count a pixel's middle as whole, as rig files do.

Source: OpenCV, samples/cpp/calibration.cpp (keys); ROS, sensor_msgs/CameraInfo and
camera_calibration_parsers (keys, models plumb_bob, rational_polynomial, equidistant).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import yaml
from pydantic import ValidationError

from calibration.intrinsics.result import camera_named, with_camera
from model.errors import BadInput
from model.files.documents import FISHEYE, read_text, read_yaml, write_atomic
from model.files.rig_file import CameraDocument, RigDocument
from model.files.validation import YamlSyntaxError, parse_yaml
from model.rig import Rig, rig_from_document

_ROS_MODELS = {"plumb_bob": ("pinhole", 5), "rational_polynomial": ("pinhole", 8)}
_ROS_FISHEYE = ("equidistant", "fisheye")
_TEXT_LIMIT = 1_000_000
_STORED = (
    "fisheye_model",
    "image_width",
    "image_height",
    "camera_matrix",
    "distortion_coefficients",
)
_KEYS = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "distortion", "lens")


def opencv_text(camera: CameraDocument) -> str:
    """The file that OpenCV's calibration sample writes, with ``fisheye_model`` 0 or 1."""
    storage = cv2.FileStorage(".yml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    storage.write("image_width", camera.width_px)
    storage.write("image_height", camera.height_px)
    storage.write("fisheye_model", int(camera.lens == FISHEYE))
    storage.write("camera_matrix", _matrix(camera))
    lens = camera.distortion or [0.0] * 5
    storage.write("distortion_coefficients", np.array(lens, dtype=np.float64).reshape(-1, 1))
    return str(storage.releaseAndGetString())


def ros_text(camera: CameraDocument) -> str:
    """The YAML form of a ROS camera_info message.

    Raises:
        BadInput: ROS has no model with that number of coefficients.
    """
    lens = [*camera.distortion, *([0.0] * (5 - len(camera.distortion)))]
    if camera.lens == FISHEYE:
        model, lens = _ROS_FISHEYE[0], list(camera.distortion)
    elif len(lens) in (5, 8):
        model = next(name for name, (_, count) in _ROS_MODELS.items() if count == len(lens))
    else:
        raise BadInput(
            f"ROS has no lens model with {len(lens)} coefficients",
            where=f"camera {camera.name}",
            next_step="calibrate it with --lens rational or fisheye, or use --to opencv",
        )
    matrix = _matrix(camera)
    return yaml.safe_dump(
        {
            "image_width": camera.width_px,
            "image_height": camera.height_px,
            "camera_name": camera.name,
            "camera_matrix": _ros_matrix(matrix),
            "distortion_model": model,
            "distortion_coefficients": _ros_matrix(np.array([lens])),
            "rectification_matrix": _ros_matrix(np.eye(3)),
            "projection_matrix": _ros_matrix(np.column_stack([matrix, np.zeros(3)])),
        },
        sort_keys=False,
        default_flow_style=None,
    )


FORMATS: dict[str, Callable[[CameraDocument], str]] = {"opencv": opencv_text, "ros": ros_text}
"""What writes a camera's numbers, by the name of the format."""


def imported_camera(path: Path, camera: CameraDocument) -> CameraDocument:
    """A camera with the numbers of an OpenCV or ROS file, distinguished by their content.

    Args:
        path: The file.
        camera: Its name, pose and rate are kept.

    Raises:
        BadInput: The file cannot be read, is neither, or its numbers cannot be.
    """
    text = read_text(path, _TEXT_LIMIT).lstrip()
    if text.startswith("<?xml"):
        found = _from_opencv(_xml_storage(text, path), path)
    elif text.startswith("%YAML"):
        found = _from_opencv(_yaml_storage(text, path), path)
    else:
        found = _from_ros(read_yaml(path).data, path)
    plain = camera.model_dump(mode="json") | found
    try:
        return CameraDocument.model_validate(plain)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise _unusable(path, f"{key}: {first['msg']}") from None


def with_imported_camera(rig: Rig, name: str, path: Path) -> RigDocument:
    """A rig file's content with the numbers of an OpenCV or ROS file for one of its cameras.

    Raises:
        BadInput: As of `imported_camera`, or the rig has no such camera.
    """
    document = with_camera(rig.document, imported_camera(path, camera_named(rig.document, name)))
    rig_from_document(document)
    return document


def write_rig_with_camera(output: Path, rig: Rig, name: str, path: Path) -> CameraDocument:
    """Writes a new rig file with the camera of an OpenCV or ROS file; returns the camera.

    Raises:
        BadInput: As of `with_imported_camera`, or ``output`` exists or cannot be written.
    """
    if output.exists():
        raise BadInput(
            "the file exists already",
            where=str(output),
            why="a rig file is never replaced by a calibration",
            next_step="choose a name that does not exist yet",
        )
    document = with_imported_camera(rig, name, path)
    plain = document.model_dump(mode="json", exclude_unset=True)
    body = yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, default_flow_style=None)
    head = f"# {rig.name} with camera {name} of {path.name}; written by `cdpr calibrate import`"
    write_atomic(output, f"{head}\n{body}")
    return camera_named(document, name)


def _matrix(camera: CameraDocument) -> np.ndarray[Any, Any]:
    return np.array(
        [
            [camera.fx_px, 0.0, camera.cx_px],
            [0.0, camera.fy_px, camera.cy_px],
            [0.0, 0.0, 1.0],
        ]
    )


def _ros_matrix(values: np.ndarray[Any, Any]) -> dict[str, Any]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": [float(x) for x in values.ravel()]}


# OpenCV's own reader of its files ends the program at some damaged ones: these two take what a
# camera needs of them.


def _yaml_storage(text: str, path: Path) -> dict[str, Any]:
    """The entries of an OpenCV file in YAML that a camera needs."""
    entries = re.split(r"^(?=[A-Za-z_])", text, flags=re.MULTILINE)
    needed = [one for one in entries if one.partition(":")[0].rstrip() in _STORED]
    try:
        plain = parse_yaml("".join(needed).replace("!!opencv-matrix", "")).data
    except YamlSyntaxError as error:
        raise _unusable(path, error.what) from None
    return plain or {}


def _xml_storage(text: str, path: Path) -> dict[str, Any]:
    """The same of one in XML."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # OpenCV writes none; entities can grow at will
        raise _unusable(path, "it declares a document type, which OpenCV's files do not")
    try:
        root = ElementTree.fromstring(text)
        found: dict[str, Any] = {one.tag: one for one in root if one.tag in _STORED}
        for name, node in found.items():
            data = node.findtext("data")
            found[name] = int(node.text or "") if data is None else {"data": data.split()}
    except (ElementTree.ParseError, ValueError) as error:
        raise _unusable(path, str(error)) from None
    return found


def _from_opencv(plain: Mapping[str, Any], path: Path) -> dict[str, Any]:
    missing = [name for name in _STORED[1:] if name not in plain]
    if missing:
        raise _unusable(path, f"its {missing[0]} is missing")
    kind = "fisheye" if plain.get(_STORED[0]) == 1 else "pinhole"
    width, height, matrix, lens = (plain[name] for name in _STORED[1:])
    return _numbers(path, width, height, matrix, lens, kind)


def _data(matrix: object, path: Path) -> np.ndarray[Any, Any]:
    """The numbers of a matrix as OpenCV and ROS store it."""
    try:
        return np.array(matrix["data"], dtype=np.float64)  # type: ignore[index]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise _unusable(path, f"{type(error).__name__}: {error}") from None


def _from_ros(plain: object, path: Path) -> dict[str, Any]:
    if not isinstance(plain, Mapping):
        raise _unusable(path, "it is neither OpenCV's YAML nor a ROS camera_info")
    try:
        model = plain["distortion_model"]
        matrix, lens = plain["camera_matrix"], plain["distortion_coefficients"]
        width, height = plain["image_width"], plain["image_height"]
    except KeyError as error:
        raise _unusable(path, f"its {error.args[0]} is missing") from None
    if model not in (*_ROS_MODELS, *_ROS_FISHEYE):
        raise _unusable(path, f"its distortion_model {model!r} is not known")
    kind = "fisheye" if model in _ROS_FISHEYE else "pinhole"
    return _numbers(path, width, height, matrix, lens, kind)


def _numbers(
    path: Path, width: object, height: object, matrix: object, lens: object, kind: str
) -> dict[str, Any]:
    """The keys of the rig file's ``cameras``."""
    flat, coefficients = _data(matrix, path).ravel(), _data(lens, path).ravel()
    if flat.size != 9:
        raise _unusable(path, "camera_matrix is not 3 x 3")
    if abs(flat[1]) > 1e-9:
        raise _unusable(path, "camera_matrix has a skew, which rig files have no key for")
    values = (width, height, flat[0], flat[4], flat[2], flat[5], coefficients.tolist(), kind)
    return dict(zip(_KEYS, (_plain(value) for value in values), strict=True))


def _plain(value: Any) -> Any:
    return float(value) if isinstance(value, np.floating) else value


def _unusable(path: Path, why: str) -> BadInput:
    return BadInput(
        "no camera can be read from this file",
        where=str(path),
        why=why,
        next_step="name a camera file of OpenCV (YAML, XML) or ROS (camera_info)",
    )
