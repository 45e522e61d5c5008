"""Export and import of camera files: OpenCV, ROS, Kalibr and mrcal.

None states uncertainties. All have integer coordinates at pixel centres, as rig files do.

Source: OpenCV, calibration.cpp and stereo_calib.cpp of samples/cpp, calibController.cpp of
apps/interactive-calibration (keys); ROS, sensor_msgs/CameraInfo and camera_calibration_parsers
(keys, models plumb_bob, rational_polynomial, equidistant); Kalibr, wiki page "yaml formats"
(camchain); EuRoC MAV data set, sensor.yaml; mrcal, "Camera model representation in memory and on
disk".
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
from model.cameras import camera_from, is_camera_matrix, lens_remarks
from model.errors import BadInput
from model.files.camera_file import FISHEYE, CameraDocument
from model.files.documents import read_yaml, write_atomic
from model.files.reading import read_text
from model.files.validation import parse_yaml
from model.pose import Array, rotation_vector_from_matrix
from model.progress import SILENT, Listener
from model.rig import Rig, rig_from_document

_MODELS = {
    "plumb_bob": ("pinhole", 5),
    "rational_polynomial": ("pinhole", 8),
    **dict.fromkeys(("radial-tangential", "radtan"), ("pinhole", 4)),
    **dict.fromkeys(("equidistant", "fisheye"), (FISHEYE, 4)),
}
"""Our lens and its coefficients by the `distortion_model` of ROS's and EuRoC's files."""
_KALIBR_MODELS = {"radtan": ("pinhole", 4), "equidistant": (FISHEYE, 4), "none": ("pinhole", 0)}
_MRCAL_MODELS = {"LENSMODEL_PINHOLE": 0} | {f"LENSMODEL_OPENCV{n}": n for n in (4, 5, 8, 12)}
_ANY = ("pinhole", 14)  # without a model: as many coefficients as OpenCV has
_SMALL, _TEXT_LIMIT = 1_000_000, 32_000_000
"""Largest files in characters, OpenCV's and any; mrcal's may include all corners."""
_BAD_NUMBERS = (TypeError, ValueError, OverflowError, RecursionError, AttributeError)
"""Exceptions from values that are not numbers, and from PyYAML's constructors."""
_SIDES, _STEREO = ("image_width", "image_height"), ("m1", "m2")
_MATRIX, _LIST = "nine numbers, or rows, cols and data", "a list of numbers, or rows, cols and data"
_FORMS = {
    **dict.fromkeys((*_SIDES, "width", "height"), "a number of pixels"),
    **dict.fromkeys(("camera_matrix", "cameramatrix", "k", "m1", "m2"), _MATRIX),
    **dict.fromkeys(("distortion_coefficients", "distortion_coeffs", "dist_coeffs"), _LIST),
    **dict.fromkeys(("d", "d1", "d2"), _LIST),
    **dict.fromkeys(("resolution", "imagersize", "cameraresolution"), "width and height"),
    "intrinsics": "fx, fy, cx, cy",
    "fisheye_model": "0 or 1",
}
"""What is expected of each key."""
_BY_MATRIX = {
    "camera_matrix": (_SIDES, "distortion_coefficients"),  # OpenCV, ROS's parsers
    "cameramatrix": (("cameraresolution",), "dist_coeffs"),  # OpenCV's interactive-calibration
    "k": (("width", "height"), "d"),  # a message of ROS; ROS 1 names its fields K and D
    "intrinsics": (("resolution",), "distortion_coefficients"),  # EuRoC
    **{f"m{k}": (_SIDES, f"d{k}") for k in (1, 2)},  # OpenCV's stereo_calib, without the size
}
"""Keys of the image's size and of the lens by that of the matrix, in lower case."""
_KEYS = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "distortion", "lens")


