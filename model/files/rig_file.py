"""The rig file: description of a robot, written once by its lab (YAML, strict, version 1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, ValidationInfo, field_validator

from model.files.camera_file import CameraDocument, TagsDocument
from model.files.documents import (
    WHOLE_LARGEST,
    Document,
    Finding,
    Name,
    NonNegative,
    PoseDocument,
    Positive,
    PositiveVector,
    UnitVector,
    Vector,
    in_schema,
)
from model.files.simulation_file import SimulationDocument

# The drives of the winches.


Period = Annotated[int, Field(ge=1, le=1000)]
Identity = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
FileName = Annotated[str, Field(min_length=1)]
PositionError = Annotated[
    NonNegative | None, Field(description="of any such position, 95 %; calibrations write it")
]


STIFFEST_N = 1e9
"""More than any cable's; 80 mm of steel wire rope has 3e8 N."""


def _in_newtons(stiffness: float) -> float:
    if stiffness > STIFFEST_N:
        raise ValueError(f"must be E·A in N, at most 1e9; {stiffness:g} may be E in Pa")
    return stiffness


Stiffness = Annotated[Positive, AfterValidator(_in_newtons), in_schema(maximum=STIFFEST_N)]

FEWEST_CABLES = 6
_one_a_cable = (Field(min_length=1), in_schema(minItems=FEWEST_CABLES))

ODRIVE_LAST_NODE = 62
"""Of six bits; 63 is an ODrive without a node id."""


class Cia402Document(Document):
    """CANopen drives in cyclic synchronous position mode, configured over the bus."""

    type: Literal["cia402"]
    profile: FileName = Field(
        default="cia402",
        description="drive profile: cia402, epos4, nanotec-c5e, akd, elmo-gold, or the path of a"
        " YAML file",
    )
    vendor_id: Identity | None = Field(
        default=None, description="required 1018h:01 of every drive; left out: not checked"
    )
    product_code: Identity | None = Field(
        default=None, description="required 1018h:02 of every drive; left out: not checked"
    )


class OdriveDocument(Document):
    """ODrives, firmware 0.6 or later, that speak CANSimple."""

    type: Literal["odrive"]
    motor_torque_constant_nm_a: Positive = Field(
        description="torque per current of the motors; ODrive's torque_constant, 8.27 / KV"
    )
    watchdog_ms: Annotated[float, Field(ge=10, le=1000)] | None = Field(
        default=None,
        description="axis0.config.watchdog_timeout of every drive; required for arming",
    )
    heartbeat_ms: Period = Field(default=100, description="axis0.config.can.heartbeat_msg_rate_ms")
    estimates_ms: Period = Field(default=10, description="axis0.config.can.encoder_msg_rate_ms")
    torques_ms: Period = Field(default=10, description="axis0.config.can.torques_msg_rate_ms")
    brake_opens_ms: Annotated[float, Field(ge=0, le=1000)] = Field(
        default=150.0,
        description="longest time from arming a drive until its brake is open; no drive counts as"
        " enabled before; not used where no winch has a brake",
    )
    dbc: FileName | None = Field(
        default=None,
        description="ODrive's own DBC file of the firmware; left out: the one of cdpr",
    )
    endpoints: FileName | None = Field(
        default=None,
        description="flat_endpoints.json of firmware and board; settings are read back only with"
        " it",
    )


DrivesDocument = Annotated[Cia402Document | OdriveDocument, Field(discriminator="type")]


class PlatformDocument(Document):
    """The end-effector: a box about the platform frame's origin, its mass and home pose."""

    size_mm: PositiveVector
    mass_kg: Positive
    centre_of_mass_mm: Vector = [0.0, 0.0, 0.0]
    home: PoseDocument


class WorkspaceDocument(Document):
    """Box within which the platform's origin stays, in the world frame."""

    lower_mm: Vector
    upper_mm: Vector

    @field_validator("upper_mm")
    @classmethod
    def _above_lower(cls, upper: list[float], info: ValidationInfo) -> list[float]:
        for axis, low, high in zip("xyz", info.data.get("lower_mm", ()), upper, strict=False):
            if low >= high:
                raise ValueError(f"{axis} = {high:g} must be more than lower_mm's {low:g}")
        return upper


