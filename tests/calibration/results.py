"""Calibration results for tests."""

from __future__ import annotations

from datetime import date

from calibration.geometry.result import RigResult, nominal_geometry
from calibration.intrinsics.result import CameraResult
from calibration.results import CalibrationVerdict, common_keys
from calibration.statistics import Interval
from model.files.documents import content_hash
from model.rig import Rig


def camera_result_of(name: str = "front", fx: float = 905.0, size=(1280, 720)) -> CameraResult:
    verdict = CalibrationVerdict.of(0.4e-3, 1e-3, "at 1.5 m", [])
    intervals = {"fx_px": Interval(fx, 0.5), "cx_px": Interval(640.0, 0.7)}
    return CameraResult(
        **common_keys(name, date(2026, 3, 1), "ab" * 32, intervals, verdict, {"a.png": "is bad"}),
        width_px=size[0],
        height_px=size[1],
        fx_px=fx,
        fy_px=906.0,
        cx_px=640.0,
        cy_px=361.0,
        distortion=[-0.1, 0.04, 0.0, 0.0, 0.0],
        rms_px=0.1,
        distance_m=1.5,
        halves_apart_mm=0.2,
        covered=0.9,
        pictures_used=20,
        view_errors_px={"b.png": 0.1},
    )


def rig_result_of(name: str = "rig") -> RigResult:
    verdict = CalibrationVerdict.of(0.4e-3, 1e-3, "rotated by up to 5°", [])
    intervals = {"outlet_1_x_mm": Interval(1.0, 0.5)}
    return RigResult(
        **common_keys(name, date(2026, 3, 1), "ab" * 32, intervals, verdict, {}, {"outlets": 1}),
        outlets_mm=[[1.0, 0.0, 0.0]],
        anchors_mm=[[0.0, 0.0, 0.0]],
        pulley_radius_mm=None,
        drums_mm_per_rev=[300.0],
        stiffness_n=6e4,
        home_counts=[0.0],
        groups=["outlets"],
        not_identified=[],
        information=[2.0],
        places=20,
        with_poses=True,
        held_out_mm=0.2,
        before_mm=1.0,
        level_mm=0.3,
        turned_mm=0.4,
        tilt_deg=5.0,
        reached_mm=[[0.0, 0.0, 100.0]],
        cable_residuals_mm=[0.1],
    )


def rig_result_for(rig: Rig, name: str = "rig", by_mm: float = 0.1) -> RigResult:
    """A result made with a rig's file, with the first outlet moved along x."""
    document = rig.document
    outlets = [list(point) for point in document.outlets_mm]
    outlets[0][0] += by_mm
    basis = {"rests_on": content_hash(nominal_geometry(document))}
    cables = {
        "outlets_mm": outlets,
        "anchors_mm": document.anchors_mm,
        "drums_mm_per_rev": [winch.drum_mm_per_rev for winch in document.winches],
        "home_counts": [float(winch.home_counts) for winch in document.winches],
        "cable_residuals_mm": [0.1] * rig.cable_count,
        "stiffness_n": document.cables.stiffness_n,
    }
    return rig_result_of(name).model_copy(update=basis | cables)
