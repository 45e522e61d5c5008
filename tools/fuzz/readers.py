"""Every reader of files by name, with its call and the file to mutate."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Reader:
    """One reader.

    Attributes:
        name: Of the reader, and of its counts.
        seed: The valid file.
        read: Reads a path.
        target: Path of the mutated file; None for a default path.
    """

    name: str
    seed: Path
    read: Callable[[Path], object]
    target: Path | None = None


def readers(corpus: dict[str, list[Path]], scratch: Path) -> list[Reader]:
    """All readers; run folders are copied into ``scratch``."""
    from calibration.geometry.measurements import read_rig_data
    from calibration.result_files import load_result
    from calibration.run_data import read_poses
    from calibration.targets.boards import read_corners
    from cdpr.console.teach import TaughtPoses
    from drivers.cameras.files import read_image
    from drivers.cameras.live import VideoFile
    from drivers.can_bus import BusSettings
    from drivers.odrive.endpoints import read_endpoints
    from drivers.odrive.messages import read_layouts
    from executor.interlock.fault_latch import FaultLatch
    from executor.interlock.reference import ReferenceFile
    from model.files.documents import load_yaml
    from model.files.drive_profile_file import ProfileDocument
    from model.files.new_rig import read_coordinates
    from model.files.rig_file import OdriveDocument
    from model.plan import load_plan
    from model.rig import load_rig
    from model.scene import load_scene
    from simulation.drives.eds_file import read_eds

    rig = load_rig(corpus["rig"][0])
    small = replace(rig.cameras[0], width=64, height=48)
    bus = BusSettings("virtual", "fuzz")
    layouts = read_layouts()
    odrive = OdriveDocument(type="odrive", motor_torque_constant_nm_a=0.05, watchdog_ms=50.0)
    calls: dict[str, Callable[[Path], object]] = {
        "rig": load_rig,
        "scene": load_scene,
        "plan": load_plan,
        "result": load_result,
        "places": lambda path: read_rig_data(path, 8),
        "poses": read_poses,
        "corners": read_corners,
        "camera": lambda path: _import_camera(rig, path),
        "coordinates": read_coordinates,
        "reference": ReferenceFile(bus)._read,
        "latch": lambda path: _at(FaultLatch(bus), path).read(),
        "video": lambda path: sum(1 for _ in VideoFile(path, small)),
        "picture": read_image,
        "endpoints": lambda path: read_endpoints(path, odrive, layouts),
        "dbc": read_layouts,
        "eds": read_eds.__wrapped__,
        "taught": TaughtPoses,
        "message": _message,
        "profile": lambda path: load_yaml(path, ProfileDocument),
    }
    found = [
        Reader(f"{kind}:{seed.name}", seed, call)
        for kind, call in calls.items()
        for seed in corpus[kind]
    ]
    folder, cut = scratch / "run", scratch / "cut"
    shutil.copytree(corpus["run"][0].parent, folder)
    shutil.copytree(corpus["cut"][0].parent, cut)
    whole = [
        Reader(f"run:{seed.name}", seed, _run_part(seed.name), folder / seed.name)
        for seed in corpus["run"]
    ]
    again = [
        Reader(f"again:{seed.name}", seed, _again, folder / seed.name)
        for seed in corpus["run"]
        if seed.name in ("cycles.csv", "poses.csv", "summary.json", "plan.json", "rig.json")
    ]
    unfinished = [Reader(f"cut:{seed.name}", seed, _cut, cut / seed.name) for seed in corpus["cut"]]
    return found + whole + again + unfinished + _checksums(corpus["checksums"][0], scratch)


def _import_camera(rig: Any, path: Path) -> None:
    """Imports a camera file into a new rig file."""
    from calibration.intrinsics.exchange import write_rig_with_camera

    output = path.with_name("imported.yaml")
    output.unlink(missing_ok=True)
    write_rig_with_camera(output, rig, rig.cameras[0].name, path)


def _checksums(seed: Path, scratch: Path) -> list[Reader]:
    """Compares the files of a run with mutated checksums."""
    from executor.recording.checksums import require_unchanged_files

    folder = scratch / "checksums"
    shutil.copytree(seed.parent, folder)
    call = lambda path: require_unchanged_files(path.parent)  # noqa: E731
    return [Reader("checksums", seed, call, folder / seed.name)]


def _message(path: Path) -> None:
    """Parses a message to the console or a command line; only their own errors are allowed."""
    from cdpr.console.commands import NotAMessage, parse_message
    from executor.remote.protocol import InvalidCommand, parse_command

    content = path.read_bytes()
    with suppress(InvalidCommand):
        parse_command(content)
    with suppress(NotAMessage):
        parse_message(content.decode(errors="replace"))


def _at(file: Any, path: Path) -> Any:
    """A file of the state folder, moved to a path."""
    file.path = path
    return file


def _again(path: Path) -> object:
    """Reads a run folder as `cdpr plan --from-run` and `cdpr calibrate` do."""
    from calibration.run_data import poses_of_run, rig_measurements
    from executor.recording.resume import run_end
    from executor.recording.run_folder import RunFolder
    from model.errors import CdprError

    run = RunFolder.open(path.parent)
    calls: tuple[Callable[[], object], ...] = (
        lambda: run_end(run),
        lambda: poses_of_run(run.path, run.rig().cameras[0].name),
        lambda: rig_measurements(run.rig(), [run.path]),
    )
    for call in calls:
        with suppress(CdprError):
            call()
    return run


def _cut(path: Path) -> object:
    """Evaluates the folder of a killed run as `cdpr report` does."""
    from executor.evaluation import evaluate_folder
    from executor.recording.run_folder import RunFolder

    return evaluate_folder(RunFolder.open_cut_short(path.parent))


def _run_part(name: str) -> Callable[[Path], object]:
    """Reads a run folder as `cdpr report` does."""
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
