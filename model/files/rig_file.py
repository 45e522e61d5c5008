"""The rig file: what a lab writes down once about its robot (YAML, strict, version 1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Literal, get_args

from pydantic import Field, ValidationInfo, field_validator

from model.files.documents import (
    LENSES,
    WHOLE_LARGEST,
    Document,
    Finding,
    LensCovariance,
    LensName,
    Name,
    NonNegative,
    Number,
    PoseCovariance,
    PoseDocument,
    PoseSlopes,
    Positive,
    PositiveVector,
    UnitVector,
    Vector,
    require_coefficients,
)
from model.files.simulation_file import SimulationDocument

# The part of the rig file that says which drives turn the winches.


Period = Annotated[int, Field(ge=1, le=1000)]
Identity = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
FileName = Annotated[str, Field(min_length=1)]

ODRIVE_LAST_NODE = 62
"""Of six bits; 63 is an ODrive without a node id."""


class Cia402Document(Document):
    """CANopen drives in cyclic synchronous position mode; all they need is set over the bus."""

    type: Literal["cia402"]
    profile: FileName = Field(
        default="cia402",
        description="what the drives have: cia402, epos4, nanotec-c5e, akd, elmo-gold, or the path"
        " of a YAML file",
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
        description="torque by current of the motors; ODrive's torque_constant, 8.27 / KV"
    )
    watchdog_ms: Annotated[float, Field(ge=10, le=1000)] | None = Field(
        default=None,
        description="axis0.config.watchdog_timeout of every drive; required for arming",
    )
    heartbeat_ms: Period = Field(default=100, description="axis0.config.can.heartbeat_msg_rate_ms")
    estimates_ms: Period = Field(default=10, description="axis0.config.can.encoder_msg_rate_ms")
    torques_ms: Period = Field(default=10, description="axis0.config.can.torques_msg_rate_ms")
    dbc: FileName | None = Field(
        default=None,
        description="ODrive's own DBC file of the firmware; left out: the one of cdpr",
    )
    endpoints: FileName | None = Field(
        default=None,
        description="flat_endpoints.json of the firmware; settings are read back only with it",
    )


DrivesDocument = Annotated[Cia402Document | OdriveDocument, Field(discriminator="type")]


# Families of fiducial tags by their names in rig files.


AprilTagFamily = Literal["tag16h5", "tag25h9", "tag36h10", "tag36h11"]
ArucoDictionary = Literal[
    "4X4_50", "4X4_100", "4X4_250", "4X4_1000",
    "5X5_50", "5X5_100", "5X5_250", "5X5_1000",
    "6X6_50", "6X6_100", "6X6_250", "6X6_1000",
    "7X7_50", "7X7_100", "7X7_250", "7X7_1000",
    "ARUCO_ORIGINAL", "ARUCO_MIP_36H12",
]  # fmt: skip
TagFamily = Literal[AprilTagFamily, ArucoDictionary]
#: What finds tags in images: OpenCV, or pyapriltags of the extra `apriltag`.
TagDetectorName = Literal["opencv", "apriltag"]

APRILTAG_FAMILIES: tuple[str, ...] = get_args(AprilTagFamily)
DETECTORS: tuple[str, ...] = get_args(TagDetectorName)
#: All that can be printed and found.
FAMILIES: tuple[str, ...] = APRILTAG_FAMILIES + get_args(ArucoDictionary)


def opencv_dictionary(family: str) -> str:
    """Name of OpenCV's constant for a family, such as ``DICT_APRILTAG_36H11``."""
    if family in APRILTAG_FAMILIES:
        return f"DICT_APRILTAG_{family.removeprefix('tag').upper()}"
    return f"DICT_{family}"


def drawn_upside_down(family: str) -> bool:
    """Whether OpenCV draws the family turned by 180° against the prints of its own project.

    It does so with the families of the AprilTag project, whose images labs print.
    """
    return family in APRILTAG_FAMILIES


_APRILTAGS = {"tag16h5": 30, "tag25h9": 35, "tag36h10": 2320, "tag36h11": 587}
_NAMED = {"ARUCO_ORIGINAL": 1024, "ARUCO_MIP_36H12": 250}


