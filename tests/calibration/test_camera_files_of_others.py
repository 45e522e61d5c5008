"""Camera files of OpenCV, ROS, Kalibr and EuRoC in the forms in which they are met."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from calibration.intrinsics.exchange import write_rig_with_camera
from model.errors import BadInput
from model.files.camera_file import CameraDocument
from model.progress import Listener
from model.rig import Rig, load_rig
from tests.calibration.imports import imported_camera
from tracking.clearance import require_stated_errors

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(CONFIGS / "gachon_8_6.yaml")


@dataclass
class Remarks(Listener):
    """Collects remarks."""

    texts: list[str]

    def remark(self, text: str) -> None:
        self.texts.append(text)


def numbers_of(camera: CameraDocument) -> tuple:
    focal = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
    return camera.lens, (camera.width_px, camera.height_px), focal, tuple(camera.distortion)


FOCAL = (461.5, 460.25, 362.5, 246.0)
FOUR, FIVE = (-0.28, 0.07, 0.0002, 0.00002), (-0.28, 0.07, 0.0002, 0.00002, 0.5)
CAMERA = """image_width: 752
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 4.615e+002, 0., 3.625e+002, 0., 4.6025e+002, 2.46e+002, 0., 0., 1. ]
distortion_model: MODEL
distortion_coefficients: !!opencv-matrix
   rows: 4
   cols: 1
   dt: d
   data: [ -0.28, 0.07, 0.0002, 2e-5 ]
"""
OLD = CAMERA.replace("distortion_model: MODEL\n", "").replace("2e-5", "2e-5, 0.5")
OLD = OLD.replace("image_width", "image_Width").replace("image_height", "image_Height")
OLD = OLD.replace("camera_matrix", "Camera_Matrix")
OLD = OLD.replace("distortion_coefficients", "Distortion_Coefficients")
STATED = "[461.5, 0, 362.5, 0, 460.25, 246.0, 0, 0, 1]"
MATLAB = "[461.5, 0, 0, 0, 460.25, 0, 362.5, 246.0, 1]"
STATED_BY_ROS = "[461.5, 0.0, 362.5, 0.0, 460.25, 246.0, 0.0, 0.0, 1.0]"
PLAIN = """image_width: 752
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [461.5, 0, 362.5, 0, 460.25, 246.0, 0, 0, 1]}
distortion_coefficients: [-0.28, 0.07, 0.0002, 0.00002, 0.5]
"""
JSON = """{
    "image_width": 752,
    "image_height": 480,
    "camera_matrix": {"type_id": "opencv-matrix", "rows": 3, "cols": 3, "dt": "d",
        "data": [461.5, 0.0, 362.5, 0.0, 460.25, 246.0, 0.0, 0.0, 1.0]},
    "distortion_coefficients": {"type_id": "opencv-matrix", "rows": 5, "cols": 1, "dt": "d",
        "data": [-0.28, 0.07, 0.0002, 0.00002, 0.5]}
}
"""
INTERACTIVE_XML = """<?xml version="1.0"?>
<opencv_storage>
<calibrationDate>"Thu 07 Apr 2016 04:23:03 PM MSK"</calibrationDate>
<framesCount>21</framesCount>
<cameraResolution>
  752 480</cameraResolution>
<cameraMatrix type_id="opencv-matrix">
  <rows>3</rows>
  <cols>3</cols>
  <dt>d</dt>
  <data>
    4.615e+02 0. 3.625e+02 0. 4.6025e+02 2.46e+02 0. 0. 1.</data></cameraMatrix>
<cameraMatrix_std_dev type_id="opencv-matrix">
  <rows>4</rows>
  <cols>1</cols>
  <dt>d</dt>
  <data>
    0. 1.29e+01 2.85e+00 2.83e+00</data></cameraMatrix_std_dev>
<dist_coeffs type_id="opencv-matrix">
  <rows>1</rows>
  <cols>5</cols>
  <dt>d</dt>
  <data>
    -0.28 0.07 0.0002 2e-05 0.5</data></dist_coeffs>
<dist_coeffs_std_dev type_id="opencv-matrix">
  <rows>5</rows>
  <cols>1</cols>
  <dt>d</dt>
  <data>
    1.6e-02 8.7e-02 0. 0. 1.8e-01</data></dist_coeffs_std_dev>
