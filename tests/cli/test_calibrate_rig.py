"""`cdpr calibrate rig` on typical files."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from calibration.geometry.parameters import DEFAULT_DEVIATIONS
from calibration.geometry.result import require_physical
from calibration.result_files import load_result
from cdpr.cli.calibrate import rig as rig_verb
from model.errors import Fault
from model.kinematics import settled_poses_near
from model.rig import Rig, load_rig
from model.winches import WinchMap
from tests.calibration.rig_places import samples, write_samples
from tests.cli.program import call, one_message

ROOT = Path(__file__).resolve().parents[2]
RIG = ROOT / "configs/gachon_8_6_rehearsal.yaml"
SESSION = ROOT / "examples/rig_session"


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(RIG)


@pytest.fixture(scope="module")
def file(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("my data") / "places.csv"
    write_samples(path, samples(rig, 40, tilt=0.1, seed=5).measured)
    return path


def test_a_result_and_its_report_are_written_and_applied(file: Path, tmp_path: Path) -> None:
    folder = tmp_path / "calibration"
    done = call("calibrate", "rig", RIG, file, "-o", folder, "--json")
    assert done.code == 0, done
    document = json.loads(done.out)
    assert document["good_enough"]
    assert document["held_out_mm"] < document["before_mm"] / 3.0
    (result,) = folder.glob("calibration_rig_rig_*.yaml")
    assert "good enough" in result.with_suffix(".html").read_text(encoding="utf-8")
    same = call("calibrate", "diff", result, result)
    assert same.code == 0, same


def test_counts_with_the_wrong_sign_are_named(rig: Rig, tmp_path: Path) -> None:
    data = samples(rig, 40, tilt=0.1, seed=5).measured
    write_samples(tmp_path / "data.csv", replace(data, counts=-data.counts))
    done = call("calibrate", "rig", RIG, tmp_path / "data.csv")
    one_message(done, 2, "do not fit the rig file", "the sign of the counts (`direction`")


@pytest.mark.parametrize(
    ("drums", "radius", "said"),
    [
        ([-302.5, -300.8], None, "the sign of all counts is inverted"),
        ([302.5, -1.0], None, "the drum of cable 2 comes out as -1.0 mm"),
        ([302.5, 300.8], -0.0192, "the radius of the pulleys comes out as -19.2 mm"),
    ],
)
def test_a_fit_that_is_not_physical_is_refused(
    drums: list[float], radius: float | None, said: str
) -> None:
    with pytest.raises(Fault, match=said):
        require_physical(np.array(drums), radius)
    require_physical(np.abs(drums), None if radius is None else -radius)


def around(radius: float, angle_deg: float, height: float) -> list[float]:
    angle = np.radians(angle_deg)
    return [float(radius * np.cos(angle)), float(radius * np.sin(angle)), height]


def test_lengths_of_six_cables_alone_are_said_to_identify_nothing(tmp_path: Path) -> None:
    """Six lengths fit some pose for any stiffness: there is nothing left to compare."""
    content = yaml.safe_load((ROOT / "configs/gachon_8_6.yaml").read_text())
    content["winches"] = content["winches"][:6]
    content["outlets_mm"] = [around(600.0, 120 * k + 90, 1000.0) for k in (0, 0, 1, 1, 2, 2)]
    content["anchors_mm"] = [around(120.0, 120 * k + 30, 0.0) for k in (0, 1, 1, 2, 2, 0)]
    content["platform"] |= {"mass_kg": 4, "home": {"position_mm": [0, 0, 300]}}
    content["workspace"] = {"lower_mm": [-150, -150, 150], "upper_mm": [150, 150, 450]}
    content["cables"]["min_tension_n"] = 1
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(content))
    data = samples(load_rig(tmp_path / "rig.yaml"), 40, tilt=0.05, seed=5).measured
    write_samples(tmp_path / "data.csv", data, poses=False)
    done = call("calibrate", "rig", tmp_path / "rig.yaml", tmp_path / "data.csv", "--json")
    assert done.code in (0, 3), done
    assert "the stiffness of the cables" in json.loads(done.out)["not_identified"]


@pytest.mark.slow  # a jog, planned and run
def test_the_recorded_session_calibrates_its_rig_to_a_tenth_of_a_millimetre(
    rig: Rig, tmp_path: Path
) -> None:
    """Poses by the tracker, from images; the truth is the simulation's. Then a jog with it."""
    folder = tmp_path / "calibration"
    done = call("calibrate", "rig", RIG, SESSION / "places.csv", "-o", folder, "--json")
    assert done.code == 0, done
    (result,) = folder.glob("*.yaml")
    corrected = rig.with_calibration(load_result(result))
    truth = samples(rig, 20, tilt=0.05, seed=8, noise=0.0)
    winches, data = WinchMap(corrected), truth.measured
    lengths = winches.strained(winches.unstrained_from_counts(data.counts), data.tensions)
    found, _ = settled_poses_near(corrected, lengths, truth.positions, truth.rotations)
    assert np.linalg.norm(found - truth.positions, axis=1).max() < 0.2e-3
    motion = ("--by-mm", "0", "0", "2", "--no-scene", "--fast", "-o", tmp_path / "jog")
    jogged = call("jog", RIG, *motion, "--calibration", result, "--json")
    assert jogged.code == 0, jogged
    ran = json.loads((tmp_path / "jog" / "rig.json").read_text(encoding="utf-8"))
    assert ran["outlets_mm"] == json.loads(done.out)["outlets_mm"]