def tags_in(family: str) -> int:
    """How many tags a family has, numbered from 0."""
    named = _APRILTAGS | _NAMED
    return named[family] if family in named else int(family.split("_")[1])


Pixels = Annotated[int, Field(ge=64, le=16384)]


class PlatformDocument(Document):
    """The end-effector: a box about the platform frame's origin, its mass and home pose."""

    size_mm: PositiveVector
    mass_kg: Positive
    centre_of_mass_mm: Vector = [0.0, 0.0, 0.0]
    home: PoseDocument


class WorkspaceDocument(Document):
    """Box that the platform's origin may not leave, in the world frame."""

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
    """What all cables have in common."""

    radius_mm: NonNegative
    stiffness_n: Positive = Field(description="axial stiffness E·A")
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

    radius_mm: Positive
    feed_directions: Annotated[list[UnitVector], Field(min_length=1)] = Field(
        description="per cable: unit direction of travel of the cable where it enters the pulley,"
        " along the swivel axis"
    )


class WinchDocument(Document):
    """One winch and its drive."""

    node_id: Annotated[int, Field(ge=1, le=126)]
    drum_mm_per_rev: Positive
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


class MotionDocument(Document):
    """How the platform is moved along a plan."""

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


class TagDocument(PoseDocument):
    """One fiducial tag: its centre and orientation (x right, y up, z out of the print)."""

    id: Annotated[int, Field(ge=0, le=WHOLE_LARGEST)]
    size_mm: Positive = Field(description="side of the black square")


class TagsDocument(Document):
    """The tags on the platform (platform frame) and, optionally, on the frame (world)."""

    family: TagFamily = "tag36h11"
    detector: TagDetectorName = Field(
        default="opencv", description="apriltag: pyapriltags, of the extra `apriltag`"
    )
    platform: Annotated[list[TagDocument], Field(min_length=1)]
    frame: list[TagDocument] = []
    error_mm: NonNegative | None = Field(
        default=None,
        description="how far off corners of the platform's tags are, 95 %; calibrations write it",
    )


class CameraDocument(Document):
    """One camera: intrinsics (OpenCV) and pose (x right, y down, z along the view)."""

    name: Name
    width_px: Pixels
    height_px: Pixels
    fx_px: Positive
    fy_px: Positive
    cx_px: Number
    cy_px: Number
    lens: LensName = Field(default="pinhole", description="OpenCV's model of the lens")
    distortion: Annotated[list[Number], Field(max_length=14)] = Field(
        default=[],
        description="OpenCV order: k1 k2 p1 p2 k3 …; fisheye: k1 k2 k3 k4",
        validate_default=True,
    )
    world_from_camera: PoseDocument
    lens_covariance: LensCovariance | None = Field(
        default=None,
        description="of fx_px, fy_px, cx_px, cy_px and distortion; calibrations write it",
    )
    pose_covariance: PoseCovariance | None = Field(
        default=None, description="of world_from_camera, mm and deg; calibrations write it"
    )
    pose_by_lens: PoseSlopes | None = Field(
        default=None,
        description="how errors of the numbers of lens_covariance move world_from_camera, mm and"
        " deg; calibrations write it",
    )
    error_mm: NonNegative | None = Field(
        default=None,
        description="how far off platform and cables are measured, 95 %, by all errors that"
        " pictures share; used where calibrations do not state all of them",
    )
    rate_hz: Positive = 10.0

    @field_validator("distortion")
    @classmethod
    def _opencv_count(cls, distortion: list[float], info: ValidationInfo) -> list[float]:
        require_coefficients(info.data.get("lens", LENSES[0]), len(distortion))
        return distortion

    @field_validator("lens_covariance", "pose_by_lens")
    @classmethod
    def _one_a_number(
        cls, rows: list[list[float]] | None, info: ValidationInfo
    ) -> list[list[float]] | None:
        count = 4 + len(info.data.get("distortion", []))
        if rows is not None and len(rows[0]) != count:
            raise ValueError(f"needs {count} numbers a row: fx, fy, cx, cy and distortion")
        return rows


