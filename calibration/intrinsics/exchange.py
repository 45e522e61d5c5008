"""Export and import of camera files: OpenCV, ROS, Kalibr and mrcal.

None states uncertainties. All have integer coordinates at pixel centres, as rig files do.

Source: OpenCV, samples/cpp/calibration.cpp (keys); ROS, sensor_msgs/CameraInfo and
camera_calibration_parsers (keys, models plumb_bob, rational_polynomial, equidistant); Kalibr, wiki
page "yaml formats" (camchain); mrcal, "Camera model representation in memory and on disk".
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import cv2
import numpy as np
import yaml
from pydantic import ValidationError

from calibration.intrinsics.result import camera_named, with_camera
from model.errors import BadInput
from model.files.camera_file import FISHEYE, CameraDocument
from model.files.documents import read_text, read_yaml, write_atomic
from model.files.rig_file import RigDocument
from model.pose import rotation_vector_from_matrix
from model.rig import Rig, rig_from_document

_ROS_MODELS = {"plumb_bob": ("pinhole", 5), "rational_polynomial": ("pinhole", 8)}
_ROS_FISHEYE = ("equidistant", "fisheye")
_KALIBR_MODELS = {"radtan": ("pinhole", 4), "equidistant": ("fisheye", 4), "none": ("pinhole", 0)}
_MRCAL_MODELS = {
    "LENSMODEL_PINHOLE": 0,
    "LENSMODEL_OPENCV4": 4,
    "LENSMODEL_OPENCV5": 5,
    "LENSMODEL_OPENCV8": 8,
    "LENSMODEL_OPENCV12": 12,
}
_SMALL, _TEXT_LIMIT = 1_000_000, 32_000_000
"""Largest files in characters, OpenCV's and any; mrcal's may include all corners."""
_BAD_NUMBERS = (TypeError, ValueError, OverflowError, AttributeError)
"""Exceptions from values that are not numbers."""
_KEYS = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "distortion", "lens")


def opencv_text(camera: CameraDocument) -> str:
    """The file of OpenCV's calibration sample, with ``fisheye_model`` 0 or 1."""
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


def kalibr_text(camera: CameraDocument) -> str:
    """A Kalibr camchain with only this camera, ``cam0``.

    Raises:
        BadInput: Kalibr has no such lens model.
    """
    if camera.lens == FISHEYE:
        model, lens = "equidistant", list(camera.distortion)
    else:
        lens, rest = list(camera.distortion[:4]), camera.distortion[4:]
        if any(rest):
            raise BadInput(
                f"Kalibr's radtan has only k1 k2 p1 p2; this lens has {len(camera.distortion)}"
                " coefficients",
                where=f"camera {camera.name}",
                next_step="calibrate it with --lens fisheye, or use --to opencv, ros or mrcal",
            )
        model = "radtan" if lens else "none"
    entry = {
        "camera_model": "pinhole",
        "intrinsics": [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px],
        "distortion_model": model,
        "distortion_coeffs": lens,
        "resolution": [camera.width_px, camera.height_px],
        "rostopic": f"/{camera.name}/image_raw",
        "cam_overlaps": [],
    }
    return yaml.safe_dump({"cam0": entry}, sort_keys=False, default_flow_style=None)


def mrcal_text(camera: CameraDocument) -> str:
    """A mrcal ``.cameramodel``; its reference frame is the rig file's world, in metres.

    Raises:
        BadInput: mrcal has no such lens model.
    """
    lens = list(camera.distortion)
    names = {count: name for name, count in _MRCAL_MODELS.items()}
    if camera.lens == FISHEYE or len(lens) not in names:
        what = "Kannala and Brandt's fisheye" if camera.lens == FISHEYE else f"{len(lens)} of them"
        raise BadInput(
            f"mrcal has lens models with {', '.join(map(str, names))} coefficients, not {what}",
            where=f"camera {camera.name}",
            next_step="calibrate it with --lens rational, or use --to opencv or kalibr",
        )
    camera_from_world = camera.world_from_camera.pose().inverse()
    turn = rotation_vector_from_matrix(camera_from_world.rotation)
    extrinsics = [float(x) for x in (*turn, *camera_from_world.position)]
    numbers = [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *lens]
    return (
        "{\n"
        f"    'lensmodel': '{names[len(lens)]}',\n"
        f"    'intrinsics': {numbers},\n"
        f"    'extrinsics': {extrinsics},\n"
        f"    'imagersize': [{camera.width_px}, {camera.height_px}]\n"
        "}\n"
    )


FormatName = Literal["opencv", "ros", "kalibr", "mrcal"]
FORMATS: dict[FormatName, Callable[[CameraDocument], str]] = {
    "opencv": opencv_text,
    "ros": ros_text,
    "kalibr": kalibr_text,
    "mrcal": mrcal_text,
}
"""Writers of camera files, by the name of the format."""