class CableDocument(Document):
    """Properties that all cables share."""

    radius_mm: NonNegative
    stiffness_n: Stiffness = Field(description="axial stiffness E·A")
    min_tension_n: Positive
    max_tension_n: Positive

    @field_validator("max_tension_n")
    @classmethod
    def _above_min(cls, high: float, info: ValidationInfo) -> float:
        low = info.data.get("min_tension_n")
        if low is not None and low >= high:
            raise ValueError(f"must be more than min_tension_n ({low:g} N); it is {high:g} N")
        return high


class PulleysDocument(Document):
    """Swivelling pulleys at the outlets; left out, cables leave at the outlet points."""

    radius_mm: Positive = Field(
        description="to the cable's centre line: radius of the bare groove plus that of the cable"
    )
    feed_directions: Annotated[list[UnitVector], *_one_a_cable] = Field(
        description="per cable: unit direction of travel of the cable where it enters the pulley,"
        " along the swivel axis"
    )


class WinchDocument(Document):
    """One winch and its drive."""

    node_id: Annotated[int, Field(ge=1, le=126)]
    drum_mm_per_rev: Positive = Field(
        description="2π times the radius of the cable's centre line on the drum: that of the bare"
        " drum plus that of the cable"
    )
    gear_ratio: Positive = Field(default=1.0, description="motor turns for one drum turn")
    counts_per_rev: Annotated[int, Field(ge=1, le=WHOLE_LARGEST)] = Field(
        description="of the motor shaft"
    )
    direction: Literal[-1, 1] = Field(description="+1: positive counts pay cable out")
    home_counts: Annotated[int, Field(ge=-WHOLE_LARGEST, le=WHOLE_LARGEST)] = Field(
        default=0, description="drive position at the home pose"
    )
    drum_to_outlet_mm: NonNegative = Field(
        default=0.0, description="cable between drum and outlet, which also stretches"
    )
    encoder: Literal["absolute", "incremental"] = Field(
        default="incremental",
        description="absolute: the drive keeps its position without power",
    )
    max_speed_mm_s: Positive
    torque_constant_n: Positive = Field(description="cable tension at rated torque")
    brake: bool = Field(
        default=False, description="a brake that closes when the drive has no torque"
    )
    cable_stiffness_n: Stiffness | None = Field(
        default=None, description="E·A of its cable; left out, cables.stiffness_n"
    )


class MotionDocument(Document):
    """Limits of motion along a plan."""

    speed_mm_s: Positive = 20.0
    acceleration_mm_s2: Positive = 100.0
    jerk_mm_s3: Positive = 1000.0
    blend_tolerance_mm: NonNegative = Field(
        default=1.0,
        description="largest distance of a rounded corner from the planned one",
    )
    following_error_mm: Positive = Field(default=2.0, description="cable length; more is a fault")
    start_tolerance_mm: Positive = Field(
        default=1.0,
        description="cable length; largest distance from the plan's start at which a run starts",
    )
    stuck_travel_mm: Positive = Field(
        default=0.07,
        description="cable length that set-points may advance with a drive at rest, at least 2"
        " cycles; give 8/3 of the noise of positions or more",
    )
    stuck_speed_mm_s: Positive = Field(
        default=2.0,
        description="below this set-point speed, friction may hold a drive still",
    )


class BusDocument(Document):
    """The CAN bus, as python-can names it."""

    interface: Name
    channel: Annotated[str, Field(max_length=200)]
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
    cycle_ms: Annotated[float, Field(ge=1, le=100)] = 10.0