def test_pictures_of_the_recorded_session_show_the_poses_in_its_table(tmp_path: Path) -> None:
    """To the noise of a JPEG file; a table and images of different rigs would be far apart."""
    log = tmp_path / "poses.csv"
    assert call("track", RIG, SESSION / "pictures", "-o", log).code == 0
    tables = [
        np.genfromtxt(path, delimiter=",", names=True, usecols=columns, max_rows=6)
        for path, columns in (
            (log, ("x_mm", "y_mm", "z_mm")),
            (SESSION / "places.csv", ("x_mm", "y_mm", "z_mm")),
        )
    ]
    for axis in ("x_mm", "y_mm", "z_mm"):
        assert tables[0][axis] == pytest.approx(tables[1][axis], abs=0.5)


def test_a_result_that_is_not_good_enough_exits_with_3_and_says_what_to_do(file: Path) -> None:
    done = call("calibrate", "rig", RIG, file, "--wanted-mm", "0.01")
    assert done.code == 3
    assert "not good enough" in done.out
    assert "next" in done.out


def changed(file: Path, tmp_path: Path, how: str) -> Path:
    lines = file.read_text(encoding="utf-8").splitlines()
    names = lines[0].split(",")
    if how == "few":
        lines = lines[:6]
    elif how == "nan":
        values = lines[3].split(",")
        values[names.index("x_mm")] = "nan"
        lines[3] = ",".join(values)
    elif how == "text":
        lines[5] = "lost," + lines[5].split(",", 1)[1]
    elif how == "short":
        lines[4] = lines[4].rsplit(",", 1)[0]
    elif how == "column":
        lines = [line.split(",", 1)[1] for line in lines]
    elif how == "time":
        lines = [f"{'time_s' if k == 0 else -k},{line}" for k, line in enumerate(lines)]
    elif how == "quaternion":
        values = lines[2].split(",")
        values[names.index("qw")] = "0.5"
        lines[2] = ",".join(values)
    elif how == "more":
        lines = [f"{line},{'actual_9_counts' if k == 0 else 0}" for k, line in enumerate(lines)]
    elif how == "twice":
        lines[0] = lines[0].replace("actual_2_counts", "actual_1_counts")
    elif how == "empty":
        lines = lines[:1]
    elif how == "deviation":
        stds = "std_x_mm,std_y_mm,std_z_mm,std_rx_deg,std_ry_deg,std_rz_deg"
        lines = [f"{line},{stds if k == 0 else '0,1,1,1,1,1'}" for k, line in enumerate(lines)]
    path = tmp_path / f"{how}.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("how", "what"),
    [
        ("few", "only 5 stationary samples"),
        ("nan", "line 4, x_mm: 'nan' is not a finite number"),
        ("text", "line 6, actual_1_counts: 'lost' is not a finite number"),
        ("short", "line 5 has 22 values for 23 columns"),
        ("column", "the column 'actual_1_counts' is missing"),
        ("time", "line 3: time_s does not increase"),
        ("quaternion", "line 3: the quaternion's length is"),
        ("more", "the rig has 8 cables, the file has more"),
        ("twice", "the column 'actual_1_counts' appears twice"),
        ("empty", "the file holds no values"),
        ("deviation", "a standard deviation is not positive"),
    ],
)
def test_an_unusable_file_is_refused_with_its_location(
    file: Path, tmp_path: Path, how: str, what: str
) -> None:
    folder = tmp_path / "out"
    done = call("calibrate", "rig", RIG, changed(file, tmp_path, how), "-o", folder, "--json")
    assert done.code == 2, done
    assert what in json.loads(done.out)["what"]
    assert not list(folder.glob("*")) if folder.exists() else True


