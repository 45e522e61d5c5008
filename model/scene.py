"""The scene as the program uses it: checked, read-only, in SI units."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from model.errors import BadInput, path_of, real_number, require_types, sequence_of
from model.files.documents import (
    Document,
    PoseDocument,
    document_hash,
    document_of,
    load_yaml,
    millimetres,
)
from model.files.scene_file import (
    BoxDocument,
    HullDocument,
    LoadDocument,
    MeshDocument,
    ObstacleDocument,
    Payload,
    RotationLimitsDocument,
    RoundDocument,
    SceneDocument,
    SphereDocument,
    StopDocument,
    payloads,
)
from model.files.validation import key_path
from model.pages.page import html_table
from model.pose import Array, Pose, ReadOnly, RotationLimits, read_only
from model.shapes import (
    Box,
    Capsule,
    Cylinder,
    Obstacle,
    Shape,
    Sphere,
    TriangleMesh,
    convex_hull,
    enclosed_convex,
    read_only_indices,
)

if TYPE_CHECKING:
    from model.rig import Rig


@dataclass(frozen=True, slots=True, eq=False)
class Load(ReadOnly):
    """What the cables carry besides the platform's own weight.

    Attributes:
        payload_mass: [kg].
        payload_centre: In the platform frame, shape (3,), [m].
        force: Half widths of the external-force box, world axes, shape (3,), [N].
        moment: Half widths of the external-moment box, world axes, shape (3,), [N·m].
    """

    payload_mass: float
    payload_centre: Array
    force: Array
    moment: Array


@dataclass(frozen=True, slots=True, eq=False)
class Stop:
    """An intermediate pose that is met exactly; the platform comes to rest there.

    Attributes:
        name: Unique name.
        kind: ``pass``, or ``pick`` and ``place``, at which the load changes.
        pose: ``world_from_platform``.
        dwell: Time at rest, [s].
    """

    name: str
    kind: str
    pose: Pose
    dwell: float


@dataclass(frozen=True, eq=False)
class Scene(ReadOnly):
    """A checked scene.

    Attributes:
        document: The file it was made from.
        obstacles: In the order of the file.
        obstacle_clearance: Smallest allowed distance of cables and platform to obstacles, [m].
        self_clearance: Smallest allowed distance between cables and of cables to platform, [m].
        start: ``world_from_platform`` at the start.
        goal: ``world_from_platform`` at the goal.
        load: What the cables carry from the start on.
        stops: Intermediate stops in order; `legs_of` gives the loads between them.
        rotation_limits: Limits of the platform's tilt and turn, checked on every path; None for no
            limits. Planning with free rotation requires some.
    """

    document: SceneDocument
    obstacles: tuple[Obstacle, ...]
    obstacle_clearance: float
    self_clearance: float
    start: Pose
    goal: Pose
    load: Load
    stops: tuple[Stop, ...]
    rotation_limits: RotationLimits | None

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Scene:
        """The scene of a scene file's keys and values; lists may be given as arrays.

        Raises:
            InvalidFile: With every key that does not fit.
        """
        return scene_from_document(document_of(data, SceneDocument, "Scene.from_dict"))

    def as_dict(self) -> dict[str, Any]:
        """The keys and values of its file, in new lists, as for `from_dict`."""
        return self.document.model_dump(mode="json", exclude_none=True)

    @property
    def name(self) -> str:
        """Name in the scene file."""
        return self.document.name

    @cached_property
    def hash(self) -> str:
        """Hash of the scene's content."""
        return document_hash(self.document)

    def remarks(self, rig: Rig) -> list[str]:
        """Values of the files of rig and scene that are valid but unlikely, each with its key."""
        load, half = self.document.load, np.array(rig.document.platform.size_mm) / 2.0
        masses = [("load.payload_centre_mm", load.payload_kg, load.payload_centre_mm)]
        masses += [
            (f"stops[{i}].mass_centre_mm", stop.mass_kg or 0.0, stop.mass_centre_mm or [0.0] * 3)
            for i, stop in enumerate(self.document.stops)
            if stop.kind == "pick"
        ]
        found = [(key, float(np.max(np.abs(at) - half))) for key, mass, at in masses if mass > 0.0]
        carried = [
            f"{key} is {outside:.4g} mm outside the platform's box; only this box and the cables"
            " are kept away from obstacles"
            for key, outside in found
            if outside > 0.0
        ]
        return [*rig.document.remarks(), *self.document.remarks(), *carried]

    def remade(self) -> Scene:
        """The scene that its document describes."""
        return scene_from_document(self.document)

    def stop_facts(self) -> list[tuple[str, str]]:
        """Human-readable summary of the stops and the load after each; empty without stops."""
        carried = [leg.scene.load.payload_mass for leg in legs_of(self)]
        shown = []
        for stop, before, after in zip(self.stops, carried[:-1], carried[1:], strict=True):
            load = f", then {after:g} kg" if after != before else ""
            dwell = f" {stop.dwell:g} s" if stop.dwell > 0.0 else ""
            shown.append(f"{stop.name} ({stop.kind}{dwell}{load})")
        return [("via", ", ".join(shown))] if shown else []

    def changed(
        self,
        *,
        start: Pose | None = None,
        goal: Pose | None = None,
        clearance: float | None = None,
        stops: Sequence[StopDocument] | None = None,
        payload: Payload | None = None,
    ) -> Scene:
        """The same scene with another start, goal, obstacle clearance [m], stops or payload.

        Raises:
            BadInput: An argument is of another type, the clearance is negative or not finite, stops
                do not fit the payload, or this scene is an altered copy (`require_unaltered`).
        """
        document = self.document
        require_unaltered(self)
        require_types(optional=((start, Pose), (goal, Pose), (payload, Payload)))
        if clearance is not None:
            clearance = real_number("clearance", clearance, "m")
        if clearance is not None and not 0.0 <= clearance < np.inf:
            raise BadInput(f"the clearance must be 0 mm or more (it is {clearance * 1000.0:g} mm)")
        update: dict[str, object] = {}
        if start is not None:
            update["start"] = PoseDocument.of(start)
        if goal is not None:
            update["goal"] = PoseDocument.of(goal)
        if clearance is not None:
            value = {"obstacle_mm": round(clearance * 1000.0, 9)}
            update["clearance"] = document.clearance.model_copy(update=value)
        if stops is not None:
            given = sequence_of("stops", stops)
            require_types(*((stop, StopDocument) for stop in given))
            update["stops"] = list(given)
        if payload is not None:
            update["load"] = document.load.carrying(payload)
        return scene_from_document(document.model_copy(update=update))

    def __repr__(self) -> str:
        """Name and size."""
        stops = f", {len(self.stops)} stops" if self.stops else ""
        return f"<Scene {self.name}: {len(self.obstacles)} obstacles{stops}>"

    def _repr_html_(self) -> str:
        """For notebooks."""
        rows = [
            ("obstacles", ", ".join(o.name for o in self.obstacles) or "none"),
            ("start", _in_words(self.start)),
            *(("stop " + stop.name, _in_words(stop.pose)) for stop in self.stops),
            ("goal", _in_words(self.goal)),
            ("clearance", f"{self.obstacle_clearance * 1e3:g} mm to obstacles"),
        ]
        return html_table(f"Scene {self.name}", rows)


