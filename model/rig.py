"""The rig as the program uses it: checked, read-only, in SI units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from model.cameras import (
    CalibrationResult,
    Camera,
    FinishedCalibration,
    Tag,
    camera_by_name,
    camera_from,
    corrected,
    tag_from,
)
from model.errors import BadInput, path_of, require_types
from model.files.documents import document_hash, document_of, load_yaml, millimetres
from model.files.rig_file import BusDocument, MotionDocument, RigDocument, WinchDocument
from model.files.validation import key_path
from model.pages.page import html_table
from model.pose import Array, Pose, ReadOnly, floats_of, read_only
from model.posed_rig import PosedRig, posed_rig
from model.progress import SILENT, Listener
from model.scene import Load, Scene, require_unaltered

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "NOT_IN_PLAN_HASH",
    "Camera",
    "Motion",
    "Rig",
    "Tag",
    "Winch",
    "load_rig",
    "rig_from_document",
]

#: Parts of a rig file that a plan's proof does not depend on; they may change after planning.
NOT_IN_PLAN_HASH = (
    *("description", "bus", "drives", "tags", "cameras", "motion", "winches"),
    *("simulation", "outlets_error_mm", "anchors_error_mm", "platform_error_mm"),
)


@dataclass(frozen=True, slots=True, eq=False)
class Winch:
    """A winch: conversion of cable length to drive counts, and limits.

    Attributes:
        node_id: Node of its drive on the bus.
        counts_per_metre: Signed counts for one metre of cable paid out.
        home_counts: Drive position with the platform at home.
        absolute: The drive keeps its position without power.
        drum_to_outlet: Cable between drum and outlet, [m].
        max_speed: Cable speed limit, [m/s].
        torque_constant: Cable tension at rated torque, [N].
        counts_per_turn: Counts per turn of the motor shaft.
        rated_torque: Of the motor at `torque_constant`, [N·m].
        brake: It has a brake that closes when the drive has no torque.
    """

    node_id: int
    counts_per_metre: float
    home_counts: int
    absolute: bool
    drum_to_outlet: float
    max_speed: float
    torque_constant: float
    counts_per_turn: int
    rated_torque: float
    brake: bool


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Limits of motion along a path.

    Attributes:
        speed: Of the platform's origin, [m/s].
        acceleration: As `speed`, [m/s²].
        jerk: As `speed`, [m/s³].
        blend_tolerance: Largest distance of a rounded corner from the planned one, [m].
        following_error: Largest following error of a cable, [m].
        start_tolerance: Largest error of a cable's length at which a run starts, [m].
        stuck_travel: Cable that set-points may advance while a drive is at rest, [m].
        stuck_speed: Cable speed of set-points below which friction may hold a drive, [m/s].
    """

    speed: float
    acceleration: float
    jerk: float
    blend_tolerance: float
    following_error: float
    start_tolerance: float
    stuck_travel: float
    stuck_speed: float


