"""Results of the `cdpr calibrate` verbs: output, `diff`, `apply`, `export`, `import`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Any

import typer

from calibration.intrinsics.exchange import FORMATS, FormatName, write_rig_with_camera
from calibration.intrinsics.result import camera_named
from calibration.result_files import compare, load_result, write_calibrated_rig
from calibration.results import Calibration, Destination
from cdpr.cli.arguments import argument, flag, option, required
from cdpr.cli.options import CALIBRATION, JSON, RIG, calibrated_rig
from cdpr.cli.output import Terminal, present, show_facts, show_json
from drivers.plausibility import HOMING_OPTIONS
from model.cameras import lacks_pose_error
from model.files.documents import write_atomic
from model.files.output import require_new_file
from model.rig import load_rig

SOURCE = argument("folder of images, video file, camera index or address", "SOURCE")
PICTURES = option("number of images from a video or camera (default: 20; tags: 40)", min=1)
CAMERA = option("name of the camera in the rig file (default: the first)")


def wanted_option(default_mm: float) -> float:
    """Declares ``--wanted-mm``, whose default depends on what is calibrated."""
    return option("required accuracy, 95 %", default=default_mm, min=0.001)


@dataclass(frozen=True, slots=True)
class ResultOptions:
    """Destination and output format of a calibration's result; every field is an option."""

    output: Path | None = option("folder for the result and its report", "-o", "--output")
    force: bool = flag("replace a result with the same name and date")
    as_json: bool = JSON

    @property
    def to(self) -> Destination:
        """Where the result is written."""
        return Destination(self.output, self.force)

    @property
    def listener(self) -> Terminal:
        """Shows the progress on standard error."""
        return Terminal(quiet=self.as_json)

    def show(self, made: Calibration[Any, Any, Any]) -> None:
        """Shows a calibration, and exits with 3 if it is not good enough."""
        result = made.result
        if self.as_json:
            show_json(result.sealed().model_dump(mode="json"))
        else:
            lines = [("verdict", result.verdict), *(("next", step) for step in result.next_steps)]
            lines += [
                *result.in_words(),
                *made.facts,
                *(("not used", f"{k} {why}") for k, why in result.unused.items()),
                *zip(("result", "report"), map(str, made.files), strict=False),
            ]
            show_facts(f"{result.kind} {result.name}", lines)
        if not result.good_enough:
            raise typer.Exit(3)


def diff(
    *,
    first: Path = argument("result file (YAML)", "A"),
    second: Path = argument("result file (YAML)", "B"),
    as_json: bool = JSON,
) -> None:
    """Compare two calibration results: each number with its interval, and the effect in mm.

    Exit code 3 where they differ by more than their intervals.

    Example:
      cdpr calibrate diff calibration_camera_front_2026-03-01.yaml
      calibration_camera_front_2026-06-01.yaml
    """
    one, other = load_result(first), load_result(second)
    found = compare(one, other)
    title = f"{one.kind} {one.name}: from {one.date} to {other.date}"
    present(as_json, found.as_dict(), title, found.facts())
    if not found.agree:
        raise typer.Exit(3)


# `cdpr calibrate apply`: a new rig file with calibration results.


def apply(
    *,
    rig: Path = RIG,
    results: list[Path] = argument("result files of `cdpr calibrate`", "RESULT..."),
    output: Path = required("rig file to write; must not exist", "-o", "--output"),
    as_json: bool = JSON,
) -> None:
    """Write a new rig file in which calibration results replace the values of RIG.

    RIG itself is not changed; its comments are not copied.

    Example:
      cdpr calibrate apply rig.yaml calibration_rig_rig_2026-03-14.yaml -o rig_calibrated.yaml
    """
    loaded = [load_result(path) for path in results]
    old = load_rig(rig)
    new = write_calibrated_rig(output, old, loaded, Terminal())
    facts = [(f"{one.kind} {one.name}", f"{one.date}: {one.verdict}") for one in loaded]
    facts.append(("rig file", str(output)))
    path = quote(str(output))
    facts += [
        ("next", f"`cdpr calibrate extrinsics {path} SOURCE --camera {quote(camera.name)}`")
        for camera, changed in zip(old.document.cameras, new.document.cameras, strict=True)
        if lacks_pose_error(camera, changed)
    ]
    facts.append(("next", f"`cdpr home {path}` with {HOMING_OPTIONS}, then plan with it"))
    document = {"rig": str(output), "results": [str(path) for path in results]}
    present(as_json, document, f"{new.name} with its calibration", facts)


# `cdpr calibrate export` and `import`: camera files of OpenCV, ROS, Kalibr and mrcal.


def export(
    *,
    rig: Path = RIG,
    output: Path = required("file to write", "-o", "--output"),
    to: FormatName = option("file format", default="opencv"),
    camera: str | None = CAMERA,
    calibration: list[Path] | None = CALIBRATION,
    force: bool = flag("replace an existing file"),
    as_json: bool = JSON,
) -> None:
    """Write a camera's matrix and lens for OpenCV, ROS, Kalibr or mrcal.

    Examples:
      cdpr calibrate export configs/gachon_8_6.yaml -o front.yaml --to ros
      cdpr calibrate export rig.yaml -o front.yaml --calibration
      calibration_camera_front_2026-03-01.yaml
    """
    loaded = calibrated_rig(load_rig(rig), calibration)
    document = camera_named(loaded.document, loaded.camera(camera).name)
    require_new_file(output, force)
    write_atomic(output, FORMATS[to](document))
    result = {"file": str(output), "format": to, "camera": document.name}
    present(as_json, result, "export", [(k, result[k]) for k in ("camera", "format", "file")])


def import_(
    *,
    rig: Path = RIG,
    file: Path = argument("camera file of OpenCV, ROS, Kalibr or mrcal", "CAMERA"),
    output: Path = required("rig file to write; must not exist", "-o", "--output"),
    camera: str | None = CAMERA,
    entry: str | None = option("which of several cameras in the file: Kalibr's cam1, OpenCV's M2"),
    as_json: bool = JSON,
) -> None:
    """Write a new rig file with a camera's matrix and lens from another program.

    CAMERA is OpenCV's YAML, XML or JSON, ROS's camera_info, Kalibr's camchain or mrcal's
    .cameramodel. These files state no uncertainty; `cdpr calibrate camera` does.

    Example:
      cdpr calibrate import rig.yaml camera_info.yaml --camera front -o rig_with_lens.yaml
    """
    loaded = load_rig(rig)
    name, listener = loaded.camera(camera).name, Terminal(quiet=as_json)
    found = write_rig_with_camera(output, loaded, name, file, entry, listener=listener)
    lens = f"{found.lens}, {len(found.distortion)} coefficients"
    size = f"{found.width_px} x {found.height_px} px, fx {found.fx_px:.6g} px"
    document = {"rig": str(output), "camera": found.name, "lens": found.lens}
    facts = [("size", size), ("lens", lens), ("rig file", str(output))]
    present(as_json, document, f"camera {found.name}", facts)
