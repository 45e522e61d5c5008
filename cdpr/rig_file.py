"""The rig file: what a lab writes down once about its robot (YAML, strict, version 1)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from cdpr.document_types import (
    Document,
    NonNegative,
    Number,
    PoseDocument,
    Positive,
    PositiveVector,
    Vector,
)


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

    @model_validator(mode="after")
    def _ordered(self) -> WorkspaceDocument:
        if any(
            low >= high for low, high in zip(self.lower_mm, self.upper_mm, strict=True)
        ):
            raise ValueError("every lower_mm must be less than its upper_mm")
        return self


class CableDocument(Document):
    """What all cables have in common."""

    radius_mm: NonNegative
    stiffness_n: Positive = Field(description="axial stiffness E·A")
    min_tension_n: Positive
    max_tension_n: Positive

    @model_validator(mode="after")
    def _ordered(self) -> CableDocument:
        if self.min_tension_n >= self.max_tension_n:
            raise ValueError("min_tension_n must be less than max_tension_n")
        return self


class PulleysDocument(Document):
    """Swivelling pulleys at the outlets; left out, cables leave at the outlet points."""

    radius_mm: Positive
    feed_directions: Annotated[list[Vector], Field(min_length=1)] = Field(
        description="per cable: unit direction of travel of the cable where it enters the pulley,"
        " along the swivel axis"
    )

    @model_validator(mode="after")
    def _unit(self) -> PulleysDocument:
        for index, direction in enumerate(self.feed_directions):
            length = sum(x * x for x in direction) ** 0.5
            if abs(length - 1.0) > 1e-6:
                raise ValueError(
                    f"feed_directions[{index}] must have length 1; its length is {length:.6g}"
                )
        return self


class WinchDocument(Document):
    """One winch and its drive."""

    node_id: Annotated[int, Field(ge=1, le=126)]
    drum_mm_per_rev: Positive
    gear_ratio: Positive = Field(
        default=1.0, description="motor turns for one drum turn"
    )
    counts_per_rev: Annotated[int, Field(ge=1)] = Field(
        description="of the motor shaft"
    )
    direction: Literal[-1, 1] = Field(description="+1: positive counts pay cable out")
    home_counts: int = Field(default=0, description="drive position at the home pose")
    drum_to_outlet_mm: NonNegative = Field(
        default=0.0, description="cable between drum and outlet; it stretches too"
    )
    max_speed_mm_s: Positive
    torque_constant_n: Positive = Field(description="cable tension at rated torque")


class MotionDocument(Document):
    """How the platform is moved along a plan."""

    speed_mm_s: Positive = 20.0
    acceleration_mm_s2: Positive = 100.0
    jerk_mm_s3: Positive = 1000.0
    blend_tolerance_mm: NonNegative = Field(
        default=1.0,
        description="largest distance of a rounded corner from the planned one",
    )
    following_error_mm: Positive = Field(
        default=2.0, description="cable length; more is a fault"
    )
    start_tolerance_mm: Positive = Field(
        default=1.0,
        description="cable length; a run starts only this close to its plan",
    )


class BusDocument(Document):
    """The CAN bus, as python-can names it."""

    interface: Annotated[str, Field(min_length=1)]
    channel: str
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
    cycle_ms: Annotated[float, Field(ge=1, le=100)] = 10.0
    protocol: Literal["cia402"] = "cia402"


class TagDocument(PoseDocument):
    """One fiducial tag: its centre and orientation (x right, y up, z out of the print)."""

    id: Annotated[int, Field(ge=0)]
    size_mm: Positive = Field(description="side of the black square")


class TagsDocument(Document):
    """The tags on the platform (platform frame) and, optionally, on the frame (world)."""

    family: Literal["tag16h5", "tag25h9", "tag36h10", "tag36h11"] = "tag36h11"
    platform: Annotated[list[TagDocument], Field(min_length=1)]
    frame: list[TagDocument] = []

    @model_validator(mode="after")
    def _unique(self) -> TagsDocument:
        ids = [tag.id for tag in [*self.platform, *self.frame]]
        twice = sorted({i for i in ids if ids.count(i) > 1})
        if twice:
            raise ValueError(f"tag ids must be unique; twice: {twice}")
        return self


class CameraDocument(Document):
    """One camera: intrinsics (OpenCV pinhole) and pose (x right, y down, z along the view)."""

    name: Annotated[str, Field(min_length=1)]
    width_px: Annotated[int, Field(ge=64)]
    height_px: Annotated[int, Field(ge=64)]
    fx_px: Positive
    fy_px: Positive
    cx_px: Number
    cy_px: Number
    distortion: Annotated[list[Number], Field(max_length=14)] = Field(
        default=[], description="OpenCV order: k1 k2 p1 p2 k3 …"
    )
    world_from_camera: PoseDocument
    rate_hz: Positive = 10.0


class RigDocument(Document):
    """A cable-driven parallel robot: geometry, winches, bus, tags, cameras."""

    schema_version: Literal[1]
    name: Annotated[str, Field(min_length=1)]
    description: str = ""
    platform: PlatformDocument
    workspace: WorkspaceDocument
    outlets_mm: Annotated[list[Vector], Field(min_length=1)]
    anchors_mm: Annotated[list[Vector], Field(min_length=1)]
    cables: CableDocument
    pulleys: PulleysDocument | None = None
    winches: Annotated[list[WinchDocument], Field(min_length=1)]
    motion: MotionDocument = MotionDocument()
    bus: BusDocument
    tags: TagsDocument | None = None
    cameras: list[CameraDocument] = []

    def findings(self) -> list[tuple[tuple[str | int, ...], str]]:
        """Counts that do not agree, numbers given twice, a home pose outside the workspace."""
        return [*self._counts(), *self._repeated(), *self._home()]

    def _counts(self) -> list[tuple[tuple[str | int, ...], str]]:
        m = len(self.outlets_mm)
        found: list[tuple[tuple[str | int, ...], str]] = []
        if m < 6:
            what = (
                f"{m} outlets: a platform with six degrees of freedom needs 6 or more"
            )
            found.append((("outlets_mm",), what))
        if len(self.anchors_mm) != m:
            found.append(
                (("anchors_mm",), f"{len(self.anchors_mm)} anchors for {m} outlets")
            )
        if len(self.winches) != m:
            found.append((("winches",), f"{len(self.winches)} winches for {m} outlets"))
        if self.pulleys is not None and len(self.pulleys.feed_directions) != m:
            count = len(self.pulleys.feed_directions)
            place = ("pulleys", "feed_directions")
            found.append((place, f"{count} feed_directions for {m} outlets"))
        return found

    def _repeated(self) -> list[tuple[tuple[str | int, ...], str]]:
        ids = [winch.node_id for winch in self.winches]
        names = [camera.name for camera in self.cameras]
        found: list[tuple[tuple[str | int, ...], str]] = [
            (("winches", i, "node_id"), f"node_id {node} stands twice")
            for i, node in enumerate(ids)
            if node in ids[:i]
        ]
        found += [
            (("cameras", i, "name"), f"camera name {name!r} stands twice")
            for i, name in enumerate(names)
            if name in names[:i]
        ]
        return found

    def _home(self) -> list[tuple[tuple[str | int, ...], str]]:
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