<avg_reprojection_error>4.2691743074130178e-01</avg_reprojection_error>
</opencv_storage>
"""
MATRIX_DATA = (
    "rows: 3\n   cols: 3\n   dt: d\n   data: [ 461.5, 0., 362.5, 0., 460.25, 246., 0., 0., 1. ]"
)
LENS_DATA = "rows: 1\n   cols: 5\n   dt: d\n   data: [ -0.28, 0.07, 0.0002, 2e-05, 0.5 ]"
INTERACTIVE = f"""%YAML:1.0
---
calibrationDate: "Thu 07 Apr 2016 04:23:03 PM MSK"
framesCount: 21
cameraResolution: [ 752, 480 ]
cameraMatrix: !!opencv-matrix
   {MATRIX_DATA}
dist_coeffs: !!opencv-matrix
   {LENS_DATA}
avg_reprojection_error: 4.2691743074130178e-01
"""
STEREO = f"""%YAML:1.0
---
M1: !!opencv-matrix
   {MATRIX_DATA.replace("461.5", "455.5")}
D1: !!opencv-matrix
   {LENS_DATA.replace("0.07", "0.08")}
M2: !!opencv-matrix
   {MATRIX_DATA}
D2: !!opencv-matrix
   {LENS_DATA}
"""
EUROC = """sensor_type: camera
T_BS: {cols: 4, rows: 4, data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [461.5, 460.25, 362.5, 246.0] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 0.00002]
"""
OPENVINS = """%YAML:1.0 # need to specify the file type at the top!

cam0:
  T_imu_cam:
    - [1.0, 0.0, 0.0, 0.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 0.00002]
  distortion_model: radtan
  intrinsics: [461.5, 460.25, 362.5, 246.0] #fu, fv, cu, cv
  resolution: [752, 480]