class RigDocument(Document):
    """A cable-driven parallel robot: geometry, winches, bus, tags, cameras."""

    schema_version: Literal[1]
    name: Name
    description: str = ""
    platform: PlatformDocument
    workspace: WorkspaceDocument
    outlets_mm: Annotated[list[Vector], *_one_a_cable]
    anchors_mm: Annotated[list[Vector], *_one_a_cable]
    outlets_error_mm: PositionError = None
    anchors_error_mm: PositionError = None
    platform_error_mm: PositionError = None
    cables: CableDocument
    pulleys: PulleysDocument | None = None
    winches: Annotated[list[WinchDocument], *_one_a_cable]
    motion: MotionDocument = MotionDocument()
    bus: BusDocument
    drives: DrivesDocument = Cia402Document(type="cia402")
    tags: TagsDocument | None = None
    cameras: list[CameraDocument] = []
    simulation: SimulationDocument | None = None

    def rules(self) -> Sequence[Callable[[], list[Finding]]]:
        """Counts, ends on a line, duplicates, sizes in metres, a home outside the workspace."""
        return (
            self._enough_cables,
            self._an_anchor_each,
            self._ends_off_a_line,
            self._cables_once,
            self._frame_size,
            self._platform_size,
            self._a_winch_each,
            self._a_pulley_each,
            self._nodes_once,
            self._winches_of_odrives,
            self._tags_once,
            self._tags_of_the_family,
            self._cameras_once,
            self._camera_names,
            self._home_inside,
            self._simulation_fits,
        )

    def _enough_cables(self) -> list[Finding]:
        m = len(self.outlets_mm)
        what = f"{m} outlets: a platform with six degrees of freedom needs 6 or more"
        return [(("outlets_mm",), what)] if m < FEWEST_CABLES else []

    def _an_anchor_each(self) -> list[Finding]:
        return self._one_each(("anchors_mm",), len(self.anchors_mm))

    def _ends_off_a_line(self) -> list[Finding]:
        """Cables that all meet one line exert no moment about it, at any pose."""
        ends = {"anchors_mm": self.anchors_mm}
        if self.pulleys is None:  # else the exits move off the line
            ends["outlets_mm"] = self.outlets_mm
        found: list[Finding] = []
        for key, points in ends.items():
            if len(points) < 3 or not (where := _point_or_line(points)):
                continue
            what = (
                f"all {len(points)} {key.removesuffix('_mm')} are {where}, about which the cables"
                " exert no moment: they cannot hold six degrees of freedom; use three or more"
                " points that are not on one line"
            )
            found.append(((key,), what))
        return found

    def _cables_once(self) -> list[Finding]:
        ends = list(zip(self.outlets_mm, self.anchors_mm, strict=False))
        return [
            (("anchors_mm", k), f"cable {k + 1} has the outlet and anchor of cable {first + 1}")
            for k, both in enumerate(ends)
            if (first := ends.index(both)) < k
        ]

    def _frame_size(self) -> list[Finding]:
        """A frame in metres, or anchors in the world frame."""
        if _point_or_line(self.outlets_mm):
            return []
        span, across = _span(self.outlets_mm), np.linalg.norm(np.ptp(self.outlets_mm, axis=0))
        if span < _SMALLEST_FRAME_MM:
            return [(("outlets_mm",), f"the outlets span only {span:g} mm{_IN_MM}")]
        away = np.linalg.norm(self.anchors_mm, axis=1)
        what = (
            f"cable {away.argmax() + 1}'s anchor is {away.max():.5g} mm from the platform's origin,"
            f" farther than the outlets from each other ({across:.5g} mm): give anchors in the"
            " platform frame, not the world frame, and in mm"
        )
        return [(("anchors_mm",), what)] if away.max() > across else []

    def _platform_size(self) -> list[Finding]:
        """A platform box in metres, which obstacles could enter, or its anchors."""
        edges, span = self.platform.size_mm, _span(self.anchors_mm)
        key = ("platform", "size_mm") if span > max(edges) else ("anchors_mm",)
        what = f"the anchors span {span:g} mm, the longest edge of platform.size_mm {max(edges):g}"
        if min(edges) < _THINNEST_PLATFORM_MM:
            key, what = ("platform", "size_mm"), f"an edge of {min(edges):g} mm is too thin"
        elif 1 / _MOST <= span / max(edges) <= _MOST or _point_or_line(self.anchors_mm):
            return []
        return [(key, what + _IN_MM)]

    def remarks(self) -> list[str]:
        """Values that are valid but unlikely, each with its key."""
        edges, span = self.platform.size_mm, _span(self.anchors_mm)
        box = (
            f"platform.size_mm: the longest edge is {max(edges):g} mm, but the anchors span"
            f" {span:g} mm; only this box and the cables are kept away from obstacles"
        )
        found = [box] if span > 20 * max(edges) else []
        for axis, edge, ends in zip("xyz", edges, np.transpose(self.anchors_mm), strict=True):
            middle = abs(ends.min() + ends.max()) / 2
            if middle > edge / 4 and np.abs(ends).max() > 0.75 * edge:  # not eyebolts on the box
                where = f"along {axis} their middle is {middle:.5g} mm from the platform's origin"
                hint = "about which the box is; give them in a frame at the box's centre"
                found.append(f"anchors_mm: {where}, {hint}")
        return found

    def _a_winch_each(self) -> list[Finding]:
        return self._one_each(("winches",), len(self.winches))

    def _a_pulley_each(self) -> list[Finding]:
        if self.pulleys is None:
            return []
        return self._one_each(("pulleys", "feed_directions"), len(self.pulleys.feed_directions))

    def _one_each(self, key: tuple[str, ...], count: int) -> list[Finding]:
        m, things = len(self.outlets_mm), key[-1].removesuffix("_mm").replace("_", " ")
        return [(key, f"{count} {things} for {m} outlets")] if count != m else []

    def _nodes_once(self) -> list[Finding]:
        nodes = [(("winches", i, "node_id"), w.node_id) for i, w in enumerate(self.winches)]
        return _repeated("node_id", nodes)

    def _winches_of_odrives(self) -> list[Finding]:
        if self.drives.type != "odrive":
            return []
        node = f"an ODrive of a rig has a node id from 1 to {ODRIVE_LAST_NODE}"
        encoder = "an ODrive shows no loss of power: its encoder must be absolute over the travel"
        winches = list(enumerate(self.winches))
        wrong = [(i, "node_id", node) for i, winch in winches if winch.node_id > ODRIVE_LAST_NODE]
        wrong += [(i, "encoder", encoder) for i, winch in winches if winch.encoder != "absolute"]
        return [(("winches", i, key), what) for i, key, what in wrong]

    def _tags_once(self) -> list[Finding]:
        return [] if self.tags is None else _repeated("tag id", self.tags.ids())

    def _tags_of_the_family(self) -> list[Finding]:
        return [] if self.tags is None else self.tags.misfits()

    def _cameras_once(self) -> list[Finding]:
        names = [(("cameras", i, "name"), camera.name) for i, camera in enumerate(self.cameras)]
        return _repeated("camera name", names)

    def _camera_names(self) -> list[Finding]:
        what = (
            "is part of file names and NAME=SOURCE: it must not contain / or = or begin with a dot"
        )
        return [
            (("cameras", i, "name"), what)
            for i, camera in enumerate(self.cameras)
            if set(camera.name) & set("/=") or camera.name.startswith(".")
        ]

    def _home_inside(self) -> list[Finding]:
        key, home = ("platform", "home", "position_mm"), self.platform.home.position_mm
        box = zip("xyz", self.workspace.lower_mm, home, self.workspace.upper_mm, strict=True)
        return [
            (key, f"{axis} = {value:g} mm is outside the workspace [{low:g}, {high:g}] mm")
            for axis, low, value, high in box
            if not low <= value <= high
        ]

    def _simulation_fits(self) -> list[Finding]:
        if self.simulation is None:
            return []
        rates = {camera.name: camera.rate_hz for camera in self.cameras}
        tags = {
            part: {tag.id for tag in getattr(self.tags, part, [])} for part in ("platform", "frame")
        }
        found = self.simulation.misfits(len(self.outlets_mm), self.pulleys is not None, rates)
        return found + self.simulation.tags.misfits(tags)


