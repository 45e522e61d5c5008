"""Tensions, swivel angles and an IMU in rig calibration, against independent formulas."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.geometry.calibrate import RigCalibration, fit_rig
from calibration.geometry.identifiability import identified, uncertainty_of_rig
from calibration.geometry.measurements import RigMeasurements, joined, read_rig_data
from calibration.geometry.model import RigModel
from calibration.geometry.parameters import DEFAULT_DEVIATIONS, Parameters
from calibration.geometry.quality import judge_rig
from calibration.geometry.report import number_rows, rig_page
from calibration.geometry.result import RigResult, nominal_geometry, rig_result
from model.errors import BadInput
from model.pose import matrix_from_rotation_vector
from model.rig import Rig, load_rig
from model.winches import WinchMap
from tests.calibration.rig_places import write_samples
from tests.calibration.synthetic_rig import (
    LENGTH_NOISE,
    SPREAD,
    BuiltRig,
    built_rig,
    measured,
    only,
)
from tests.cli.program import call

ROOT = Path(__file__).resolve().parents[2]
PER_CABLE = {g: d for g, d in DEFAULT_DEVIATIONS.items() if g != "stiffness"}
PER_CABLE |= {"cable_stiffness": SPREAD["stiffness"][0], "imu_mounting": float(np.radians(1.0))}
NO_MOUNTING = {g: d for g, d in PER_CABLE.items() if g != "imu_mounting"}
TODAY = date(2026, 11, 23)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig(ROOT / "configs/hall_10_6.yaml")


@pytest.fixture(scope="module")
def built(rig: Rig) -> BuiltRig:
    return built_rig(rig, 1)


@pytest.fixture(scope="module")
def data(built: BuiltRig) -> RigMeasurements:
    return measured(built, 40, 2)


@pytest.fixture(scope="module")
def found(rig: Rig, data: RigMeasurements) -> RigCalibration:
    return fit_rig(rig, data, PER_CABLE, LENGTH_NOISE)


def inside(result: RigCalibration, built: BuiltRig, group: str) -> float:
    """Share of a group's parameters within their 95 % intervals."""
    columns = result.parameters.slices()[group]
    off = result.fit.values[columns] - built.values((group,))
    return float(np.mean(np.abs(off) < result.uncertainty.half_widths[columns]))


@given(seed=st.integers(0, 10**6))
@settings(max_examples=5)
def test_the_truth_leaves_nothing_over(rig: Rig, seed: int) -> None:
    """Without noise, lengths, swivel angles and verticals agree with independent formulas."""
    built = built_rig(rig, seed)
    data = measured(built, 6, seed + 1, noise=0.0)
    parameters = Parameters.of(rig, PER_CABLE)
    values = built.values(parameters.groups)
    residuals = RigModel(parameters, data).residuals(values, data.positions, data.rotations)
    assert residuals.shape == (6, 2 * rig.cable_count + 2)
    assert np.abs(residuals).max() < 1e-12


@given(seed=st.integers(0, 10**6))
@settings(max_examples=5)
def test_derivatives_are_those_of_finite_differences(rig: Rig, seed: int) -> None:
    data = measured(built_rig(rig, seed), 2, seed + 1)
    parameters = Parameters.of(rig, PER_CABLE)
    model, at = RigModel(parameters, data), (data.positions, data.rotations)
    values = built_rig(rig, seed + 2).values(parameters.groups)
    line, step = model.linearised(values, *at), 1e-6
    assert np.array_equal(line.residuals, model.residuals(values, *at))
    for k, nudge in enumerate(step * np.eye(len(parameters))):
        change = model.residuals(values + nudge, *at) - model.residuals(values - nudge, *at)
        assert line.by_values[:, :, k] == pytest.approx(change / (2.0 * step), abs=1e-5)
    for k, nudge in enumerate(step * np.eye(3)):
        ahead, back = (model.residuals(values, at[0] + s * nudge, at[1]) for s in (1.0, -1.0))
        assert line.by_pose[:, :, k] == pytest.approx((ahead - back) / (2.0 * step), abs=1e-5)
        ahead, back = (
            model.residuals(values, at[0], matrix_from_rotation_vector(s * nudge) @ at[1])
            for s in (1.0, -1.0)
        )
        assert line.by_pose[:, :, 3 + k] == pytest.approx((ahead - back) / (2.0 * step), abs=1e-5)