def imported_camera(path: Path, camera: CameraDocument, entry: str | None = None) -> CameraDocument:
    """A camera with the parameters of a file in one of `FORMATS`, detected by content.

    Such files state no uncertainties: that of the lens, and of a pose found with it, is unknown.

    Args:
        path: The file.
        camera: Gives name, pose and rate.
        entry: Which camera of a Kalibr camchain, such as ``cam1``; the only one when left out.

    Raises:
        BadInput: The file cannot be read, has an unknown format, or values out of range.
    """
    unknown = dict.fromkeys(("lens_covariance", "pose_by_lens", "pose_covariance"))
    plain = camera.model_dump(mode="json") | unknown | _found(path, entry)
    try:
        return CameraDocument.model_validate(plain)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise _unusable(path, f"{key}: {first['msg']}") from None


def _found(path: Path, entry: str | None) -> dict[str, Any]:
    """Keys of the rig file's ``cameras``, from a file."""
    text = read_text(path, _TEXT_LIMIT)
    if "lensmodel" in text and _without_comments(text).startswith("{"):
        found = _from_mrcal(text, path)
    elif text.lstrip().startswith(("%YAML", "<?xml")):
        found = _from_opencv(text, path)
    else:
        plain = read_yaml(path).data
        if isinstance(plain, Mapping) and any(_is_entry(key) for key in plain):
            return _from_kalibr(plain, path, entry)
        found = _from_ros(plain, path)
    if entry is not None:
        raise _unusable(path, f"it has one camera, so {entry!r} does not exist")
    return found


def with_imported_camera(rig: Rig, name: str, path: Path, entry: str | None = None) -> RigDocument:
    """A rig file's content with the parameters of another program's file for one camera.

    Raises:
        BadInput: As in `imported_camera`, or the rig has no such camera.
    """
    own = camera_named(rig.document, name)
    document = with_camera(rig.document, imported_camera(path, own, entry))
    rig_from_document(document)
    return document


def write_rig_with_camera(
    output: Path, rig: Rig, name: str, path: Path, entry: str | None = None
) -> CameraDocument:
    """Writes a new rig file with the camera of another program's file; returns the camera.

    Raises:
        BadInput: As in `with_imported_camera`, or ``output`` exists or cannot be written.
    """
    if output.exists():
        raise BadInput(
            "the file exists already",
            where=str(output),
            why="an import never replaces a rig file",
            next_step="choose a name that does not exist yet",
        )
    document = with_imported_camera(rig, name, path, entry)
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


def _from_opencv(text: str, path: Path) -> dict[str, Any]:
    """Parses without OpenCV, whose own reader crashes on damaged files."""
    if len(text) > _SMALL:
        raise _unusable(path, f"it is longer than {_SMALL} characters")
    try:
        plain = _opencv_xml(text) if text.lstrip().startswith("<") else _opencv_yaml(text)
        width, height = int(plain["image_width"]), int(plain["image_height"])
        matrix, lens = (
            np.array(plain[key]["data"], dtype=np.float64)
            for key in ("camera_matrix", "distortion_coefficients")
        )
        is_fisheye = int(plain.get("fisheye_model", 0)) == 1
    except KeyError as error:
        raise _unusable(path, f"{error} is missing") from None
    except (*_BAD_NUMBERS, yaml.YAMLError, ElementTree.ParseError, RecursionError) as error:
        raise _unusable(path, f"{type(error).__name__}: {error}"[:200]) from None
    return _numbers(path, width, height, matrix, lens, "fisheye" if is_fisheye else "pinhole")


def _opencv_yaml(text: str) -> Mapping[str, Any]:
    body = text.lstrip().partition("\n")[2].replace("!!opencv-matrix", "")
    plain = yaml.safe_load(body)
    if not isinstance(plain, Mapping):
        raise ValueError("it has no keys")
    return plain


def _opencv_xml(text: str) -> Mapping[str, Any]:
    found: dict[str, Any] = {}
    for node in ElementTree.fromstring(text):
        data = node.find("data")
        found[node.tag] = node.text if data is None else {"data": (data.text or "").split()}
    return found


def _from_ros(plain: object, path: Path) -> dict[str, Any]:
    if not isinstance(plain, Mapping):
        raise _unusable(path, "it is not a file of OpenCV, ROS, Kalibr or mrcal")
    try:
        model = plain["distortion_model"]
        if "camera_matrix" in plain:  # a file of camera_calibration_parsers
            matrix = plain["camera_matrix"]["data"]
            lens = plain["distortion_coefficients"]["data"]
            width, height = plain["image_width"], plain["image_height"]
        else:  # a message; ROS 2 names its fields k and d
            matrix, lens = (plain[key if key in plain else key.lower()] for key in "KD")
            width, height = plain["width"], plain["height"]
            _require_whole_image(plain, path)
        matrix, lens = (np.array(each, dtype=np.float64) for each in (matrix, lens))
    except (KeyError, *_BAD_NUMBERS) as error:
        raise _unusable(path, f"{type(error).__name__}: {error}") from None
    if str(model) not in (*_ROS_MODELS, *_ROS_FISHEYE):
        raise _unusable(path, f"its distortion_model {model!r} is unknown")
    kind = "fisheye" if model in _ROS_FISHEYE else "pinhole"
    return _numbers(path, width, height, matrix, lens, kind)