def opencv_text(camera: CameraDocument) -> str:
    """The file of OpenCV's calibration sample, with ``fisheye_model`` 0 or 1."""
    storage = cv2.FileStorage(".yml", cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    storage.write("image_width", camera.width_px)
    storage.write("image_height", camera.height_px)
    storage.write("fisheye_model", int(camera.lens == FISHEYE))
    storage.write("camera_matrix", np.array(camera_from(camera).matrix))
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
        model, lens = "equidistant", list(camera.distortion)
    elif not (model := {5: "plumb_bob", 8: "rational_polynomial"}.get(len(lens), "")):
        raise BadInput(
            f"ROS has no lens model with {len(lens)} coefficients",
            where=f"camera {camera.name}",
            next_step="calibrate it with --lens rational or fisheye, or use --to opencv",
        )
    matrix = np.array(camera_from(camera).matrix)
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


def _with_lens(camera: CameraDocument, found: Mapping[str, Any], path: Path) -> CameraDocument:
    errors = ("lens_covariance", "pose_by_lens", "pose_covariance", "error_mm")
    kept = {k: v for k, v in camera.model_dump(mode="json").items() if k not in errors}
    try:
        return CameraDocument.model_validate(kept | {key: found[key] for key in _KEYS})
    except ValidationError as error:
        first = error.errors()[0]
        raise _unusable(path, f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None


def _found(path: Path, entry: str | None, own: CameraDocument) -> dict[str, Any]:
    """Keys of the rig file's ``cameras``, from a file, and what of them is assumed."""
    text = read_text(path, _TEXT_LIMIT)
    if "lensmodel" in text and _without_comments(text).startswith("{"):
        found = _from_mrcal(text, path)
    else:
        plain, is_opencv = _content(text, path)
        if any(_is_entry(key) for key in plain):
            return _from_kalibr(plain, path, entry)
        keys = {str(key).lower(): value for key, value in plain.items()}
        at = next((key for key in _BY_MATRIX if key in keys), "")
        if at in _STEREO:
            pair = [key.upper() for key in _STEREO if key in keys]
            at, size = _chosen(pair, entry, path).lower(), (own.width_px, own.height_px)
            found = _from_keys(dict(zip(_SIDES, size, strict=True)) | keys, at, path, True)
            unknown = f"image size; that of the rig file, {size[0]} x {size[1]} px, is assumed"
            return found | {"assumed": "" if keys.keys() & _SIDES else unknown}
        found = _from_keys(keys, at, path, is_opencv)
    if entry is not None:
        raise _unusable(path, f"it has one camera, so {entry!r} does not exist")
    return found


def _chosen(names: list[str], entry: str | None, path: Path) -> str:
    if entry is None and len(names) > 1:
        raise _unusable(path, f"it has {', '.join(names)}; choose one with --entry")
    if (name := entry or names[0]) not in names:
        raise _unusable(path, f"it has {', '.join(names)}, but not {name!r}")
    return name


def _content(text: str, path: Path) -> tuple[Mapping[Any, Any], bool]:
    """The keys of a YAML, JSON or XML file, and whether OpenCV has written it."""
    is_opencv = text.lstrip().startswith(("%YAML", "<?xml")) or "!!opencv-matrix" in text
    if is_opencv and len(text) > _SMALL:
        raise _unusable(path, f"it is longer than {_SMALL} characters")
    reader = _opencv_xml if text.lstrip().startswith("<") else _opencv_yaml
    try:
        plain = reader(text) if is_opencv else _message(text, path)
    except (*_BAD_NUMBERS, LookupError, yaml.YAMLError, ElementTree.ParseError) as error:
        raise _unusable(path, f"it is damaged: {' '.join(str(error).split())}"[:200]) from None
    if not isinstance(plain, Mapping):
        raise _unusable(path, "it has no keys")
    nodes = (node for node in plain.values() if isinstance(node, Mapping))
    return plain, is_opencv or any("type_id" in node for node in nodes)


def _message(text: str, path: Path) -> Any:
    """The data of a YAML file, or of messages that agree, as `ros2 topic echo` prints them."""
    parts = text.rstrip().removesuffix("\n---").split("\n---\n")
    if len(parts) == 1:
        return read_yaml(path).data
    messages = [plain for part in parts if (plain := parse_yaml(part + "\n").data) is not None]
    alike = [m | {"header": None} if isinstance(m, dict) else m for m in messages]  # has the time
    if any(message != alike[0] for message in alike):
        raise _unusable(path, f"it has {len(alike)} messages that differ; keep one of them")
    return messages[0]


def write_rig_with_camera(
    output: Path,
    rig: Rig,
    name: str,
    path: Path,
    entry: str | None = None,
    listener: Listener = SILENT,
) -> CameraDocument:
    """Writes a new rig file with the camera of another program's file; returns the camera.

    What is assumed and what remains to be done is reported to the listener and in the file.

    Args:
        output: The file to write.
        name: Of the camera, which keeps its pose and rate.
        path: A file in one of `FORMATS`, detected by content.
        entry: Which camera of Kalibr's camchain or OpenCV's stereo_calib, such as ``cam1``, ``M2``.

    Raises:
        BadInput: The file cannot be read, has an unknown format, or values out of range; the rig
            has no such camera; or ``output`` exists or cannot be written.
    """
    if output.exists():
        raise BadInput(
            "the file exists already",
            where=str(output),
            why="an import never replaces a rig file",
            next_step="choose a name that does not exist yet",
        )
    own = camera_named(rig.document, name)
    found = _found(path, entry, own)
    new = _with_lens(own, found, path)
    rig_from_document(document := with_camera(rig.document, new))
    plain = document.model_dump(mode="json", exclude_unset=True)
    body = yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, default_flow_style=None)
    head = [f"{rig.name} with camera {name} of {path.name}; written by `cdpr calibrate import`"]
    remarks = lens_remarks(own, new, path.name, found["assumed"])
    write_atomic(output, "".join(f"# {line}\n" for line in head + remarks) + body)
    for remark in remarks:
        listener.remark(remark)
    return new


def _ros_matrix(values: np.ndarray[Any, Any]) -> dict[str, Any]:
    return {"rows": len(values), "cols": values.shape[1], "data": values.ravel().tolist()}


def _opencv_yaml(text: str) -> Any:
    """Parses without OpenCV, whose own reader crashes on damaged files."""
    body = text.lstrip().replace("!!opencv-matrix", "")
    return yaml.safe_load(body.partition("\n")[2] if body.startswith("%") else body)


def _opencv_xml(text: str) -> Mapping[str, Any]:
    found: dict[str, Any] = {}
    for node in ElementTree.fromstring(text):
        data = node.find("data")
        found[node.tag] = node.text if data is None else {"data": (data.text or "").split()}
    return found


def _from_keys(keys: Mapping[str, Any], at: str, path: Path, is_opencv: bool) -> dict[str, Any]:
    """The camera of OpenCV, ROS or EuRoC with its matrix at a key; keys are in lower case."""
    if not at:
        names = "camera_matrix, cameraMatrix, K, intrinsics, M1, cam0"
        raise _unusable(path, f"it has none of the keys {names}")
    if at == "intrinsics" and (model := keys.get("camera_model", "pinhole")) != "pinhole":
        raise _unusable(path, f"its camera_model is {model!r}; pinhole can be read")
    sides, lens = _BY_MATRIX[at]
    size, matrix = np.concatenate([_at(keys, side, path) for side in sides]), _at(keys, at, path)
    _require_whole_image(keys, size, path)
    is_opencv = is_opencv if at == "camera_matrix" else at in ("cameramatrix", *_STEREO)
    (kind, count), is_assumed = _lens_of(keys, path, is_opencv)
    numbers = _at(keys, lens, path)
    if numbers[count:].any():  # some drivers add zeros
        model = keys.get("distortion_model", kind)
        raise _unusable(path, f"{model} has {count} coefficients, not {len(numbers)}")
    assumed = "distortion_model; plumb_bob is assumed, as by ROS" if is_assumed else ""
    return _numbers(path, size, matrix, numbers[:count], kind) | {"assumed": assumed}


def _lens_of(keys: Mapping[str, Any], path: Path, is_opencv: bool) -> tuple[tuple[str, int], bool]:
    """Our name of the lens and its coefficients at most, and whether it is assumed.

    OpenCV's sample has ``fisheye_model`` or nothing; ROS's reader assumes plumb_bob where a file
    states no model. Source: camera_calibration_parsers, parse_yml.cpp.
    """
    stated = keys.get("distortion_model")
    model = _MODELS.get(str(stated).strip())
    if stated is not None and model is None:
        raise _unusable(path, f"distortion_model is {stated!r}; {', '.join(_MODELS)} can be read")
    if "fisheye_model" in keys:
        own = _MODELS["fisheye"] if _at(keys, "fisheye_model", path).any() else _ANY
        if model is not None and model[0] != own[0]:
            raise _unusable(path, f"distortion_model {stated!r} contradicts its fisheye_model")
        return model or own, False
    if model is None and not is_opencv and "camera_matrix" not in keys:
        raise _unusable(path, f"distortion_model is missing: one of {', '.join(_MODELS)}")
    return model or _ANY, model is None and not is_opencv


def _at(keys: Mapping[Any, Any], key: str, path: Path, where: str = "") -> Array:
    """The numbers of a key: one, a list, or the data of a matrix, shape (n,)."""
    if key not in keys:
        raise _unusable(path, f"{where}{key} is missing: {_FORMS[key]}")
    node = keys[key].get("data") if isinstance(keys[key], Mapping) else keys[key]
    node = node.split() if isinstance(node, str) else node  # OpenCV's XML has lists as text
    try:
        numbers = np.ravel(np.asarray(node, np.float64))
    except _BAD_NUMBERS:
        numbers = np.full(1, np.nan)
    if not np.isfinite(numbers).all():
        raise _unusable(path, f"{where}{key} is not {_FORMS[key]}")
    return numbers


def _require_whole_image(keys: Mapping[Any, Any], size: Array, path: Path) -> None:
    """Refuses a file for binned images, or for a part of the image."""
    roi = keys["roi"] if isinstance(keys.get("roi"), Mapping) else {}
    binned = any(keys.get(key) not in (None, 0, 1) for key in ("binning_x", "binning_y"))
    sides = zip(("width", "height"), size.tolist(), strict=False)  # other sizes are refused later
    cut = any(roi.get(side) not in (None, 0, whole) for side, whole in sides)
    if binned or cut or roi.get("x_offset") or roi.get("y_offset"):
        raise _unusable(path, "its images are binned, or a part of the sensor's")


def _is_entry(key: object) -> bool:
    """Whether a YAML key is that of a Kalibr camera, such as ``cam0``."""
    return (text := str(key)).startswith("cam") and text[3:].isdecimal()


def _from_kalibr(plain: Mapping[Any, Any], path: Path, entry: str | None) -> dict[str, Any]:
    names = [str(key) for key in plain if _is_entry(key)]
    name = _chosen(names, entry, path)
    own, where = plain[name] if isinstance(plain[name], Mapping) else {}, f"{name}: "
    kind, model = str(own.get("camera_model")), str(own.get("distortion_model"))
    if kind != "pinhole" or model not in _KALIBR_MODELS:
        known = ", ".join(_KALIBR_MODELS)
        raise _unusable(path, f"{name} is {kind}-{model}; pinhole with {known} can be read")
    ours, count = _KALIBR_MODELS[model]
    lens = _at(own, "distortion_coeffs", path, where)
    if len(lens) != count:
        raise _unusable(path, f"{name}: {model} has {count} coefficients, not {len(lens)}")
    size, matrix = (_at(own, key, path, where) for key in ("resolution", "intrinsics"))
    return _numbers(path, size, matrix, lens, ours)


def _from_mrcal(text: str, path: Path) -> dict[str, Any]:
    try:
        plain = ast.literal_eval(_without_comments(text))
    except (*_BAD_NUMBERS, SyntaxError, MemoryError) as error:
        raise _unusable(path, f"it is damaged: {error}"[:200]) from None
    plain = plain if isinstance(plain, Mapping) else {}
    model = str(plain.get("lensmodel"))
    if model not in _MRCAL_MODELS:
        known = ", ".join(_MRCAL_MODELS)
        why = f"its lensmodel is {model!r}; mrcal-convert-lensmodel converts it to one of {known}"
        raise _unusable(path, why)
    numbers = _at(plain, "intrinsics", path)
    if len(numbers) != 4 + _MRCAL_MODELS[model]:
        raise _unusable(path, f"{model} has {4 + _MRCAL_MODELS[model]} intrinsics")
    return _numbers(path, _at(plain, "imagersize", path), numbers[:4], numbers[4:], "pinhole")


def _without_comments(text: str) -> str:
    lines = (line for line in text.splitlines() if not line.lstrip().startswith("#"))
    return "\n".join(lines).strip()


def _numbers(path: Path, size: Array, matrix: Array, lens: Array, kind: str) -> dict[str, Any]:
    """Keys of the rig file's ``cameras``; ``matrix`` has nine numbers, or fx, fy, cx, cy."""
    if len(size) != 2 or len(matrix) not in (4, 9):
        shape = f"{len(size)} numbers for the image's size and {len(matrix)} for the matrix"
        raise _unusable(path, f"it has {shape}, not 2 and 9 (3 x 3), or fx, fy, cx, cy")
    if len(matrix) == 9:
        if not is_camera_matrix(square := matrix.reshape(3, 3)):
            hint = "; it is transposed, as in MATLAB" if is_camera_matrix(square.T) else ""
            raise _unusable(path, f"its camera matrix is not fx 0 cx, 0 fy cy, 0 0 1{hint}")
        if abs(matrix[1]) > 1e-9:
            raise _unusable(path, "camera_matrix has a skew, which rig files do not support")
        matrix = matrix[[0, 4, 2, 5]]
    pixels = [int(side) if side.is_integer() else side for side in size.tolist()]
    values = (*pixels, *matrix.tolist(), lens.tolist(), kind)
    return dict(zip(_KEYS, values, strict=True)) | {"assumed": ""}


def _unusable(path: Path, why: str) -> BadInput:
    return BadInput(
        "no camera can be read from this file",
        where=str(path),
        why=why,
        next_step="pass a camera file of OpenCV (YAML, XML, JSON), ROS (camera_info), Kalibr"
        " (camchain), EuRoC (sensor.yaml) or mrcal (.cameramodel)",
    )
