"""What `cdpr calibrate import` makes of a camera file."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from calibration.intrinsics.exchange import write_rig_with_camera
from model.files.camera_file import CameraDocument
from model.rig import Rig


def imported_camera(file: Path, rig: Rig, entry: str | None = None) -> CameraDocument:
    """The rig's first camera after the import."""
    with TemporaryDirectory() as folder:
        name = rig.cameras[0].name
        return write_rig_with_camera(Path(folder) / "rig.yaml", rig, name, file, entry)