"""
ROS_OLD = PLAIN.replace(
    "[-0.28, 0.07, 0.0002, 0.00002, 0.5]",
    "{rows: 1, cols: 5, data: [-0.28, 0.07, 0.0002, 0.00002, 0.5]}",
)
T265 = ROS_OLD.replace("0.5]", "0.0]") + "distortion_model: equidistant\n"
MESSAGE = """header: {stamp: {sec: 1, nanosec: 2}, frame_id: cam}
height: 480
width: 752
distortion_model: plumb_bob
d: [-0.28, 0.07, 0.0002, 0.00002, 0.5]
k: [461.5, 0.0, 362.5, 0.0, 460.25, 246.0, 0.0, 0.0, 1.0]
---
"""
LATER = MESSAGE.replace("sec: 1", "sec: 3")
WHOLE = "binning_x: null\nbinning_y: 1\nroi: null\n"
PARTS = (
    "binning_x: 2\n",
    "roi: {x_offset: 100, y_offset: 0, height: 480, width: 752}\n",
    "roi: {height: 240, width: 752}\n",
)
FOREIGN = {
    "equidistant": ("%YAML:1.0\n---\n" + CAMERA.replace("MODEL", "equidistant"), "fisheye", FOUR),
    "fisheye": ("%YAML:1.0\n---\n" + CAMERA.replace("MODEL", "fisheye"), "fisheye", FOUR),
    "plumb_bob": ("%YAML:1.0\n---\n" + CAMERA.replace("MODEL", "plumb_bob"), "pinhole", FOUR),
    "without a first line": (CAMERA.replace("MODEL", "equidistant"), "fisheye", FOUR),
    "OpenCV's earlier keys": ("%YAML:1.0\n" + OLD, "pinhole", FIVE),
    "OpenCV's interactive-calibration, XML": (INTERACTIVE_XML, "pinhole", FIVE),
    "OpenCV's interactive-calibration, YAML": (INTERACTIVE, "pinhole", FIVE),
    "OpenCV's JSON": (JSON, "pinhole", FIVE),
    "OpenVINS": (OPENVINS, "pinhole", FOUR),
    "ROS without a model": (ROS_OLD, "pinhole", FIVE),
    "a fisheye with a fifth 0": (T265, "fisheye", FOUR),
    "a flat list": (PLAIN + "distortion_model: plumb_bob\n", "pinhole", FIVE),
    "EuRoC": (EUROC, "pinhole", FOUR),
    "a message": (MESSAGE, "pinhole", FIVE),
    "a message without binning": (MESSAGE.replace("---", WHOLE + "---"), "pinhole", FIVE),
    "three messages": (MESSAGE + LATER + MESSAGE, "pinhole", FIVE),
    "a comment before": ("# from the lab\n---\n" + MESSAGE, "pinhole", FIVE),
    "plumb_bob with zeros": (MESSAGE.replace("0.5]", "0.5, 0, 0, 0.0]"), "pinhole", FIVE),
}
"""Files as other programs write them, with our lens and its coefficients."""


@pytest.mark.parametrize("name", FOREIGN)
def test_files_are_read_as_other_programs_write_them(rig, tmp_path, name: str) -> None:
    text, lens, coefficients = FOREIGN[name]
    file = tmp_path / "camera"
    file.write_text(text)
    found = imported_camera(file, rig)
    assert numbers_of(found) == (lens, (752, 480), FOCAL, coefficients)
    remarks = Remarks([])
    write_rig_with_camera(tmp_path / "rig.yaml", rig, rig.cameras[0].name, file, listener=remarks)
    assumed = "plumb_bob is assumed" in remarks.texts[0]
    assert assumed == (name == "ROS without a model")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (CAMERA.replace("MODEL", "omnidirectional"), "distortion_model is 'omnidirectional'; "),
        (CAMERA.replace("MODEL", "plumb_bob") + "fisheye_model: 1\n", "contradicts its fisheye_"),
        (PLAIN.replace("distortion_co", "co"), "distortion_coefficients is missing: a list of num"),
        (PLAIN.replace("[-0.28, 0.07", "[a, b"), "distortion_coefficients is not a list of num"),
        (PLAIN.replace("data", "date"), "camera_matrix is not nine numbers, or rows, cols"),
        *((PLAIN + part, "its images are binned, or a part of the sensor's") for part in PARTS),
        (PLAIN.replace("752", "wide"), "image_width is not a number of pixels"),
        (PLAIN.replace(STATED, MATLAB), "it is transposed, as in MATLAB"),
        (PLAIN.replace(STATED, "[461.5, 0, 0, 1, 460.25, 0, 362, 246, 1]"), "it is transposed, as"),
        (PLAIN.replace(STATED, "[461.5, 0, 362, 0, 460.25, 246, 0, 0, 2]"), "not fx 0 cx, 0 fy cy"),
        (PLAIN.replace(STATED, "[461.5, 0, 362, 1, 460.25, 246, 0, 0, 1]"), "not fx 0 cx, 0 fy cy"),
        (PLAIN.replace(STATED, "[461.5, 1, 362, 0, 460.25, 246, 0, 0, 1]"), "has a skew"),
        (PLAIN.replace(STATED, "[0, 0, 0, 0, 0, 0, 0, 0, 0]"), "is not fx 0 cx, 0 fy cy, 0 0 1"),
        (MESSAGE.replace(STATED_BY_ROS, MATLAB), "it is transposed, as in MATLAB"),
        (EUROC.replace("[752, 480]", "752"), "1 numbers for the image's size"),
        (EUROC.replace("pinhole", "omni"), "its camera_model is 'omni'; pinhole can be read"),
        (EUROC.replace("distortion_model", "model"), "distortion_model is missing: one of plumb_"),
        (OPENVINS.replace("intrinsics", "k"), "cam0: intrinsics is missing: fx, fy, cx, cy"),
        ("K: {data: 3}\nwidth: 3\nheight: 4\nroi: [1]\nd: []", "distortion_model is missing"),
        (INTERACTIVE.replace("dist_coeffs", "d"), "dist_coeffs is missing: a list of numbers"),
        (INTERACTIVE.replace("[ 752, 480 ]", "wide"), "cameraresolution is not width and height"),
        (STEREO, "it has M1, M2; choose one with --entry"),
        (STEREO.replace("D1", "d3").replace("M2", "m3"), "d1 is missing: a list of numbers"),
        (MESSAGE + LATER.replace("752", "640"), "it has 2 messages that differ; keep one"),
        (MESSAGE + "height: [\n", "it is damaged: not valid"),
        (MESSAGE + "height\n", "it has 2 messages that differ"),
        (MESSAGE.replace("0.5]", "0, 0, 0, 0.1]"), "plumb_bob has 5 coefficients, not 8"),
        (T265.replace("0.0]", "0.1]"), "equidistant has 4 coefficients, not 5"),
        (EUROC.replace("0.00002]", "0.00002, 0.1]"), "radial-tangential has 4 coefficients, not 5"),
        ("sensor_type: imu\n", "it has none of the keys camera_matrix, cameraMatrix, K, "),
        ("{'lensmodel': 'LENSMODEL_PINHOLE', 'imagersize': [9, 9]}", "intrinsics is missing: fx"),
    ],
)  # fmt: skip
def test_the_message_names_the_key_and_what_is_expected(rig, tmp_path, text, why) -> None:
    file = tmp_path / "camera"
    file.write_text(text)
    with pytest.raises(BadInput) as caught:
        imported_camera(file, rig)
    assert why in str(caught.value.why)


def test_a_camera_of_a_stereo_pair_is_chosen_and_has_the_size_of_the_rig_file(
    rig, tmp_path
) -> None:
    """OpenCV's sample stereo_calib writes no image size."""
    file, remarks, name = tmp_path / "intrinsics.yml", Remarks([]), rig.cameras[0].name
    file.write_text(STEREO)
    size = (rig.cameras[0].width, rig.cameras[0].height)
    camera = write_rig_with_camera(tmp_path / "new.yaml", rig, name, file, "M2", remarks)
    assert numbers_of(camera) == ("pinhole", size, FOCAL, FIVE)
    text = f"has no image size; that of the rig file, {size[0]} x {size[1]} px, is assumed"
    assert text in remarks.texts[0]
    file.write_text(STEREO + "image_width: 752\nimage_height: 480\n")
    assert numbers_of(imported_camera(file, rig, "M1"))[1] == (752, 480)
    with pytest.raises(BadInput) as caught:
        imported_camera(file, rig, "M3")
    assert "it has M1, M2, but not 'M3'" in str(caught.value.why)