def test_every_number_is_found_with_its_interval(built: BuiltRig, found: RigCalibration) -> None:
    shares = {group: inside(found, built, group) for group in found.parameters.groups}
    assert np.mean(list(shares.values())) >= 0.9, shares
    stated = found.intervals
    for i, true in enumerate(built.stiffness, start=1):
        assert stated[f"stiffness_{i}_n"].value == pytest.approx(true, rel=0.05)
        assert stated[f"stiffness_{i}_n"].half_width < 0.05 * true
    zeros = np.degrees(built.off["swivel_zeros"])
    rotated = np.degrees(built.off["imu_mounting"])
    for key, true in {"swivel_zero_3_deg": zeros[2], "imu_mounting_x_deg": rotated[0]}.items():
        assert abs(stated[key].value - true) < 2.0 * stated[key].half_width < 1.0


def test_a_result_holds_each_cables_stiffness_and_applies_it(
    rig: Rig, found: RigCalibration, data: RigMeasurements
) -> None:
    quality = judge_rig(found, 1e-3, 0.0)
    document = rig_result(found, quality, "rig", TODAY)
    again = RigResult.model_validate(document.model_dump())
    corrected = rig.with_calibration(again)
    assert corrected.cable_stiffness == pytest.approx(found.geometry.stiffness)
    assert [w.cable_stiffness_n for w in corrected.document.winches] == document.cable_stiffness_n
    winches = WinchMap(corrected)
    lengths = winches.strained(winches.unstrained_from_counts(data.counts), data.tensions)
    by_fit = RigModel(found.parameters, data).counted.lengths(found.geometry)
    assert lengths == pytest.approx(by_fit, abs=30e-6)  # a count is 12 micrometres
    assert document.sensor_residuals_deg.keys() >= {"swivel 1", "swivel 10", "IMU 1", "IMU 2"}
    assert all(0.05 < x < 0.15 for x in document.sensor_residuals_deg.values())
    page = rig_page(found, quality, "rig", "2026-11-23")
    for title in (
        "Stiffness of each cable [N]",
        "Zeros of swivel angles [°]",
        "Mounting of the IMU [°]",
        "Residuals of swivel angles and IMU",
    ):
        assert title in page
    assert {row[0] for row in number_rows(found)} == found.intervals.keys()


def test_a_common_factor_keeps_the_differences_of_the_rig_file(
    rig: Rig, found: RigCalibration
) -> None:
    result = rig_result(found, judge_rig(found, 1e-3, 0.0), "rig", TODAY)
    corrected = rig.with_calibration(result)
    doubled = Parameters.of(corrected, {"stiffness": 0.2}).geometry(np.array([np.log(2.0)]))
    assert doubled.stiffness == pytest.approx(2.0 * found.geometry.stiffness)


def test_results_of_rig_files_without_the_new_key_still_apply(rig: Rig) -> None:
    """The basis of a result does not include absent keys."""
    (winch, *_) = nominal_geometry(rig.document)["winches"]
    assert "cable_stiffness_n" not in winch
    other = rig.document.winches[0].model_copy(update={"cable_stiffness_n": 5.0})
    changed = rig.document.model_copy(update={"winches": [other, *rig.document.winches[1:]]})
    assert nominal_geometry(changed) != nominal_geometry(rig.document)


def widths(rig: Rig, data: RigMeasurements) -> dict[str, float]:
    """Half widths of the geometry's parameters, by name."""
    own = {"swivel_zeros": data.swivels, "imu_mounting": data.verticals}
    absent = {group for group, values in own.items() if not np.isfinite(values).any()}
    sought = {group: d for group, d in PER_CABLE.items() if group not in absent}
    parameters = Parameters.of(rig, sought)
    fit, observability = identified(parameters, data, LENGTH_NOISE)
    found = uncertainty_of_rig(parameters, data, fit, observability).half_widths
    names = zip(parameters.names, found.tolist(), strict=True)
    return {n: w for n, w in names if not n.startswith(("swivel", "imu"))}