def _in_words(pose: Pose) -> str:
    return f"{np.round(pose.position * 1e3, 1).tolist()} mm"


def load_scene(path: str | Path) -> Scene:
    """Reads a scene file.

    Raises:
        BadInput: The file cannot be read.
        InvalidFile: With every problem and its position.
    """
    return scene_from_document(load_yaml(path_of(path), SceneDocument))


def scene_from_document(document: SceneDocument) -> Scene:
    """The scene that a document describes.

    Raises:
        BadInput: Parts of the document do not agree.
    """
    findings = [f"{key_path(parts)}: {what}" for parts, what in document.findings()]
    if findings:
        raise BadInput("; ".join(findings), where=f"scene {document.name}")
    return Scene(
        document=document,
        obstacles=tuple(_obstacle(o) for o in document.obstacles),
        obstacle_clearance=document.clearance.obstacle_mm / 1000.0,
        self_clearance=document.clearance.self_mm / 1000.0,
        start=document.start.pose(),
        goal=document.goal.pose(),
        load=load_from_document(document.load),
        stops=tuple(Stop(s.name, s.kind, s.pose(), s.dwell_s) for s in document.stops),
        rotation_limits=_rotation_limits(document.rotation_limits),
    )


#: Name of `empty_scene`.
NO_SCENE = "no scene"


def empty_scene(rig: Rig) -> Scene:
    """A scene without obstacles and load, with the platform at home and default clearances."""
    home = PoseDocument.of(rig.home)
    return scene_from_document(
        SceneDocument(schema_version=1, name=NO_SCENE, start=home, goal=home)
    )


def load_from_document(document: LoadDocument) -> Load:
    """The load that a document describes."""
    return Load(
        payload_mass=document.payload_kg,
        payload_centre=read_only(millimetres(document.payload_centre_mm)),
        force=read_only(document.force_n),
        moment=read_only(document.moment_nm),
    )


def _rotation_limits(document: RotationLimitsDocument | None) -> RotationLimits | None:
    if document is None:
        return None
    return RotationLimits(math.radians(document.tilt_deg), math.radians(document.turn_deg))