@dataclass(frozen=True, eq=False)
class Rig(ReadOnly):
    """A checked cable robot with m cables.

    Attributes:
        document: The file it was made from.
        outlets: Cable outlet points, world frame, shape (m, 3), [m].
        anchors: Cable anchor points, platform frame, shape (m, 3), [m].
        pulley_radius: [m]; 0 for point exits.
        feed_directions: Travel of the cable entering each pulley, world frame, shape (m, 3).
        half_size: Half extents of the platform box, platform frame, shape (3,), [m].
        mass: Of the platform without payload, [kg].
        centre_of_mass: Of the platform, platform frame, shape (3,), [m].
        home: ``world_from_platform`` to which `Winch.home_counts` belong.
        workspace_lower: Smallest coordinates of the platform's origin, world frame, shape (3,),
            [m].
        workspace_upper: Largest, as `workspace_lower`.
        cable_radius: [m].
        cable_stiffness: Axial, E·A of each cable, shape (m,), [N].
        min_tension: Of every cable, [N].
        max_tension: Of every cable, [N].
        winches: One per cable, in the order of `outlets`.
        motion: Limits of motion along a path.
        tag_family: Of all tags; empty without tags.
        tag_detector: "opencv" or "apriltag"; empty without tags.
        platform_tags: Tags on the platform; empty where none are described.
        frame_tags: Surveyed tags in the world; empty as above.
        cameras: In the order of the file; empty as above.
        tag_error: Position error of the platform's tag corners, 95 %, [m]; None where the rig file
            does not state it.
        outlet_error: Error of outlets along any axis, 95 %, [m]; None as above.
        anchor_error: As `outlet_error`, for anchors.
        platform_error: Error of the platform's position by cable lengths, along any axis, 95 %,
            [m]; None as above.
    """

    document: RigDocument
    outlets: Array
    anchors: Array
    pulley_radius: float
    feed_directions: Array
    half_size: Array
    mass: float
    centre_of_mass: Array
    home: Pose
    workspace_lower: Array
    workspace_upper: Array
    cable_radius: float
    cable_stiffness: Array
    min_tension: float
    max_tension: float
    winches: tuple[Winch, ...]
    motion: Motion
    tag_family: str
    tag_detector: str
    platform_tags: tuple[Tag, ...]
    frame_tags: tuple[Tag, ...]
    cameras: tuple[Camera, ...]
    tag_error: float | None = None
    outlet_error: float | None = None
    anchor_error: float | None = None
    platform_error: float | None = None

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Rig:
        """The rig of a rig file's keys and values; lists may be given as arrays.

        Raises:
            InvalidFile: With every key that does not fit.
        """
        return rig_from_document(document_of(data, RigDocument, "Rig.from_dict"))

    def as_dict(self) -> dict[str, Any]:
        """The keys and values of its file, in new lists, as for `from_dict`."""
        return self.document.model_dump(mode="json", exclude_none=True)

    def remade(self) -> Rig:
        """The rig that its document describes."""
        return rig_from_document(self.document)

    @property
    def name(self) -> str:
        """Name in the rig file."""
        return self.document.name

    @property
    def cycle(self) -> float:
        """Period of the bus and of the set-points, [s]."""
        return self.document.bus.cycle_ms / 1000.0

    @property
    def cable_count(self) -> int:
        """Number of cables m."""
        return len(self.outlets)

    @property
    def is_tracked(self) -> bool:
        """Whether it has cameras and tags on the platform, so that a run can be measured."""
        return bool(self.cameras and self.platform_tags)

    @cached_property
    def drive_names(self) -> dict[int, str]:
        """Displayed drive names by node id, in cable order: ``cable 1 (drive 11)``.

        Cables and winches count from 1 in the order of the file; a drive's number is its node id.
        """
        nodes = [winch.node_id for winch in self.winches]
        return {node: f"cable {k} (drive {node})" for k, node in enumerate(nodes, start=1)}

    def tensions_by(self, torques: ArrayLike) -> Array:
        """Cable tensions at rest, shape (..., m), [N], from torques [per mille of rated torque]."""
        tensions: Array = self._of_cables("torques", torques) / 1000.0 * self._rated_tensions
        return tensions

    def torques_by(self, tensions: ArrayLike) -> Array:
        """The inverse of `tensions_by`: torques, shape (..., m), [per mille of rated torque]."""
        torques: Array = self._of_cables("tensions", tensions) * 1000.0 / self._rated_tensions
        return torques

    def _of_cables(self, name: str, given: ArrayLike) -> Array:
        """An argument as an array, shape (..., m)."""
        try:
            values = floats_of(given)
        except (TypeError, ValueError):
            values = np.empty(0)
        if values.shape[-1:] != (self.cable_count,):
            raise BadInput(
                f"{name} must be a number for each of {self.cable_count} cables; it is {given!r}"
            )
        return values

    @cached_property
    def _rated_tensions(self) -> Array:
        return np.array([winch.torque_constant for winch in self.winches])

    @cached_property
    def plan_hash(self) -> str:
        """Hash of the parts of the rig that a plan's proof depends on."""
        return document_hash(self.document, NOT_IN_PLAN_HASH)

    @cached_property
    def hash(self) -> str:
        """Hash of the whole rig file's content."""
        return document_hash(self.document)

    @cached_property
    def platform_corners(self) -> Array:
        """Corners of the platform box, platform frame, shape (8, 3), [m]."""
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
        return read_only(signs * self.half_size)

    @cached_property
    def reach(self) -> float:
        """Distance of the farthest corner or anchor from the platform's origin, [m]."""
        points = np.concatenate([self.platform_corners, self.anchors])
        return float(np.linalg.norm(points, axis=1).max())

    def at(self, pose: Pose, load: Load | None = None) -> PosedRig:
        """Cable lengths, structure matrix, tensions and margins at ``world_from_platform``.

        Args:
            pose: ``world_from_platform``.
            load: Payload and external wrenches, as ``scene.load``; none when left out.

        Raises:
            NoCable: A cable has no path at this pose.
        """
        require_types((pose, Pose), optional=[(load, Load)])
        return posed_rig(self, pose, load)

    def clipped(self, pose: Pose) -> Pose:
        """The pose with its origin moved to the nearest point of the workspace box."""
        require_types((pose, Pose))
        position = np.clip(pose.position, self.workspace_lower, self.workspace_upper)
        return Pose(position, pose.rotation)

    def camera(self, name: str | None = None) -> Camera:
        """The camera of a name; the first when no name is given.

        Raises:
            BadInput: The rig has none of this name, or none at all.
        """
        return camera_by_name(self.cameras, name, self.name)

    def with_bus(self, interface: str | None = None, channel: str | None = None) -> Rig:
        """The same rig on another CAN bus, in memory only; a plan does not depend on the bus.

        Args:
            interface: As python-can names it, such as ``socketcan``; the rig file's when left out.
            channel: Such as ``can0``; that of the rig file when left out.

        Raises:
            InvalidFile: One is not text, or cannot be in a rig file.
            BadInput: This rig is an altered copy (`model.scene.require_unaltered`).
        """
        require_unaltered(self)
        named = {"interface": interface, "channel": channel}
        given = {key: value for key, value in named.items() if value is not None}
        bus = document_of(dict(self.document.bus) | given, BusDocument, "Rig.with_bus")
        return rig_from_document(self.document.model_copy(update={"bus": bus}))

    def with_tag_detector(self, detector: str) -> Rig:
        """The same rig with the tag detector "opencv" or "apriltag", in memory only.

        Raises:
            BadInput: As for `with_bus`; an unknown detector is refused where tags are sought.
        """
        require_unaltered(self)
        if (tags := self.document.tags) is None:
            return self
        tags = tags.model_copy(update={"detector": detector})
        return rig_from_document(self.document.model_copy(update={"tags": tags}))

    def with_calibration(
        self, *results: CalibrationResult | FinishedCalibration, listener: Listener = SILENT
    ) -> Rig:
        """The rig with its file's numbers replaced by calibration results, in memory only.

        Args:
            results: From calibration functions or `calibration.load_result`, in any order.
            listener: Receives a remark for each error that a new lens leaves out, and for each
                result that is not good enough.

        Raises:
            BadInput: A result does not fit, two calibrate the same thing, or as for `with_bus`.
        """
        require_unaltered(self)
        given = [one.result if isinstance(one, FinishedCalibration) else one for one in results]
        require_types(*((one, CalibrationResult) for one in given), (listener, Listener))
        return rig_from_document(corrected(self.document, given, listener))

    def plot(self, pose: Pose | None = None, scene: Scene | None = None) -> Figure:
        """A figure of the rig at a pose (home when left out), among a scene's obstacles."""
        shown = self.home if pose is None else pose
        require_types((shown, Pose), optional=[(scene, Scene)])
        from model.figures import rig_figure  # loads matplotlib

        return rig_figure(self, shown, scene)

    def __repr__(self) -> str:
        """Name, size and bus."""
        bus = self.document.bus
        where = f"{bus.interface} {bus.channel}".rstrip()
        return f"<Rig {self.name}: {self.cable_count} cables, bus {where}>"

    def _repr_html_(self) -> str:
        """For notebooks."""
        bus, size = self.document.bus, self.half_size * 2e3
        cameras = ", ".join(camera.name for camera in self.cameras)
        rows = [
            ("cables", f"{self.cable_count}, {self.min_tension:g} to {self.max_tension:g} N"),
            ("platform", f"{size[0]:g} × {size[1]:g} × {size[2]:g} mm, {self.mass:g} kg"),
            ("bus", f"{bus.interface} {bus.channel}, {bus.cycle_ms:g} ms cycle"),
            ("cameras", cameras or "none"),
        ]
        return html_table(f"Rig {self.name}", rows)