class RigDocument(Document):
    """A cable-driven parallel robot: geometry, winches, bus, tags, cameras."""

    schema_version: Literal[1]
    name: Name
    description: str = ""
    platform: PlatformDocument
    workspace: WorkspaceDocument
    outlets_mm: Annotated[list[Vector], Field(min_length=1)]
    anchors_mm: Annotated[list[Vector], Field(min_length=1)]
    outlets_error_mm: NonNegative | None = Field(
        default=None, description="how far off any of them is, 95 %; calibrations write it"
    )
    anchors_error_mm: NonNegative | None = Field(
        default=None, description="how far off any of them is, 95 %; calibrations write it"
    )
    cables: CableDocument
    pulleys: PulleysDocument | None = None
    winches: Annotated[list[WinchDocument], Field(min_length=1)]
    motion: MotionDocument = MotionDocument()
    bus: BusDocument
    drives: DrivesDocument = Cia402Document(type="cia402")
    tags: TagsDocument | None = None
    cameras: list[CameraDocument] = []
    simulation: SimulationDocument | None = None

    def rules(self) -> Sequence[Callable[[], list[Finding]]]:
        """Counts that do not agree, numbers given twice, a home pose outside the workspace."""
        return (
            self._enough_cables,
            self._an_anchor_each,
            self._a_winch_each,
            self._a_pulley_each,
            self._nodes_once,
            self._nodes_of_odrives,
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
        return [(("outlets_mm",), what)] if m < 6 else []

    def _an_anchor_each(self) -> list[Finding]:
        return self._one_each(("anchors_mm",), len(self.anchors_mm))

    def _a_winch_each(self) -> list[Finding]:
        return self._one_each(("winches",), len(self.winches))

    def _a_pulley_each(self) -> list[Finding]:
        if self.pulleys is None:
            return []
        return self._one_each(("pulleys", "feed_directions"), len(self.pulleys.feed_directions))

    def _one_each(self, place: tuple[str, ...], count: int) -> list[Finding]:
        m, things = len(self.outlets_mm), place[-1].removesuffix("_mm").replace("_", " ")
        return [(place, f"{count} {things} for {m} outlets")] if count != m else []

    def _nodes_once(self) -> list[Finding]:
        nodes = [(("winches", i, "node_id"), w.node_id) for i, w in enumerate(self.winches)]
        return _repeated("node_id", nodes)

    def _nodes_of_odrives(self) -> list[Finding]:
        if self.drives.type != "odrive":
            return []
        what = f"an ODrive has a node id from 0 to {ODRIVE_LAST_NODE}"
        return [
            (("winches", i, "node_id"), what)
            for i, winch in enumerate(self.winches)
            if winch.node_id > ODRIVE_LAST_NODE
        ]

    def _tags_once(self) -> list[Finding]:
        return _repeated("tag id", self._tag_ids())

    def _tags_of_the_family(self) -> list[Finding]:
        if self.tags is None:
            return []
        count = tags_in(self.tags.family)
        what = f"{self.tags.family} has the tags 0 to {count - 1}"
        return [(place, what) for place, number in self._tag_ids() if number >= count]

    def _tag_ids(self) -> list[tuple[tuple[str | int, ...], int]]:
        if self.tags is None:
            return []
        groups = {"platform": self.tags.platform, "frame": self.tags.frame}
        return [
            (("tags", group, i, "id"), tag.id)
            for group, tags in groups.items()
            for i, tag in enumerate(tags)
        ]

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
        box = zip(
            "xyz",
            self.workspace.lower_mm,
            self.platform.home.position_mm,
            self.workspace.upper_mm,
            strict=True,
        )
        return [
            (
                ("platform", "home", "position_mm"),
                f"{axis} = {value:g} mm is outside the workspace [{low:g}, {high:g}] mm",
            )
            for axis, low, value, high in box
            if not low <= value <= high
        ]

    def _simulation_fits(self) -> list[Finding]:
        if self.simulation is None:
            return []
        rates = {camera.name: camera.rate_hz for camera in self.cameras}
        return self.simulation.misfits(len(self.outlets_mm), self.pulleys is not None, rates)


def _repeated(
    kind: str,
    values: Sequence[tuple[tuple[str | int, ...], int]]
    | Sequence[tuple[tuple[str | int, ...], str]],
) -> list[Finding]:
    seen: set[int | str] = set()
    found: list[Finding] = []
    for place, value in values:
        if value in seen:
            found.append((place, f"{kind} {value!r} appears twice"))
        seen.add(value)
    return found
