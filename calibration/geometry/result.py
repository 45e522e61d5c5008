"""Result file of a rig's geometry and winches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import date
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from calibration.geometry.calibrate import RigCalibration, workspace_poses
from calibration.geometry.quality import RigQuality
from calibration.results import ResultDocument, common_keys
from calibration.statistics import Interval
from model.errors import BadInput, Fault
from model.files.documents import (
    AnyNonNegative,
    AnyNumber,
    Finding,
    Positive,
    Vector,
    content_hash,
)
from model.files.rig_file import RigDocument
from model.pose import Array
from model.rig import Rig, rig_from_document
from model.winches import WinchMap

_WHAT = "outlets, anchors, pulleys, winches, cables or home pose"


class RigResult(ResultDocument):
    """Outlets, anchors, pulleys, winches and cables' stiffness, in the keys of the rig file."""

    order: ClassVar[int] = 3
    is_of_named_part: ClassVar[bool] = False

    kind: Literal["rig"] = "rig"
    outlets_mm: list[Vector]
    anchors_mm: list[Vector]
    outlets_error_mm: AnyNonNegative | None = Field(
        default=None, description="of their coordinates, 95 %, RMS; null: not calibrated"
    )
    anchors_error_mm: AnyNonNegative | None = Field(
        default=None, description="of their coordinates, 95 %, RMS; null: not calibrated"
    )
    pulley_radius_mm: Positive | None
    drums_mm_per_rev: list[Positive]
    stiffness_n: Positive = Field(description="E·A of a cable, or the mean where they differ")
    cable_stiffness_n: list[Positive] | None = Field(
        default=None, description="E·A of each cable; null: of all stiffness_n"
    )
    home_counts: list[AnyNumber] = Field(description="drive positions with the platform at home")
    groups: list[str] = Field(description="of parameters that were calibrated")
    not_identified: list[str] = Field(description="kept as in the rig file, in words")
    information: list[AnyNumber] = Field(
        description="of each direction, descending; below 1 the rig file is better"
    )
    places: int
    with_poses: bool = Field(description="false: from lengths alone")
    held_out_mm: AnyNonNegative = Field(description="RMS of held-out samples")
    before_mm: AnyNonNegative = Field(description="the same with the rig file as it is")
    level_mm: AnyNonNegative = Field(description="of the platform at its home orientation, 95 %")
    turned_mm: AnyNonNegative = Field(description="rotated by tilt_deg, 95 %")
    tilt_deg: AnyNonNegative
    reached_mm: list[Vector] = Field(
        description="true positions of the platform when the uncalibrated rig file puts it at the"
        " centre of the workspace and near its corners"
    )
    cable_residuals_mm: list[AnyNonNegative] = Field(description="RMS, one per cable")
    sensor_residuals_deg: dict[str, AnyNonNegative] = Field(
        default={}, description="RMS of swivel angles and of the IMU's vertical, by name"
    )

    @property
    def stated(self) -> dict[str, Interval]:
        """Estimates, by name with unit; a stiffness is not the middle of its interval."""
        values = {"stiffness_n": self.stiffness_n}
        each = self.cable_stiffness_n or [self.stiffness_n] * len(self.outlets_mm)
        values |= {f"stiffness_{i}_n": value for i, value in enumerate(each, start=1)}
        return {
            name: Interval.between(low, high, values.get(name))
            for name, (low, high) in self.intervals.items()
        }

    def rules(self) -> Sequence[Callable[[], list[Finding]]]:
        """Rules of every result, and one entry per cable."""
        return (*super().rules(), self._one_per_cable)

    def _one_per_cable(self) -> list[Finding]:
        cables = len(self.outlets_mm)
        keys = ("anchors_mm", "drums_mm_per_rev", "home_counts", "cable_residuals_mm")
        lists = {key: getattr(self, key) for key in (*keys, "cable_stiffness_n")}
        return [
            ((key,), f"has {len(entries)} entries, outlets_mm has {cables}")
            for key, entries in lists.items()
            if entries is not None and len(entries) != cables
        ]

    def apart_mm(self, other: Self) -> float:
        """RMS distance over the workspace between platform positions by both results, [mm].

        Outlets and anchors may differ by more where the data cannot separate them.

        Raises:
            BadInput: The results depend on different rig files.
        """
        if self.rests_on != other.rests_on:
            raise BadInput(
                "the results depend on different rig files",
                where=f"rig {self.name}, {self.date} and {other.date}",
                next_step="compare results made with the same rig file",
            )
        apart = np.array(other.reached_mm) - np.array(self.reached_mm)
        return float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))

    def corrected(self, rig: RigDocument) -> RigDocument:
        """The rig file's content with these values.

        Raises:
            BadInput: The result is of another rig, or applied already.
        """
        if self._is_applied(rig):
            raise BadInput(
                "this result is applied already: the rig has its values",
                where=f"calibration {self.kind} {self.name}, {self.date}",
                next_step="leave it out",
            )
        self.require_basis(nominal_geometry(rig), _WHAT)
        if len(self.outlets_mm) != len(rig.winches):
            raise BadInput(
                f"this result has {len(self.outlets_mm)} cables, the rig has {len(rig.winches)}",
                where=f"calibration {self.kind} {self.name}, {self.date}",
                next_step="run `cdpr calibrate rig` again; the rig file was changed since",
            )
        keys = ("outlets_error_mm", "anchors_error_mm")
        stated = {key: value for key in keys if (value := getattr(self, key)) is not None}
        stated["platform_error_mm"] = max(self.level_mm, self.turned_mm)
        return self._with_numbers(rig).model_copy(update=stated)

    def _is_applied(self, rig: RigDocument) -> bool:
        """Whether a rig that it changes has its values; home counts change with `cdpr home`."""
        parts = nominal_geometry(rig)
        if self.rests_on == content_hash(parts) or len(self.outlets_mm) != len(rig.winches):
            return False
        return nominal_geometry(self._with_numbers(rig)) == parts

    def _with_numbers(self, rig: RigDocument) -> RigDocument:
        return _with_numbers(
            rig,
            self.outlets_mm,
            self.anchors_mm,
            self.pulley_radius_mm,
            self.drums_mm_per_rev,
            self.stiffness_n,
            self.cable_stiffness_n,
            [round(home) for home in self.home_counts],
        )


