"""Every reader of files, by name: what it is called with, and the file that is mutated for it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Reader:
    """One reader.

    Attributes:
        name: Of the reader, and of its counts.
        seed: The whole file.
        read: Reads a path.
        place: Where the mutated file is put; None beside all others.
    """

    name: str
    seed: Path
    read: Callable[[Path], object]
    place: Path | None = None


def readers(corpus: dict[str, list[Path]], scratch: Path) -> list[Reader]:
    """All of them; run folders are copied into ``scratch``."""
    from calibration.extrinsics.hand_eye import read_poses
    from calibration.geometry.measurements import read_rig_data
    from calibration.intrinsics.exchange import imported_camera
    from calibration.load import load_result
    from calibration.targets.board import read_corners
    from drivers.cameras.files import read_picture
    from drivers.odrive.dbc import read_layouts
    from drivers.odrive.endpoints import read_endpoints
    from model.files.documents import load_yaml
    from model.files.drive_profile_file import ProfileDocument
    from model.files.rig_file import OdriveDocument
    from model.plan import load_plan
    from model.rig import load_rig
    from model.scene import load_scene
    from simulation.drives.eds_file import read_eds

    camera = load_rig(corpus["rig"][0]).document.cameras[0]
    odrive = OdriveDocument(type="odrive", motor_torque_constant_nm_a=0.05, watchdog_ms=50.0)
    calls: dict[str, Callable[[Path], object]] = {
        "rig": load_rig,
        "scene": load_scene,
        "plan": load_plan,
        "result": load_result,
        "places": lambda path: read_rig_data(path, 8),
        "poses": read_poses,
        "corners": read_corners,
        "camera": lambda path: imported_camera(path, camera),
        "picture": read_picture,
        "endpoints": lambda path: read_endpoints(path, odrive),
        "dbc": read_layouts,
        "eds": read_eds.__wrapped__,
        "profile": lambda path: load_yaml(path, ProfileDocument),
    }
    found = [
        Reader(f"{kind}:{seed.name}", seed, call)
        for kind, call in calls.items()
        for seed in corpus[kind]
    ]
    folder = scratch / "run"
    shutil.copytree(corpus["run"][0].parent, folder)
    return found + [
        Reader(f"run:{seed.name}", seed, _run_part(seed.name), folder / seed.name)
        for seed in corpus["run"]
    ]


def _run_part(name: str) -> Callable[[Path], object]:
    """What `cdpr report`, `plan --from-run` and `calibrate` read of a run folder."""
    from executor.recording.run_folder import RunFolder
    from executor.report.run_data import read_run
    from executor.report.tiles import (
        camera_table,
        chips,
        facts,
        key_figures,
        stop_table,
        verdict_banner,
    )

    def whole(path: Path) -> object:
        run = read_run(RunFolder.open(path.parent))
        shown = [part(run.summary) for part in (verdict_banner, chips, key_figures)]
        return shown, facts(run), stop_table(run), camera_table(run)

    def part(path: Path) -> object:
        return getattr(RunFolder.open(path.parent), path.stem)()

    return part if name in ("plan.json", "rig.json", "cycles.csv", "poses.csv") else whole
