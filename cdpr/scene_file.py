"""The scene file: obstacles, clearances, start and goal (YAML, strict, version 1)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from cdpr.document_types import (
    Document,
    NonNegative,
    NonNegativeVector,
    PoseDocument,
    Positive,
    PositiveVector,
    Quaternion,
    Vector,
)


class BoxDocument(Document):
    """A box about its centre."""

    size_mm: PositiveVector


class SphereDocument(Document):
    """A ball about its centre."""

    radius_mm: Positive


class RoundDocument(Document):
    """A cylinder (length between its flat ends) or a capsule (length of its axis), along z."""

    radius_mm: Positive
    length_mm: Positive


class HullDocument(Document):
    """The convex hull of points."""

    points_mm: Annotated[list[Vector], Field(min_length=4)]


class MeshDocument(Document):
    """A surface of triangles; each triangle names three points, counted from 0."""

    points_mm: Annotated[list[Vector], Field(min_length=3)]
    triangles: Annotated[
        list[Annotated[list[int], Field(min_length=3, max_length=3)]],
        Field(min_length=1),
    ]


class ObstacleDocument(Document):
    """One obstacle: a name, exactly one shape, and where its centre is."""

    name: Annotated[str, Field(min_length=1)]
    position_mm: Vector = [0.0, 0.0, 0.0]
    rotation_wxyz: Quaternion = [1.0, 0.0, 0.0, 0.0]
    box: BoxDocument | None = None
    sphere: SphereDocument | None = None
    cylinder: RoundDocument | None = None
    capsule: RoundDocument | None = None
    convex: HullDocument | None = None
    mesh: MeshDocument | None = None

    def shapes(self) -> dict[str, Document]:
        """The shapes that were given, by key."""
        given = {
            "box": self.box,
            "sphere": self.sphere,
            "cylinder": self.cylinder,
            "capsule": self.capsule,
            "convex": self.convex,
            "mesh": self.mesh,
        }
        return {key: shape for key, shape in given.items() if shape is not None}


class ClearanceDocument(Document):
    """The distances that every pose of a plan keeps."""

    obstacle_mm: NonNegative = Field(
        default=10.0, description="cables and platform to every obstacle"
    )
    self_mm: NonNegative = Field(
        default=5.0, description="cable to cable and cable to platform"
    )


class LoadDocument(Document):
    """What the cables must carry beside the platform's own weight."""

    payload_kg: NonNegative = 0.0
    payload_centre_mm: Vector = [0.0, 0.0, 0.0]
    force_n: NonNegativeVector = Field(
        default=[0.0, 0.0, 0.0], description="external force up to ± this, world axes"
    )
    moment_nm: NonNegativeVector = Field(
        default=[0.0, 0.0, 0.0], description="external moment up to ± this, world axes"
    )


class SceneDocument(Document):
    """What a plan is made for."""

    schema_version: Literal[1]
    name: Annotated[str, Field(min_length=1)]
    description: str = ""
    clearance: ClearanceDocument = ClearanceDocument()
    load: LoadDocument = LoadDocument()
    start: PoseDocument
    goal: PoseDocument
    obstacles: list[ObstacleDocument] = []

    def findings(self) -> list[tuple[tuple[str | int, ...], str]]:
        """Obstacles without exactly one shape, names given twice, wrong triangles, flat hulls."""
        found: list[tuple[tuple[str | int, ...], str]] = []
        names = [obstacle.name for obstacle in self.obstacles]
        for i, obstacle in enumerate(self.obstacles):
            place = ("obstacles", i)
            given = list(obstacle.shapes())
            if len(given) != 1:
                what = f"needs exactly one shape, it has {', '.join(given) or 'none'}"
                found.append((place, f"obstacle {obstacle.name!r} {what}"))
            if obstacle.name in names[:i]:
                found.append(
                    ((*place, "name"), f"obstacle name {obstacle.name!r} stands twice")
                )
            if obstacle.mesh is not None:
                count = len(obstacle.mesh.points_mm)
                wrong = [
                    t
                    for t in obstacle.mesh.triangles
                    if not all(0 <= i < count for i in t)
                ]
                if wrong:
                    what = f"triangle {wrong[0]} names a point outside 0..{count - 1}"
                    found.append(((*place, "mesh", "triangles"), what))
        return found