def _with_numbers(
    rig: RigDocument,
    outlets_mm: list[list[float]],
    anchors_mm: list[list[float]],
    pulley_radius_mm: float | None,
    drums_mm_per_rev: list[float],
    stiffness_n: float,
    cable_stiffness_n: list[float] | None,
    home_counts: list[int],
) -> RigDocument:
    """The rig file's content with other values."""
    one_for_all: list[float | None] = [None] * len(rig.winches)
    winches = [
        winch.model_copy(
            update={"drum_mm_per_rev": drum, "home_counts": home, "cable_stiffness_n": stiffness}
        )
        for winch, drum, home, stiffness in zip(
            rig.winches,
            drums_mm_per_rev,
            home_counts,
            cable_stiffness_n or one_for_all,
            strict=True,
        )
    ]
    changes: dict[str, Any] = {
        "outlets_mm": outlets_mm,
        "anchors_mm": anchors_mm,
        "winches": winches,
        "cables": rig.cables.model_copy(update={"stiffness_n": stiffness_n}),
    }
    if rig.pulleys is not None and pulley_radius_mm is not None:
        changes["pulleys"] = rig.pulleys.model_copy(update={"radius_mm": pulley_radius_mm})
    return rig.model_copy(update=changes)


def rig_result(result: RigCalibration, quality: RigQuality, name: str, on: date) -> RigResult:
    """The result file's content.

    Raises:
        Fault: The fit is not physical.
    """
    rig, geometry = result.rig, result.geometry
    nominal = np.array([w.drum_mm_per_rev for w in rig.document.winches])
    drums = nominal * (1.0 + geometry.drum_scale)
    require_physical(drums, geometry.pulley_radius if rig.pulley_radius else None)
    numbers: dict[str, Any] = {
        "outlets_mm": _rows(geometry.outlets),
        "anchors_mm": _rows(geometry.anchors),
        "pulley_radius_mm": geometry.pulley_radius * 1e3 if rig.pulley_radius else None,
        "drums_mm_per_rev": [float(x) for x in drums],
        "stiffness_n": float(geometry.stiffness.mean()),
        "cable_stiffness_n": geometry.stiffness.tolist() if np.ptp(geometry.stiffness) else None,
    }
    data = result.measured
    return RigResult(
        **common_keys(
            name,
            on,
            data.data_hash,
            result.intervals,
            quality.verdict,
            data.unused,
            nominal_geometry(rig.document),
        ),
        **numbers,
        outlets_error_mm=_millimetres(result.error_of("outlets")),
        anchors_error_mm=_millimetres(result.error_of("anchors")),
        home_counts=_home_counts(result, numbers),
        groups=list(result.parameters.groups),
        not_identified=result.not_identified,
        information=[float(f"{x:.4g}") for x in result.observability.information],
        places=len(data),
        with_poses=result.held_out.poses,
        held_out_mm=quality.held_out * 1e3,
        before_mm=quality.before * 1e3,
        level_mm=quality.level * 1e3,
        turned_mm=quality.rotated * 1e3,
        tilt_deg=float(np.degrees(quality.tilt)),
        reached_mm=_rows(result.reached(*workspace_poses(rig, 0.0))),
        cable_residuals_mm=[float(x) * 1e3 for x in np.sqrt(np.mean(result.fit.cables**2, axis=0))],
        sensor_residuals_deg=dict(
            zip(result.fit.sensors, np.degrees(result.fit.sensor_rms).tolist(), strict=True)
        ),
    )