def _require_whole_image(message: Mapping[Any, Any], path: Path) -> None:
    """Refuses a message for binned images, or for a part of the image."""
    roi = message.get("roi") or {}
    binned = any(message.get(key, 0) not in (0, 1) for key in ("binning_x", "binning_y"))
    if binned or roi.get("x_offset") or roi.get("y_offset"):
        raise _unusable(path, "its images are binned, or a part of the sensor's")


def _is_entry(key: object) -> bool:
    """Whether a YAML key is that of a Kalibr camera, such as ``cam0``."""
    text = str(key)
    return text.startswith("cam") and text[3:].isdecimal()


def _from_kalibr(plain: Mapping[Any, Any], path: Path, entry: str | None) -> dict[str, Any]:
    names = [str(key) for key in plain if _is_entry(key)]
    if entry is None and len(names) > 1:
        raise _unusable(path, f"it has {', '.join(names)}; choose one with --entry")
    name = entry or names[0]
    if name not in names:
        raise _unusable(path, f"it has {', '.join(names)}, but not {name!r}")
    try:
        own = plain[name]
        kind, model = own["camera_model"], own["distortion_model"]
        lens, numbers = list(own["distortion_coeffs"]), list(own["intrinsics"])
        width, height = own["resolution"]
    except (KeyError, *_BAD_NUMBERS) as error:
        raise _unusable(path, f"{name}: {type(error).__name__}: {error}") from None
    if kind != "pinhole" or str(model) not in _KALIBR_MODELS:
        why = f"{name} is {kind}-{model}; pinhole-radtan and pinhole-equi(distant) can be read"
        raise _unusable(path, why)
    ours, count = _KALIBR_MODELS[model]
    if len(lens) != count or len(numbers) != 4:
        raise _unusable(path, f"{name}: {model} has {count} coefficients and 4 intrinsics")
    return _numbers(path, width, height, _matrix_of(path, numbers), lens, ours)


def _from_mrcal(text: str, path: Path) -> dict[str, Any]:
    try:
        plain = ast.literal_eval(_without_comments(text))
        model, numbers = plain["lensmodel"], list(plain["intrinsics"])
        width, height = plain["imagersize"]
    except (KeyError, *_BAD_NUMBERS, SyntaxError, RecursionError, MemoryError) as error:
        raise _unusable(path, f"{type(error).__name__}: {error}"[:200]) from None
    if str(model) not in _MRCAL_MODELS:
        known = ", ".join(_MRCAL_MODELS)
        why = f"its lensmodel is {model!r}; mrcal-convert-lensmodel converts it to one of {known}"
        raise _unusable(path, why)
    if len(numbers) != 4 + _MRCAL_MODELS[model]:
        raise _unusable(path, f"{model} has {4 + _MRCAL_MODELS[model]} intrinsics")
    return _numbers(path, width, height, _matrix_of(path, numbers), numbers[4:], "pinhole")


def _without_comments(text: str) -> str:
    lines = (line for line in text.splitlines() if not line.lstrip().startswith("#"))
    return "\n".join(lines).strip()


def _matrix_of(path: Path, numbers: list[Any]) -> np.ndarray[Any, Any]:
    try:
        fx, fy, cx, cy = (float(number) for number in numbers[:4])
    except _BAD_NUMBERS as error:
        raise _unusable(path, f"intrinsics: {error}") from None
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _numbers(
    path: Path, width: object, height: object, matrix: object, lens: object, kind: str
) -> dict[str, Any]:
    """Keys of the rig file's ``cameras``, from parsed values."""
    try:
        numbers = np.asarray(matrix, np.float64)
        coefficients = np.ravel(np.asarray(lens, np.float64))
    except _BAD_NUMBERS as error:
        raise _unusable(path, f"distortion: {error}") from None
    if numbers.size != 9:
        raise _unusable(path, "camera_matrix is not 3 x 3")
    flat = numbers.ravel()
    if abs(flat[1]) > 1e-9:
        raise _unusable(path, "camera_matrix has a skew, which rig files do not support")
    values = (width, height, flat[0], flat[4], flat[2], flat[5], coefficients.tolist(), kind)
    return dict(zip(_KEYS, (_plain(value) for value in values), strict=True))


def _plain(value: Any) -> Any:
    return float(value) if isinstance(value, np.floating) else value


def _unusable(path: Path, why: str) -> BadInput:
    return BadInput(
        "no camera can be read from this file",
        where=str(path),
        why=why,
        next_step="pass a camera file of OpenCV (YAML, XML), ROS (camera_info), Kalibr (camchain)"
        " or mrcal (.cameramodel)",
    )