def load_rig(path: str | Path) -> Rig:
    """Reads a rig file.

    Raises:
        BadInput: The file cannot be read.
        InvalidFile: With every problem and its position.
    """
    return rig_from_document(load_yaml(path_of(path), RigDocument))


def rig_from_document(document: RigDocument) -> Rig:
    """The rig that a document describes.

    Raises:
        BadInput: Parts of the document do not agree.
    """
    if findings := [f"{key_path(parts)}: {what}" for parts, what in document.findings()]:
        raise BadInput("; ".join(findings), where=f"rig {document.name}")
    pulleys, tags = document.pulleys, document.tags
    feed = pulleys.feed_directions if pulleys else [[0.0, 0.0, 1.0]] * len(document.outlets_mm)
    return Rig(
        document=document,
        outlets=read_only(millimetres(document.outlets_mm)),
        anchors=read_only(millimetres(document.anchors_mm)),
        pulley_radius=pulleys.radius_mm / 1000.0 if pulleys else 0.0,
        feed_directions=read_only(np.asarray(feed) / np.linalg.norm(feed, axis=1)[:, None]),
        half_size=read_only(millimetres(document.platform.size_mm) / 2.0),
        mass=document.platform.mass_kg,
        centre_of_mass=read_only(millimetres(document.platform.centre_of_mass_mm)),
        home=document.platform.home.pose(),
        workspace_lower=read_only(millimetres(document.workspace.lower_mm)),
        workspace_upper=read_only(millimetres(document.workspace.upper_mm)),
        cable_radius=document.cables.radius_mm / 1000.0,
        cable_stiffness=read_only(
            [w.cable_stiffness_n or document.cables.stiffness_n for w in document.winches]
        ),
        min_tension=document.cables.min_tension_n,
        max_tension=document.cables.max_tension_n,
        winches=tuple(_winch(w) for w in document.winches),
        motion=_motion(document.motion),
        tag_family=tags.family if tags else "",
        tag_detector=tags.detector if tags else "",
        platform_tags=tuple(tag_from(t) for t in tags.platform) if tags else (),
        frame_tags=tuple(tag_from(t) for t in tags.frame) if tags else (),
        cameras=tuple(camera_from(c) for c in document.cameras),
        tag_error=_metres(tags.error_mm if tags else None),
        outlet_error=_metres(document.outlets_error_mm),
        anchor_error=_metres(document.anchors_error_mm),
        platform_error=_metres(document.platform_error_mm),
    )