def test_a_sensor_more_does_not_widen_the_geometry(rig: Rig) -> None:
    """In clean data; changes of unidentified directions may move single values slightly."""
    for seed in range(3):
        data = measured(built_rig(rig, seed), 30, 50 + seed, noise=0.3)
        before = widths(rig, only(data))
        for sensors in (("verticals",), ("swivels",), ("swivels", "verticals")):
            after = widths(rig, only(data, *sensors))
            ratios = np.array([after[name] / before[name] for name in before])
            assert ratios.max() < 1.03, sensors
            assert ratios.mean() < 1.0, sensors


def test_swivel_angles_find_outlets_better(rig: Rig, data: RigMeasurements) -> None:
    alone, more = (widths(rig, only(data, *sensors)) for sensors in ((), ("swivels",)))
    outlets = [name for name in alone if name.startswith("outlet")]
    assert np.mean([more[n] for n in outlets]) < 0.95 * np.mean([alone[n] for n in outlets])


def test_a_wrong_reading_is_named_and_left_out(rig: Rig, data: RigMeasurements) -> None:
    swivels, verticals = data.swivels.copy(), data.verticals.copy()
    swivels[7, 3] += np.radians(10.0)
    verticals[20] = matrix_from_rotation_vector([0.2, 0.0, 0.0]) @ verticals[20]
    spoiled = replace(data, swivels=swivels, verticals=verticals)
    result = fit_rig(rig, spoiled, PER_CABLE, LENGTH_NOISE)
    assert set(result.measured.unused) == {"sample 7", "sample 20"}
    assert "swivel 4 is " in result.measured.unused["sample 7"]
    assert "IMU " in result.measured.unused["sample 20"]
    assert "° off" in result.measured.unused["sample 20"]


def test_an_imu_whose_mounting_is_not_asked_for_is_found_to_scatter(
    rig: Rig, data: RigMeasurements
) -> None:
    """It is rotated by a degree, ten times what is stated."""
    for sought, good in ((NO_MOUNTING, False), (PER_CABLE, True)):
        result = fit_rig(rig, data, sought, LENGTH_NOISE)
        reasons = judge_rig(result, 1e-2, 0.0).verdict.reasons
        assert any("IMU" in reason and "stated" in reason for reason in reasons) != good


def test_whole_turns_of_a_swivel_encoder_do_not_matter(
    rig: Rig, data: RigMeasurements, found: RigCalibration
) -> None:
    rotated = replace(data, swivels=data.swivels + 2.0 * np.pi * np.arange(-5.0, 5.0))
    fit, _ = identified(found.parameters, rotated, LENGTH_NOISE)
    assert fit.values == pytest.approx(found.fit.values, abs=1e-7)


def test_sensors_of_a_part_of_the_data_count_there(rig: Rig, data: RigMeasurements) -> None:
    """As with two files, one without their columns: the same as leaving them out there."""
    first = np.arange(len(data)) < 20
    parts = [data.part(first), only(data.part(~first))]
    both = replace(
        joined(parts), swivel_deviation=data.swivel_deviation, imu_deviation=data.imu_deviation
    )
    parameters = Parameters.of(rig, PER_CABLE)
    assert np.isinf(RigModel(parameters, both).deviations(LENGTH_NOISE)[20:, 10:]).all()
    copy = replace(parts[0], names=tuple(f"copy {k}" for k in range(20)))
    without = replace(only(parts[0]), names=tuple(f"other {k}" for k in range(20)))
    assert len(joined([*parts, copy]).unused) == 20
    assert len(joined([*parts, without]).unused) == 0
    outlets = [
        sum(w for n, w in widths(rig, part).items() if n.startswith("outlet"))
        for part in (only(data), both, data)
    ]
    assert outlets[0] > outlets[1] > outlets[2]