def _obstacle(document: ObstacleDocument) -> Obstacle:
    pose = PoseDocument(
        position_mm=document.position_mm, rotation_wxyz=document.rotation_wxyz
    ).pose()
    (key, given), *_ = document.shapes().items()
    try:
        shape = _shape(key, given)
    except ValueError as error:
        raise BadInput(str(error), where=f"obstacle {document.name!r}") from None
    return Obstacle(document.name, shape, pose)


def _shape(key: str, document: Document) -> Shape:
    match document:
        case BoxDocument(size_mm=size):
            return Box(read_only(millimetres(size) / 2.0))
        case SphereDocument(radius_mm=radius):
            return Sphere(radius / 1000.0)
        case RoundDocument(radius_mm=radius, length_mm=length):
            kind = Cylinder if key == "cylinder" else Capsule
            return kind(radius / 1000.0, length / 1000.0)
        case HullDocument(points_mm=points):
            return convex_hull(np.asarray(points) / 1000.0)
        case MeshDocument(points_mm=points, triangles=triangles):
            vertices = read_only(np.asarray(points) / 1000.0)
            numbers = read_only_indices(triangles)
            return enclosed_convex(vertices, numbers) or TriangleMesh(vertices, numbers)
        case _:
            raise ValueError(f"unknown shape {key!r}")


# A scene with stops as legs, each a scene from one stop to the next.


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """A part of the path, run with one load.

    Attributes:
        scene: The whole scene with the leg's start, goal and load, without stops.
        begin: Displayed name of its start: ``start`` or ``stop 'shelf'``.
        end: Displayed name of its end; ``goal`` for the last.
    """

    scene: Scene
    begin: str
    end: str


def legs_of(scene: Scene) -> tuple[Leg, ...]:
    """The legs of a scene in order: one more than it has stops."""
    document = scene.document
    ends: list[tuple[str, PoseDocument]] = [
        ("start", document.start),
        *((f"stop {stop.name!r}", stop) for stop in document.stops),
        ("goal", document.goal),
    ]
    legs = []
    carried = payloads(document.load.payload(), document.stops)
    for (begin, end), payload in zip(pairwise(ends), carried, strict=True):
        load = document.load.carrying(payload)
        changes = {"start": begin[1].bare(), "goal": end[1].bare(), "load": load, "stops": []}
        part = replace(
            scene,
            document=document.model_copy(update=changes),
            start=begin[1].pose(),
            goal=end[1].pose(),
            load=load_from_document(load),
            stops=(),
        )
        legs.append(Leg(part, begin[0], end[0]))
    return tuple(legs)


# Rigs, scenes and plans whose fields are no longer those of their documents.


_HOW_TO_CHANGE = {
    "Rig": "use cdpr.Rig.from_dict({**rig.as_dict(), ...}), rig.with_bus or rig.with_calibration",
    "Scene": "use scene.changed(...), or cdpr.Scene.from_dict({**scene.as_dict(), ...})",
    "Plan": "make a plan of other waypoints with cdpr.plan_from_waypoints(rig, scene, waypoints)",
}


class HasDocument(Protocol):
    """A rig, a scene or a plan."""

    def remade(self) -> object:
        """The same, from its document."""


def require_unaltered(*things: HasDocument | None) -> None:
    """Refuses copies with other fields than their documents, as `dataclasses.replace` makes them.

    Hashes, files and the process of the drives come from the document.

    Args:
        things: Rigs, scenes and plans; None for those left out.

    Raises:
        BadInput: With the first field that differs, and how to change such an object.
    """
    for thing in things:
        if thing is None or (field := _differing(made := thing.remade(), thing)) is None:
            continue
        kind = type(made).__name__
        raise BadInput(
            f"the field `{field}` of a {kind} is not that of its document",
            why="it was changed in a copy, as `dataclasses.replace` makes it; hashes, files and"
            " the drives' process use the document",
            next_step=_HOW_TO_CHANGE[kind],
        )


def _differing(made: object, given: object, name: str = "") -> str | None:
    """Path of the first field that differs, such as ``motion.speed``; None where none does."""
    if made is given:
        return None
    if isinstance(made, tuple) and isinstance(given, tuple) and len(made) == len(given):
        parts = [(f"{name}[{k}]", *pair) for k, pair in enumerate(zip(made, given, strict=True))]
    elif is_dataclass(made) and isinstance(given, type(made)):
        names = [one.name for one in fields(made)]
        parts = [(f"{name}.{n}".lstrip("."), getattr(made, n), getattr(given, n)) for n in names]
    elif isinstance(made, np.ndarray):
        same = isinstance(given, np.ndarray) and np.array_equal(made, given)
        return None if same else name
    else:
        return None if not isinstance(given, np.ndarray) and made == given else name
    found = (_differing(one, other, part) for part, one, other in parts)
    return next((part for part in found if part is not None), None)
