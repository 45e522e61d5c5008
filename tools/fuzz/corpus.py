"""Valid files for mutation: rigs, scenes, a plan, a run folder, results, images, drives."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def build(folder: Path) -> dict[str, list[Path]]:
    """Writes the valid files into a folder; returns their paths by kind."""
    from calibration.results import write_result
    from executor.recording.checksums import write_checksums
    from tests.calibration.results import camera_result_of
    from tests.executor import fake_run

    folder.mkdir(parents=True)
    run = fake_run.write(fake_run.make(every=20), folder / "run").path
    _cut_short(run, folder / "cut")
    shutil.copytree(folder / "cut", folder / "checksums")
    sums = folder / "checksums"
    write_checksums(sums, [path.name for path in sums.glob("*.*")])
    _endpoints(folder / "flat_endpoints.json")
    (folder / "poses.csv").write_text(
        "picture,x_mm,y_mm,z_mm,qw,qx,qy,qz\na.png,1,2,300,1,0,0,0\nb.png,4,5,300,1,0,0,0\n"
    )
    for name in ("rigs", "scenes", "pictures", "cameras", "state"):
        (folder / name).mkdir()
    for path in sorted((ROOT / "configs").glob("*.yaml")):
        kind = "rigs" if "winches:" in path.read_text() else "scenes"
        shutil.copy(path, folder / kind)
    _pictures(folder / "pictures")
    _video(folder / "a.avi")
    _cameras(folder / "cameras")
    _state(folder / "state")
    _coordinates(folder / "coordinates.csv")
    return {
        "rig": sorted((folder / "rigs").iterdir()),
        "scene": sorted((folder / "scenes").iterdir()),
        "plan": [run / "plan.json"],
        "run": [
            path for path in sorted(run.iterdir()) if path.suffix in (".json", ".jsonl", ".csv")
        ],
        "cut": [folder / "cut" / name for name in ("run.json", "cycles.csv", "events.jsonl")],
        "checksums": [folder / "checksums" / "SHA256SUMS"],
        "result": [write_result(folder, camera_result_of())],
        "places": [ROOT / "examples/rig_session/places.csv"],
        "poses": [folder / "poses.csv"],
        "corners": [_corners(folder)],
        "camera": sorted((folder / "cameras").iterdir()),
        "coordinates": [folder / "coordinates.csv"],
        "reference": [folder / "state" / "reference.json"],
        "latch": [folder / "state" / "latched.json"],
        "video": [folder / "a.avi"],
        "picture": sorted((folder / "pictures").iterdir()),
        "endpoints": [folder / "flat_endpoints.json"],
        "dbc": [ROOT / "drivers/odrive/cansimple.dbc"],
        "eds": sorted((ROOT / "simulation/drives/eds").glob("*.eds")),
        "taught": [_taught(folder)],
        "message": _messages(folder),
        "profile": sorted((ROOT / "drivers/cia402/profiles").glob("*.yaml")),
    }


def _taught(folder: Path) -> Path:
    from cdpr.console.teach import TaughtPoses
    from model.rig import load_rig

    path = folder / "taught.json"
    poses = TaughtPoses(path)
    for name in ("low", "high"):
        poses.teach(name, load_rig(ROOT / "configs/gachon_8_6.yaml").home)
    return path


def _messages(folder: Path) -> list[Path]:
    """Messages from pages to the console, and from programs to the command socket."""
    held = '"direction": [0.0, 0.6, 0.8], "frame": "world", "step_mm": 0.1'
    texts = (
        f'{{"kind": "held", "hold": 3, {held}, "speed_mm_s": 5.0, "seq": 7}}',
        '{"kind": "command", "id": 3, "command": "speed", "percent": 50}',
        f'{{"command": "held", "press": 3, {held}, "percent": 50}}',
    )
    found = []
    for number, text in enumerate(texts):
        found.append(folder / f"message-{number}.json")
        found[-1].write_text(text)
    return found


def _corners(folder: Path) -> Path:
    rows = [f"{p},{x * 10 + p},{y * 11.5},{x * 25},{y * 25}" for p in range(3) for x in range(4)
            for y in range(3)]  # fmt: skip
    path = folder / "corners.csv"
    path.write_text("\n".join(["picture,x_px,y_px,board_x_mm,board_y_mm", *rows]))
    return path


def _cut_short(run: Path, folder: Path) -> None:
    """Writes the folder of a killed run."""
    from executor.recording.record_files import RunCourse
    from executor.recording.run_folder import RunFolder

    folder.mkdir()
    for name in ("plan.json", "rig.json", "cycles.csv", "events.jsonl"):
        shutil.copy(run / name, folder)
    started = datetime(2026, 1, 1, tzinfo=UTC)
    RunFolder(folder).write_course(RunCourse(started, "virtual", simulated=True, fast=False))


def _pictures(folder: Path) -> None:
    import cv2
    import numpy as np

    image = np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8)
    for ending in ("png", "jpg", "bmp", "tiff", "pgm", "webp"):
        cv2.imwrite(str(folder / f"a.{ending}"), image)


def _endpoints(path: Path) -> None:
    from drivers.odrive.endpoints import wanted_settings
    from drivers.odrive.messages import read_layouts
    from model.files.rig_file import OdriveDocument

    document = OdriveDocument(type="odrive", motor_torque_constant_nm_a=0.05, watchdog_ms=50.0)
    names = [wanted.name for wanted in wanted_settings(document, read_layouts())]
    endpoints = {name: {"id": i, "type": "float"} for i, name in enumerate(names, 100)}
    versions = {"fw_version": "0.6.10-0", "hw_version": "4.4.58"}
    path.write_text(json.dumps({**versions, "endpoints": endpoints}, indent=1))


def _video(path: Path) -> None:
    import cv2
    import numpy as np

    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    chance = np.random.default_rng(0)
    for _ in range(3):
        writer.write(chance.integers(0, 255, (48, 64, 3), np.uint8))
    writer.release()


def _cameras(folder: Path) -> None:
    """Writes a camera in every supported format; OpenCV's also as XML."""
    import cv2

    from calibration.intrinsics.exchange import FORMATS
    from model.rig import load_rig

    own = load_rig(ROOT / "configs/gachon_8_6.yaml").document.cameras[0]
    camera = own.model_copy(update={"distortion": [0.1, 0.2, 0.003, 0.004]})
    for name, write in FORMATS.items():
        (folder / f"{name}.yaml").write_text(write(camera))
    text = FORMATS["opencv"](camera)
    given = cv2.FileStorage(text, cv2.FileStorage_READ | cv2.FileStorage_MEMORY)
    xml = cv2.FileStorage(str(folder / "opencv.xml"), cv2.FileStorage_WRITE)
    for name in ("image_width", "image_height", "fisheye_model"):
        xml.write(name, int(given.getNode(name).real()))
    for name in ("camera_matrix", "distortion_coefficients"):
        xml.write(name, given.getNode(name).mat())
    xml.release()