def require_physical(drums: Array, pulley_radius: float | None) -> None:
    """Requires positive sizes.

    Args:
        drums: Circumferences, shape (m,), [mm].
        pulley_radius: [m]; None without pulleys.

    Raises:
        Fault: The first one that is not.
    """
    wrong = np.flatnonzero(~(drums > 0.0))
    if len(wrong) == len(drums):
        raise Fault("all lengths change the other way: the sign of all counts is inverted")
    if len(wrong):
        cable = int(wrong[0])
        size = f"{drums[cable]:.1f} mm per revolution"
        raise Fault(f"the drum of cable {cable + 1} comes out as {size}")
    if pulley_radius is not None and not pulley_radius > 0.0:
        raise Fault(f"the radius of the pulleys comes out as {pulley_radius * 1e3:.1f} mm")


def nominal_geometry(rig: RigDocument) -> object:
    """The parts of a rig file that a rig's calibration takes as known, or corrects.

    Home counts are excluded: `cdpr home` changes them.
    """
    document = rig.model_dump(mode="json")
    parts = {key: document[key] for key in ("outlets_mm", "anchors_mm", "pulleys", "cables")}
    home_counts = {"home_counts"}
    winches = [
        {k: v for k, v in w.items() if k not in home_counts and v is not None}
        for w in document["winches"]
    ]
    return {**parts, "winches": winches, "home": document["platform"]["home"]}


def require_same_nominal(rig: Rig, others: Sequence[tuple[str, Rig]]) -> Rig:
    """The rig with the home counts common to all runs.

    Args:
        rig: As in its file.
        others: Names and rigs of the runs.

    Raises:
        BadInput: A run is from another rig, or the drives were homed again between runs.
    """
    for name, other in others:
        if nominal_geometry(other.document) != nominal_geometry(rig.document):
            raise BadInput(
                f"this run was made with {_WHAT} that differ from those of {rig.name!r}",
                where=name,
                why="it is from another rig, the rig file was changed since, or it was run with a"
                " calibration of the rig",
                next_step="pass the rig file that it was run with, without --calibration, in Python"
                " without rig.with_calibration()",
            )
        homes = [[w.home_counts for w in r.winches] for r in (other, others[0][1])]
        if homes[0] != homes[1]:
            raise BadInput(
                "the drives were homed again between these runs",
                where=f"{others[0][0]}, {name}",
                next_step="use runs made after the same `cdpr home`",
            )
    return others[0][1] if others else rig


def _millimetres(metres: float | None) -> float | None:
    return None if metres is None else metres * 1e3


def _rows(points: Array) -> list[list[float]]:
    return [[round(float(x) * 1e3, 6) for x in point] for point in points]


def _home_counts(result: RigCalibration, numbers: dict[str, Any]) -> list[float]:
    """Home counts at which the corrected rig has the calibrated cable lengths."""
    rig = result.rig
    before = [winch.home_counts for winch in rig.winches]
    corrected = rig_from_document(_with_numbers(rig.document, **numbers, home_counts=before))
    winches = WinchMap(corrected)
    beyond = result.at_home_counts - winches.home_unstrained
    return [float(h) for h in winches.home_counts - winches.counts_per_metre * beyond]