def test_an_import_leaves_out_the_error_of_measurements_and_states_the_next_step(
    rig, tmp_path
) -> None:
    """The operator's error_mm was stated for the former lens."""
    file, new, remarks = tmp_path / "camera.yaml", tmp_path / "new.yaml", Remarks([])
    file.write_text(ROS_OLD)
    assert rig.cameras[0].error is not None
    write_rig_with_camera(new, rig, rig.cameras[0].name, file, listener=remarks)
    camera = load_rig(new).cameras[0]
    assert camera.error is None
    with pytest.raises(BadInput, match="measuring error of camera 'front' is unknown"):
        require_stated_errors(load_rig(new), [camera])
    assert [f"# {text}" for text in remarks.texts] == new.read_text().splitlines()[1:4]
    for text, part in zip(
        remarks.texts,
        (
            "plumb_bob is assumed",
            "cdpr calibrate extrinsics",
            "error_mm of camera 'front', 0.5, was stated",
        ),
        strict=True,
    ):
        assert part in text


@pytest.mark.parametrize(
    ("middle", "where"),
    [
        ((362.5, 246.0), ""),
        ((80.0, 60.0), ""),
        ((74.0, 246.0), "is at the edge of the image of 752 x 480 px"),
        ((362.5, 440.0), "is at the edge of"),
        ((0.0, 0.0), "(0, 0) px is at the edge of"),
        ((-1.0, 246.0), "is outside the image"),
        ((362.5, 481.0), "is outside the image"),
        ((240.0, 376.0), "that of an image of 480 x 752 px; check whether width and height, 752 x"),
        ((230.0, 390.0), "that of an image of 480 x 752 px"),
        ((300.0, 300.0), ""),
    ],
)
def test_a_principal_point_far_from_the_middle_is_questioned(
    rig, tmp_path, middle: tuple[float, float], where: str
) -> None:
    file, remarks = tmp_path / "camera.yaml", Remarks([])
    file.write_text(EUROC.replace("362.5, 246.0", "{}, {}".format(*middle)))
    write_rig_with_camera(tmp_path / "rig.yaml", rig, rig.cameras[0].name, file, listener=remarks)
    questioned = [text for text in remarks.texts if "principal point" in text]
    assert len(questioned) == bool(where)
    assert where in "".join(questioned)
