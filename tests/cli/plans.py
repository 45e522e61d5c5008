"""Hand-made plans, so that tests of later steps need no search."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from model.files.documents import PoseDocument, millimetres
from model.files.plan_file import PlanDocument
from model.files.scene_file import SceneDocument
from model.plan import save_plan, sealed
from model.pose import Pose
from model.rig import Rig, load_rig
from model.scene import Scene, scene_from_document
from planner.check import check_path

CONFIGS = Path(__file__).parents[2] / "configs"
RIG = CONFIGS / "gachon_8_6.yaml"
HALL = CONFIGS / "hall_10_6.yaml"
START_MM, GOAL_MM = (0.0, 0.0, 445.0), (0.0, 30.0, 495.0)


def rig_for_long_runs(folder: Path) -> Path:
    """The paper's rig, three times as fast, with a third of the cycles and one image a second."""
    rig = folder / "rig.yaml"
    text = RIG.read_text()
    for as_shipped, here in (
        ("cycle_ms: 10\n", "cycle_ms: 30\n"),
        ("rate_hz: 10\n", "rate_hz: 1\n"),
        ("  speed_mm_s: 20", "  speed_mm_s: 60"),
    ):
        assert as_shipped in text
        text = text.replace(as_shipped, here)
    rig.write_text(text)
    return rig


def rig_with_long_cycles(folder: Path, cycle_ms: int = 100) -> Path:
    """The paper's rig for runs in real time, with cycles longer than the delays of a busy host."""
    rig = folder / "rig.yaml"
    text = RIG.read_text()
    assert "cycle_ms: 10\n" in text
    rig.write_text(text.replace("cycle_ms: 10\n", f"cycle_ms: {cycle_ms}\n"))
    return rig


def free_scene(start_mm: Sequence[float], goal_mm: Sequence[float]) -> Scene:
    """A room with one distant block, so that there is a clearance to measure."""
    data = {
        "schema_version": 1,
        "name": "far block",
        "clearance": {"obstacle_mm": 10, "self_mm": 5},
        "start": {"position_mm": list(start_mm)},
        "goal": {"position_mm": list(goal_mm)},
        "obstacles": [
            {
                "name": "block",
                "box": {"size_mm": [80.0, 80.0, 100.0]},
                "position_mm": [-150.0, 0.0, 50.0],
            }
        ],
    }
    return scene_from_document(SceneDocument.model_validate(data))


def straight_plan(rig: Rig, scene: Scene, corners_mm: Sequence[Sequence[float]]) -> PlanDocument:
    """A sealed plan along straight lines, not checked."""
    waypoints = [PoseDocument(position_mm=list(map(float, corner))) for corner in corners_mm]
    report = check_path(rig, scene, [Pose.level(millimetres(list(c))) for c in corners_mm])
    near, own = report.obstacle_clearance, report.self_clearance
    length = report.length * 1000.0
    return sealed(
        {
            "rig_hash": rig.plan_hash,
            "scene_hash": scene.hash,
            "rig": rig.document,
            "scene": scene.document,
            "planner": {
                "name": "adaptive",
                "cost": "length",
                "mode": "paper",
                "seed": 0,
                "step_mm": 40.0,
                "neighbour_radius_mm": 80.0,
                "goal_radius_mm": 50.0,
                "max_iterations": 1,
            },
            "waypoints": waypoints,
            "raw_path": waypoints,
            "tree": {"positions_mm": [list(map(float, corners_mm[0]))], "parents": [-1]},
            "statistics": {
                "nodes": 1,
                "iterations": 0,
                "edge_checks": 1,
                "planning_time_s": 0.0,
            },
            "quality": {
                "length_mm": length,
                "raw_length_mm": length,
                "mean_kinematic_cost": 0.5,
                "min_tension_n": report.min_tension,
                "max_tension_n": report.max_tension,
                "obstacle_clearance": near.as_dict() if near else None,
                "self_clearance": own.as_dict(),
            },
        }
    )


def write_short_plan(path: Path, rig_file: Path = RIG) -> Path:
    """Writes a straight path of 58 mm for the paper's rig, about 3 s long."""
    scene = free_scene(START_MM, GOAL_MM)
    save_plan(straight_plan(load_rig(rig_file), scene, [START_MM, GOAL_MM]), path)
    return path