def test_what_is_missing_for_a_stiffness_is_said(rig: Rig, built: BuiltRig) -> None:
    steady = only(measured(built, 40, 2, steady=3))
    result = fit_rig(rig, steady, NO_MOUNTING, LENGTH_NOISE)
    assert any(
        line.startswith("for the stiffness of cable 3, tensions that differ more are missing")
        for line in result.not_identified
    )
    widths = [result.intervals[f"stiffness_{i}_n"].half_width for i in range(1, 11)]
    assert widths[2] > 0.15 * rig.cable_stiffness[2] > 3.0 * np.median(widths)
    assert result.geometry.stiffness[0] == pytest.approx(built.stiffness[0], rel=0.05)
    blind = replace(steady, tensions=np.full_like(steady.tensions, np.nan))
    lines = fit_rig(rig, blind, NO_MOUNTING, LENGTH_NOISE).not_identified
    assert any("tensions are missing at 40 poses" in line for line in lines)
    assert any("tension_1_n" in line for line in lines)


def test_impossible_sensor_data_are_refused(rig: Rig, data: RigMeasurements) -> None:
    points = load_rig(ROOT / "configs/gachon_8_6.yaml")
    eight = {k: getattr(data, k)[:, :8] for k in ("counts", "tensions", "swivels")}
    home = np.tile(points.home.position, (len(data), 1))
    with pytest.raises(BadInput, match="the rig file has no pulleys"):
        fit_rig(points, replace(data, **eight, positions=home), NO_MOUNTING, LENGTH_NOISE)
    with pytest.raises(BadInput, match="no data have its columns"):
        fit_rig(rig, only(data), PER_CABLE, LENGTH_NOISE)
    with pytest.raises(BadInput, match=r"IMU's vertical is 1[678].° from that of the pose"):
        fit_rig(rig, replace(data, verticals=-data.verticals), PER_CABLE, LENGTH_NOISE)