def _state(folder: Path) -> None:
    """A homing reference and an engaged fault latch."""
    import numpy as np

    from executor.homing import reference_at
    from executor.interlock.fault_latch import LatchedFault
    from model.pose import Pose
    from model.rig import load_rig

    rig = load_rig(ROOT / "configs/gachon_8_6.yaml")
    counts, tensions = np.arange(8.0), np.full(8, 20.0)
    pose = Pose(np.array([0.0, 0.0, 0.4]), np.eye(3))
    reference = reference_at(rig, pose, counts, tensions, "stated", 0.001)
    (folder / "reference.json").write_text(reference.model_dump_json(indent=1))
    latched = LatchedFault("virtual", rig.name, "EMCY", "2026-01-01T00:00:00Z", "runs/a", 1, ())
    (folder / "latched.json").write_text(json.dumps(asdict(latched)))


def _coordinates(path: Path) -> None:
    """Writes a table for `cdpr new --from`."""
    from model.files.new_rig import CSV_COLUMNS
    from model.rig import load_rig

    rig = load_rig(ROOT / "configs/gachon_8_6.yaml").document
    rows = zip(rig.outlets_mm, rig.anchors_mm, strict=True)
    lines = [",".join(f"{value:g}" for value in (*outlet, *anchor)) for outlet, anchor in rows]
    path.write_text("\n".join([",".join(CSV_COLUMNS), *lines]) + "\n")
