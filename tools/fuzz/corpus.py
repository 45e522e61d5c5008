"""The files that are mutated: rigs, scenes, a plan, a run folder, results, images, drives."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def build(folder: Path) -> dict[str, list[Path]]:
    """Writes the whole files into a folder; their paths by kind."""
    from calibration.results import write_result
    from tests.calibration.results import camera_result_of
    from tests.executor import fake_run

    folder.mkdir(parents=True)
    run = fake_run.write(fake_run.make(every=20), folder / "run").path
    _endpoints(folder / "flat_endpoints.json")
    (folder / "poses.csv").write_text(
        "picture,x_mm,y_mm,z_mm,qw,qx,qy,qz\na.png,1,2,300,1,0,0,0\nb.png,4,5,300,1,0,0,0\n"
    )
    for name in ("rigs", "scenes", "pictures"):
        (folder / name).mkdir()
    for path in sorted((ROOT / "configs").glob("*.yaml")):
        kind = "rigs" if "winches:" in path.read_text() else "scenes"
        shutil.copy(path, folder / kind)
    _pictures(folder / "pictures")
    return {
        "rig": sorted((folder / "rigs").iterdir()),
        "scene": sorted((folder / "scenes").iterdir()),
        "plan": [run / "plan.json"],
        "run": [
            path for path in sorted(run.iterdir()) if path.suffix in (".json", ".jsonl", ".csv")
        ],
        "result": [write_result(folder, camera_result_of())],
        "places": [ROOT / "examples/rig_session/places.csv"],
        "poses": [folder / "poses.csv"],
        "corners": [_corners(folder)],
        "camera": _cameras(folder),
        "picture": sorted((folder / "pictures").iterdir()),
        "endpoints": [folder / "flat_endpoints.json"],
        "dbc": [ROOT / "drivers/odrive/cansimple.dbc"],
        "eds": sorted((ROOT / "simulation/drives/eds").glob("*.eds")),
        "profile": sorted((ROOT / "drivers/cia402/profiles").glob("*.yaml")),
    }


def _corners(folder: Path) -> Path:
    rows = [f"{p},{x * 10 + p},{y * 11.5},{x * 25},{y * 25}" for p in range(3) for x in range(4)
            for y in range(3)]  # fmt: skip
    path = folder / "corners.csv"
    path.write_text("\n".join(["picture,x_px,y_px,board_x_mm,board_y_mm", *rows]))
    return path


def _cameras(folder: Path) -> list[Path]:
    """A camera's numbers in every format that is read."""
    from calibration.intrinsics.exchange import FORMATS
    from model.rig import load_rig

    own = load_rig(ROOT / "configs/gachon_8_6.yaml").document.cameras[0]
    camera = own.model_copy(update={"distortion": [0.1, 0.2, 0.003, 0.004]})
    for name, text in FORMATS.items():
        (folder / f"camera_{name}.yaml").write_text(text(camera))
    return [folder / f"camera_{name}.yaml" for name in FORMATS]


def _pictures(folder: Path) -> None:
    import cv2
    import numpy as np

    image = np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8)
    for ending in ("png", "jpg", "bmp", "tiff", "pgm", "webp"):
        cv2.imwrite(str(folder / f"a.{ending}"), image)


def _endpoints(path: Path) -> None:
    from drivers.odrive.endpoints import wanted_settings
    from model.files.rig_file import OdriveDocument

    document = OdriveDocument(type="odrive", motor_torque_constant_nm_a=0.05, watchdog_ms=50.0)
    names = [wanted.name for wanted in wanted_settings(document)]
    endpoints = {name: {"id": i, "type": "float"} for i, name in enumerate(names, 100)}
    path.write_text(json.dumps({"fw_version": "0.6.10-0", "endpoints": endpoints}, indent=1))