def written(path: Path, data: RigMeasurements, unit: str = "m_s2", size: float = 9.81) -> Path:
    """The measurements with all sensors as a CSV file."""
    write_samples(path, data)
    lines = path.read_text(encoding="utf-8").splitlines()
    m = data.swivels.shape[1]
    names = [f"swivel_{i}_deg" for i in range(1, m + 1)] + [f"accel_{a}_{unit}" for a in "xyz"]
    more = np.concatenate([np.degrees(data.swivels), size * data.verticals], axis=1)
    rows = [",".join(names), *(",".join(f"{x:.9g}" for x in row) for row in more)]
    joint = [f"{line},{row}" for line, row in zip(lines, rows, strict=True)]
    path.write_text("\n".join(joint) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(("unit", "size"), [("m_s2", 9.81), ("g", 1.01)])
def test_sensors_are_read_from_their_columns(
    data: RigMeasurements, tmp_path: Path, unit: str, size: float
) -> None:
    back = read_rig_data(written(tmp_path / "all.csv", data, unit, size), 10)
    assert back.swivels == pytest.approx(data.swivels, abs=1e-7)
    assert back.verticals == pytest.approx(data.verticals, abs=1e-7)
    assert back.data_hash != only(back).data_hash


def test_an_acceleration_that_is_not_gravitys_is_refused(
    data: RigMeasurements, tmp_path: Path
) -> None:
    with pytest.raises(BadInput, match=r"line 2: accel_x_m_s2.* are 1 in magnitude; at rest it"):
        read_rig_data(written(tmp_path / "wrong.csv", data, "m_s2", 1.0), 10)


def ones(folder: Path, head: str) -> Path:
    """A file of one sample with these columns."""
    path = folder / "samples.csv"
    path.write_text(f"{head}\n{','.join(['1'] * len(head.split(',')))}\n")
    return path


@pytest.mark.parametrize(
    ("names", "missing"),
    [
        *((names, "'x_mm', 'y_mm', 'z_mm'") for names in ("x_m,y_m,z_m", "x,y,z", "X [inch]")),
        ("qw,qx,qy,qz", "'x_mm', 'y_mm', 'z_mm'"),
        ("x_mm,y_mm,z_mm,q_w,q_x,q_y,q_z", "'qw', 'qx', 'qy', 'qz'"),
        ("tension_1_kn,tension_2_kn", "'tension_1_n', 'tension_2_n'"),
        ("swivel_1_rad", "'swivel_1_deg', 'swivel_2_deg'"),
        ("accel_x,accel_y,accel_z", "'accel_x_m_s2', 'accel_y_m_s2', 'accel_z_m_s2'"),
        *((f"accel_x{unit}", "'accel_x_m_s2'") for unit in ("_m/s2", "_m_s^2", " [m/s²]")),
        ("accel_y_g,accel_z_g", "'accel_x_g'"),
    ],
)
def test_a_measurement_in_another_unit_is_refused_with_the_columns(
    tmp_path: Path, names: str, missing: str
) -> None:
    """Not ignored, as other columns are."""
    head = f"actual_1_counts,actual_2_counts,temperature,encoder_x_m,x_axis,{names}"
    path = ones(tmp_path, head)
    with pytest.raises(BadInput, match=f"{missing}.* missing") as caught:
        read_rig_data(path, 2)
    assert (
        caught.value.next_step == f"name it in the first line, which has: {head.replace(',', ', ')}"
    )


@pytest.mark.parametrize(
    "names",
    ["roll_deg,pitch_deg,yaw_deg", "rx_deg,ry_deg,rz_deg", "Rot X [rad]", "std_rx_deg"],
)
def test_rotations_in_other_columns_are_refused_with_those_to_give(
    tmp_path: Path, names: str
) -> None:
    """Half of the measurement would be lost without a word."""
    path = ones(tmp_path, f"actual_1_counts,actual_2_counts,x_mm,y_mm,z_mm,{names}")
    with pytest.raises(BadInput, match=r"is of a rotation, but .*qw, qx, qy, qz") as caught:
        read_rig_data(path, 2)
    assert caught.value.next_step.startswith("give rotations as unit quaternions qw, qx, qy, qz")
    path = ones(tmp_path, "actual_1_counts,actual_2_counts,x_mm,y_mm,z_mm,rate_z,ry")
    with pytest.raises(BadInput, match="'ry'"):
        read_rig_data(path, 2)


def test_the_program_finds_and_applies_them(
    rig: Rig, built: BuiltRig, data: RigMeasurements, tmp_path: Path
) -> None:
    path = ROOT / "configs/hall_10_6.yaml"
    file, out = written(tmp_path / "all.csv", data), tmp_path / "out"
    options = ("--stiffness-per-cable", "--imu-mounting-deg", 1, "--swivel-deg", 0.1)
    done = call("calibrate", "rig", path, file, *options, "-o", out, "--json")
    assert done.code in (0, 3), done
    document = json.loads(done.out)
    assert document["cable_stiffness_n"] == pytest.approx(built.stiffness, rel=0.05)
    assert {"swivel_zero_10_deg", "imu_mounting_z_deg"} <= document["intervals"].keys()
    (result,) = out.glob("*.yaml")
    new = tmp_path / "new.yaml"
    assert call("calibrate", "apply", path, result, "-o", new).code == 0
    assert load_rig(new).cable_stiffness == pytest.approx(document["cable_stiffness_n"])


@given(st.lists(st.integers(0, 3), min_size=20, max_size=20))
@settings(max_examples=20, deadline=None)
def test_a_sample_is_named_by_its_line_in_the_file(
    tmp_path_factory: pytest.TempPathFactory, blank: list[int]
) -> None:
    """The operator deletes the line that a message names."""
    path = tmp_path_factory.getbasetemp() / "samples.csv"
    lines = [",".join(f"actual_{i}_counts" for i in range(1, 9))]
    for k, empty in enumerate(blank):
        lines += [""] * empty + [",".join([str(k)] * 8)]
    path.write_text("\n".join(lines) + "\n")
    found = read_rig_data(path, 8)
    for name, counts in zip(found.names, found.counts, strict=True):
        number = int(name.rpartition(", line ")[2])
        assert lines[number - 1] == ",".join([f"{counts[0]:.0f}"] * 8)