def test_a_file_that_is_named_twice_is_refused(file: Path) -> None:
    done = call("calibrate", "rig", RIG, file, file.parent / ".." / file.parent.name / file.name)
    assert done.code == 2, done
    assert "given twice" in done.err


def test_poses_that_no_such_rig_can_hold_are_reported_with_file_and_rig(tmp_path: Path) -> None:
    """x in inches: near the middle of the rig, and the outlets that would fit cannot hold home."""
    names, *lines = (SESSION / "places.csv").read_text(encoding="utf-8").splitlines()
    x, rows = names.split(",").index("x_mm"), [line.split(",") for line in lines]
    for row in rows:
        row[x] = f"{float(row[x]) / 25.4:.6f}"
    path = tmp_path / "inch.csv"
    path.write_text("\n".join([names, *map(",".join, rows)]) + "\n", encoding="utf-8")
    folder = tmp_path / "out"
    done = call("calibrate", "rig", RIG, path, "-o", folder, "--json")
    assert done.code == 2, done
    document = json.loads(done.out)
    assert str(RIG) in document["what"]
    assert str(path) in document["where"]
    assert document["next_step"].startswith("check units, the sign of the counts")
    assert not list(folder.glob("*"))


def test_a_file_instead_of_the_folder_is_reported_with_a_next_step(file: Path) -> None:
    other = file.with_name("other")
    other.write_text("mine")
    done = call("calibrate", "rig", RIG, file, "-o", other, "--json")
    assert done.code == 2, done
    assert "name a folder (not a file)" in json.loads(done.out)["next_step"]


def test_a_run_of_another_rig_is_refused(finished_run: Path) -> None:
    done = call("calibrate", "rig", RIG, finished_run, "--json")
    assert done.code == 2
    assert "this run was made with outlets" in json.loads(done.out)["what"]


def test_the_options_have_the_deviations_that_poses_are_chosen_by() -> None:
    """The options have other units, so the defaults are repeated there."""
    options = {one.name: one for one in fields(rig_verb.Deviations)}
    for group, deviation in DEFAULT_DEVIATIONS.items():
        percent = group in ("drum_scale", "stiffness")
        unit, scale = ("percent", 1e2) if percent else ("mm", 1e3)
        if group == "swivel_zeros":
            unit, scale = "deg", float(np.degrees(1.0))
        assert options[f"{group}_{unit}"].default == pytest.approx(deviation * scale), group


def test_a_run_with_too_few_rests_is_reported(finished_run: Path) -> None:
    """Without a camera; it rests at most at its start and its goal."""
    done = call("calibrate", "rig", ROOT / "configs/gachon_8_6.yaml", finished_run, "--json")
    assert done.code == 2
    answer = json.loads(done.out)
    assert "stationary samples; 10 required" in answer["what"]
    assert "cdpr calibrate poses" in answer["next_step"]


def test_a_folder_that_is_no_run_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "missing.csv"):
        assert call("calibrate", "rig", RIG, path).code == 2


def test_lengths_alone_in_a_file_need_no_poses(rig: Rig, tmp_path: Path) -> None:
    path = tmp_path / "lengths.csv"
    data = samples(rig, 30, tilt=0.1, seed=6).measured
    write_samples(path, data, poses=False)
    done = call("calibrate", "rig", RIG, path, "--known", "outlets", "--json")
    assert done.code in (0, 3), done
    document = json.loads(done.out)
    assert not document["with_poses"]
    assert document["held_out_mm"] < document["before_mm"]
    assert np.array(document["outlets_mm"]) == pytest.approx(rig.outlets * 1e3)


@pytest.mark.slow  # compiled planner
def test_poses_for_measuring_are_planned_and_their_plan_holds(tmp_path: Path) -> None:
    plan = tmp_path / "measure.json"
    arguments = (
        "--count",
        "10",
        "--candidates",
        "25",
        "--tilt-deg",
        "5",
        "--reserve-n",
        "3",
        "--json",
    )
    done = call("calibrate", "poses", RIG, ROOT / "configs/turn.yaml", "-o", plan, *arguments)
    assert done.code == 0, done
    document = json.loads(done.out)
    assert len(document["stops"]) == 10
    assert 2.0 < max(document["turned_deg"]) <= 5.0 + 1e-9
    assert call("check", plan).code == 0
    assert call("calibrate", "poses", RIG, ROOT / "configs/turn.yaml", "-o", plan).code == 2
