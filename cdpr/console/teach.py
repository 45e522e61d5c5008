"""Taught poses: named, ordered, stored in a file, and converted to a scene for planning."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import AfterValidator, BeforeValidator, Field, TypeAdapter, ValidationError

from model.errors import BadInput, InvalidFile, Refused
from model.files.documents import Document, Name, PoseDocument, millimetres, write_atomic
from model.files.reading import parse_json, read_text
from model.files.scene_file import RotationLimitsDocument, SceneDocument, StopDocument
from model.files.validation import problems_of, sentence_of
from model.pose import Pose, largest_rotations
from model.rig import Rig
from model.scene import Scene

#: Largest number of poses.
MOST = 200
#: Orientations within this angle count as equal, [deg]: drives do not hold them more accurately.
ALIKE_DEG = 0.1
#: A platform within this distance of the first pose is there already, [m].
NEAR = 0.5e-3
AGAIN = "restore the file, or move it away to start without poses"


def _trimmed(name: object) -> object:
    return name.strip() if isinstance(name, str) else name


TaughtName = Annotated[Name, BeforeValidator(_trimmed)]


class TaughtPose(PoseDocument):
    """A named pose."""

    name: TaughtName


def _named_once(poses: list[TaughtPose]) -> list[TaughtPose]:
    names = [pose.name for pose in poses]
    for index, name in enumerate(names):
        if name in names[:index]:
            raise ValueError(f"pose name {name!r} appears twice; rename one of them in the file")
    return poses


class TaughtDocument(Document):
    """The file of taught poses."""

    schema_version: Literal[1] = 1
    poses: Annotated[list[TaughtPose], AfterValidator(_named_once)] = Field(default_factory=list)


class TaughtPoses:
    """An ordered list of poses, saved after every change.

    Another console may use the same file: each change begins with the poses that it holds then.
    """

    def __init__(self, path: Path) -> None:
        """Loads the file, if it exists.

        Raises:
            BadInput: It cannot be read.
            InvalidFile: With its errors.
        """
        self._path = path
        self._poses = self._read()

    def __len__(self) -> int:
        """Number of poses."""
        return len(self._poses)

    def as_dicts(self) -> list[dict[str, Any]]:
        """The poses as data for the page."""
        return [
            {"name": p.name, "position_mm": p.position_mm, "quaternion": p.rotation_wxyz}
            for p in self._poses
        ]

    def teach(self, name: str, pose: Pose) -> None:
        """Adds a pose at the end.

        Raises:
            BadInput: There are too many, or the name is taken or invalid.
        """
        self._poses = self._read()
        if len(self._poses) >= MOST:
            raise _refusal(f"there are {MOST} poses already", "remove one that is not needed")
        named = _named(PoseDocument.of(pose), name)
        self._require_free(named.name)
        self._keep([*self._poses, named])

    def rename(self, pose: str, name: str) -> None:
        """Renames a pose.

        Raises:
            BadInput: There is no such pose, or the name is taken or invalid.
        """
        self._poses = self._read()
        index = self._index(pose)
        named = _named(self._poses[index], name)
        if named.name != self._poses[index].name:
            self._require_free(named.name)
        self._keep([*self._poses[:index], named, *self._poses[index + 1 :]])

    def move(self, pose: str, to: int) -> None:
        """Moves a pose to another position in the order, from 0.

        Raises:
            BadInput: There is no such pose or position.
        """
        self._poses = self._read()
        index = self._index(pose)
        if not 0 <= to < len(self._poses):
            raise _refusal(f"the list has no position {to + 1}", "check the list")
        changed = list(self._poses)
        changed.insert(to, changed.pop(index))
        self._keep(changed)

    def forget(self, pose: str) -> None:
        """Removes a pose.

        Raises:
            BadInput: There is no such pose.
        """
        self._poses = self._read()
        index = self._index(pose)
        self._keep([*self._poses[:index], *self._poses[index + 1 :]])

    def scene(
        self, around: Scene, name: str, *, begin: Pose | None = None, only: str | None = None
    ) -> SceneDocument:
        """A scene from the first pose through all others to the last, with given surroundings.

        If all orientations are within `ALIKE_DEG`, every pose gets the first one's orientation;
        otherwise the scene has rotation limits, and is to be planned with free rotation.

        Args:
            begin: The path's first pose, before the taught ones; None for the first of them.
            only: The one taught pose to go to; None for all.

        Raises:
            BadInput: There is no such pose, or the path has fewer than two poses.
        """
        poses = self._poses if only is None else [self._poses[self._index(only)]]
        if begin is not None:
            if poses and _is_at(begin, poses[0].pose()):
                poses = poses[1:]
            poses = [_named(PoseDocument.of(begin), "start"), *poses]
        if len(poses) < 2:
            if begin is not None and self._poses:
                raise _refusal("the platform is there already", "choose another pose")
            needed = "one pose" if begin is not None else "two poses"
            raise _refusal(f"a path needs {needed}, not {len(self._poses)}", "teach another one")
        first = poses[0].pose()
        apart = max(np.degrees(first.angle_to(one.pose())) for one in poses)
        limits = None if apart <= ALIKE_DEG else _rotation_limits(poses)
        alike = {"rotation_wxyz": poses[0].rotation_wxyz} if limits is None else {}
        start, *stops, goal = (pose.model_copy(update=alike) for pose in poses)
        return around.document.model_copy(
            update={
                "name": name,
                "start": start.bare(),
                "stops": [StopDocument(**stop.model_dump()) for stop in stops],
                "goal": goal.bare(),
                "rotation_limits": limits,
            }
        )

    def _read(self) -> list[TaughtPose]:
        """The poses in the file; none if there is no file.

        Raises:
            BadInput: It cannot be read.
            InvalidFile: With its errors.
        """
        if not self._path.exists():
            return []
        try:
            document = TaughtDocument.model_validate(parse_json(read_text(self._path)))
        except ValidationError as error:
            problems = problems_of(error, TaughtDocument, {})
            raise InvalidFile(str(self._path), problems, AGAIN) from None
        except ValueError as error:
            raise BadInput(str(error), where=str(self._path), next_step=AGAIN) from None
        return list(document.poses)

    def _keep(self, poses: list[TaughtPose]) -> None:
        """Saves the poses, then adopts them."""
        document = TaughtDocument(poses=poses)
        self._path.parent.mkdir(exist_ok=True)
        write_atomic(self._path, document.model_dump_json(indent=1) + "\n")
        self._poses = poses

    def _index(self, name: str) -> int:
        """Index of a pose by name, as its position may have changed since the operator saw it."""
        for index, pose in enumerate(self._poses):
            if pose.name == name:
                return index
        raise _refusal(f"there is no pose '{name}'", "check the list")

    def _require_free(self, name: str) -> None:
        if any(pose.name == name for pose in self._poses):
            raise _refusal(f"there is a pose '{name}' already", "choose another name")


def _rotation_limits(poses: Sequence[TaughtPose]) -> RotationLimitsDocument:
    """Limits that contain all poses and the shortest rotations between them, plus 1°."""
    quaternions = [one.pose().quaternion for one in poses]
    largest = np.degrees([largest_rotations(a, b) for a, b in pairwise(quaternions)])
    tilt, turn = (largest.max(axis=0) + 1.0).tolist()
    return RotationLimitsDocument.containing(tilt, turn)


def _is_at(pose: Pose, other: Pose) -> bool:
    return pose.distance_to(other) <= NEAR and np.degrees(pose.angle_to(other)) <= ALIKE_DEG


def picked_pose(rig: Rig, position_mm: list[float], now: Pose) -> Pose:
    """The pose at a picked position, with the platform's present orientation.

    Args:
        position_mm: x, y, z in the world frame.
        now: The present pose, ``world_from_platform``.

    Raises:
        Refused: It is outside the workspace.
    """
    position = millimetres(position_mm)
    if np.any(position < rig.workspace_lower) or np.any(position > rig.workspace_upper):
        raise Refused(
            "this position is outside the workspace",
            where="console",
            why="the rig file limits x, y and z of the platform",
            next_step="pick another position or height",
        )
    return Pose(position, now.rotation)


def scene_text(document: SceneDocument) -> str:
    """Text of a scene file."""
    data = document.model_dump(mode="json", exclude_defaults=True)
    return yaml.safe_dump(
        {"schema_version": document.schema_version, **data},
        sort_keys=False,
        allow_unicode=True,
        default_flow_style=None,
    )


def _named(pose: PoseDocument, name: str) -> TaughtPose:
    try:
        checked = TypeAdapter(TaughtName).validate_python(name)
    except ValidationError as error:
        reason = sentence_of(error.errors()[0], TaughtPose)
        raise _refusal(
            f"'{name}' is not a valid name: it {reason}", "choose another name"
        ) from None
    given = {"position_mm": pose.position_mm, "rotation_wxyz": pose.rotation_wxyz}
    return TaughtPose(name=checked, **given)


def _refusal(what: str, next_step: str) -> BadInput:
    return BadInput(what, where="taught poses", next_step=next_step)