def _metres(millimetres: float | None) -> float | None:
    return None if millimetres is None else millimetres / 1e3


def _winch(document: WinchDocument) -> Winch:
    counts_per_rev = document.counts_per_rev * document.gear_ratio * document.direction
    drum_radius = document.drum_mm_per_rev / 1000.0 / (2.0 * np.pi)
    return Winch(
        node_id=document.node_id,
        counts_per_metre=counts_per_rev / (document.drum_mm_per_rev / 1000.0),
        home_counts=document.home_counts,
        absolute=document.encoder == "absolute",
        drum_to_outlet=document.drum_to_outlet_mm / 1000.0,
        max_speed=document.max_speed_mm_s / 1000.0,
        torque_constant=document.torque_constant_n,
        counts_per_turn=document.counts_per_rev,
        rated_torque=document.torque_constant_n * drum_radius / document.gear_ratio,
        brake=document.brake,
    )


def _motion(document: MotionDocument) -> Motion:
    return Motion(
        speed=document.speed_mm_s / 1000.0,
        acceleration=document.acceleration_mm_s2 / 1000.0,
        jerk=document.jerk_mm_s3 / 1000.0,
        blend_tolerance=document.blend_tolerance_mm / 1000.0,
        following_error=document.following_error_mm / 1000.0,
        start_tolerance=document.start_tolerance_mm / 1000.0,
        stuck_travel=document.stuck_travel_mm / 1000.0,
        stuck_speed=document.stuck_speed_mm_s / 1000.0,
    )