_ON_A_LINE_MM = 1e-3
"""Distance from a line that counts as on it."""
_SMALLEST_FRAME_MM, _THINNEST_PLATFORM_MM, _MOST = 50.0, 1.0, 200.0
"""Limits of any rig; the last one is the ratio of anchors' span and platform's longest edge."""
_IN_MM = ": write lengths in mm, not in m"


def _span(points: Sequence[Sequence[float]]) -> float:
    """The largest extent of points along an axis, [mm]."""
    return float(np.ptp(points, axis=0).max())


def _point_or_line(points: Sequence[Sequence[float]]) -> str:
    """Whether points, [mm], are all at one point or on one line, in words; else empty."""
    with np.errstate(over="ignore"):
        offsets = np.asarray(points) - np.asarray(points[0])
    size = float(np.abs(offsets).max())
    if size <= _ON_A_LINE_MM:
        return "at one point"
    if not np.isfinite(size):
        return ""
    offsets = offsets / size
    direction = offsets[np.argmax(np.abs(offsets).max(axis=1))]
    beside = np.linalg.norm(np.cross(offsets, direction), axis=1).max()
    return "on one line" if beside * size <= _ON_A_LINE_MM * np.linalg.norm(direction) else ""


def _repeated(
    kind: str, values: Sequence[tuple[tuple[str | int, ...], int | str]]
) -> list[Finding]:
    plain = [value for _, value in values]
    return [
        (key, f"{kind} {value!r} appears twice")
        for k, (key, value) in enumerate(values)
        if value in plain[:k]
    ]
