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
        "picture": sorted((folder / "pictures").iterdir()),
        "endpoints": [folder / "flat_endpoints.json"],
        "dbc": [ROOT / "drivers/odrive/cansimple.dbc"],
        "eds": sorted((ROOT / "simulation/drives/eds").glob("*.eds")),
        "profile": sorted((ROOT / "drivers/cia402/profiles").glob("*.yaml")),
    }


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
