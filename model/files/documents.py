"""Reading and writing the project's files: all problems at once, content hashes, atomic writes."""

from __future__ import annotations

import hashlib
import json
import math
import os
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    JsonValue,
    ValidationError,
    model_validator,
)

from model.errors import BadInput, InvalidFile, Problem
from model.files.output import keep_names
from model.files.reading import YAML_LIMIT, read_text
from model.files.validation import (
    KeyPath,
    Positions,
    YamlSyntaxError,
    YamlTree,
    fixed,
    key_path,
    model_in,
    parse_yaml,
    plain_data,
    position_of,
    problems_of,
)
from model.pose import Array, Pose

# Parts shared by rig, scene and plan files: strict models, vectors, poses.


LARGEST, SMALLEST = 1e12, 1e-12
"""No size, force or count of a robot is beyond these in any unit; sums and squares of values within
them stay finite."""
WHOLE_LARGEST = 2**31 - 1
"""Limit of drive positions and other whole numbers."""
SEED_LARGEST = COUNT_LARGEST = 2**63 - 1
"""Limit of seeds, and of what a search counts: half an hour checks more than 2**31 edges."""
NAME_BYTES = 100
"""Longest name in UTF-8: it becomes part of file names."""


def in_schema(**keys: JsonValue) -> Any:
    """Keys of the JSON schema for what a validator or rule checks with a message of its own."""
    return Field(json_schema_extra=keys)


def _not_too_small(value: float) -> float:
    if value < SMALLEST:
        raise ValueError(f"must be {SMALLEST:g} or more; it is {value:g}")
    return value


def _is_name(text: str) -> str:
    if not text.isprintable():
        raise ValueError(f"must be a name on one line; it is {text[:60]!r}")
    if (size := len(text.encode())) > NAME_BYTES:
        raise ValueError(f"must have {NAME_BYTES} bytes at most; it has {size}")
    return text


Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Positive = Annotated[
    float,
    Field(gt=0, le=LARGEST, allow_inf_nan=False),
    AfterValidator(_not_too_small),
    in_schema(minimum=SMALLEST),
]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST, allow_inf_nan=False)]
AnyNumber = Annotated[float, Field(allow_inf_nan=False)]
"""Of a calibration result: intervals of what cannot be identified may be arbitrarily wide."""
AnyNonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1), AfterValidator(_is_name)]
Seed = Annotated[int, Field(ge=0, le=SEED_LARGEST)]


def _exactly(count: int) -> BeforeValidator:
    """States the exact length of a list; pydantic alone would say "at least"."""

    def check(value: object) -> object:
        if isinstance(value, list) and len(value) != count:
            raise ValueError(f"needs {count} entries, it has {len(value)}")
        return value

    return BeforeValidator(check)


three = (Field(min_length=3, max_length=3), _exactly(3))
Vector = Annotated[list[Number], *three]
PositiveVector = Annotated[list[Positive], *three]
NonNegativeVector = Annotated[list[NonNegative], *three]
Triple = Annotated[list[Annotated[int, Field(ge=-WHOLE_LARGEST, le=WHOLE_LARGEST)]], *three]


def _length_one(what: str) -> AfterValidator:
    def check(vector: list[float]) -> list[float]:
        length = math.sqrt(sum(x * x for x in vector))
        if abs(length - 1.0) > 1e-6:
            raise ValueError(f"must be a {what}; its length is {length:.8g}")
        return vector

    return AfterValidator(check)


Quaternion = Annotated[
    list[Number],
    Field(min_length=4, max_length=4),
    _exactly(4),
    _length_one("unit quaternion [w, x, y, z]"),
]
UnitVector = Annotated[Vector, _length_one("direction of length 1")]


def _holds_whole(annotation: Any) -> bool:
    """Whether a key holds whole numbers, alone, in lists or optionally."""
    is_whole = annotation is int or type(annotation) is int  # one of a `Literal`
    return is_whole or any(map(_holds_whole, getattr(annotation, "__args__", ())))


def _whole(value: Any) -> Any:
    """A float that is a whole number as such, also in lists; not one with rounded digits."""
    if isinstance(value, list):
        return [_whole(entry) for entry in value]
    is_whole = isinstance(value, float) and value.is_integer() and abs(value) <= 2**53
    return int(value) if is_whole else value


Finding = tuple[tuple[str | int, ...], str]
"""Path of a key, and a sentence that states its problem."""


class Document(BaseModel):
    """A strict part of a file: unknown keys, wrong types, NaN and infinity are refused.

    Neither its keys nor its lists can be changed: hashes and checked objects are made from it.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _take_whole_numbers(cls, data: Any) -> Any:
        """Takes 1e6 and 1000000.0 for whole numbers."""
        if not isinstance(data, dict):
            return data
        keys = [key for key, field in cls.model_fields.items() if _holds_whole(field.annotation)]
        return data | {key: _whole(data[key]) for key in keys if key in data}

    @model_validator(mode="after")
    def _fix_lists(self) -> Self:
        for key, value in self.__dict__.items():
            self.__dict__[key] = fixed(value)
        return self

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """A copy with other values for some keys, which are not checked."""
        fixed_update = {key: fixed(value) for key, value in (update or {}).items()}
        return super().model_copy(update=fixed_update, deep=deep)

    def rules(self) -> Sequence[Callable[[], list[Finding]]]:
        """Checks across the document's parts; each reads as few of them as possible.

        In a file with other problems, only rules whose parts are valid are applied, so that one
        reading reports everything.
        """
        return ()

    def findings(self) -> list[Finding]:
        """Problems across the parts of the document."""
        return [finding for rule in self.rules() for finding in rule()]


class PoseDocument(Document):
    """A pose: position in mm and a unit quaternion (level when left out)."""

    position_mm: Vector
    rotation_wxyz: Quaternion = [1.0, 0.0, 0.0, 0.0]

    def pose(self) -> Pose:
        """The same pose in metres."""
        quaternion = np.asarray(self.rotation_wxyz)
        unit = quaternion / np.linalg.norm(quaternion)
        return Pose.from_quaternion(np.asarray(self.position_mm) / 1000.0, unit)

    def bare(self) -> PoseDocument:
        """The pose alone, without the document's other keys."""
        return PoseDocument(position_mm=self.position_mm, rotation_wxyz=self.rotation_wxyz)

    @staticmethod
    def of(pose: Pose) -> PoseDocument:
        """The document of a pose; positions rounded to a nanometre, without negative zeros."""
        return PoseDocument(
            position_mm=[round(float(x) * 1000.0, 6) + 0.0 for x in pose.position],
            rotation_wxyz=[float(q) for q in pose.quaternion],
        )


def millimetres(values: Sequence[float] | Sequence[Sequence[float]]) -> Array:
    """Numbers in mm as an array of the same shape in m."""
    return np.asarray(values, dtype=np.float64) / 1000.0


Model = TypeVar("Model", bound=Document)


def read_yaml(path: Path) -> YamlTree:
    """The plain data of a YAML file, with the position of every key.

    Raises:
        BadInput: The file cannot be read.
        InvalidFile: It is not YAML.
    """
    try:
        # `rostopic echo` ends every message with the mark of a next document.
        return parse_yaml(read_text(path, YAML_LIMIT).rstrip().removesuffix("\n---") + "\n")
    except YamlSyntaxError as error:
        problem = Problem("", error.what, error.line, error.column)
        raise InvalidFile(str(path), [problem], error.next_step) from None


def load_yaml(path: Path, model: type[Model]) -> Model:
    """Reads a YAML file into ``model``, or reports every problem with file:line:column.

    Raises:
        BadInput: The file cannot be read.
        InvalidFile: It is not YAML, has a key twice, or does not fit the model.
    """
    tree = read_yaml(path)
    problems = [Problem(key_path(f.key), f.what, f.line, f.column) for f in tree.faults]
    if isinstance(tree.data, dict):
        _require_kind(tree.data, model, path)
        check_version(tree.data, model, path, tree.positions)
        document, found = _validated(tree.data, model, tree.positions)
        problems += found
        if document is not None and not problems:
            return document
    elif not problems:
        empty = tree.data is None
        what = "the file is empty" if empty else "the file must hold keys and values"
        problems.append(Problem("", what, 1, 1))
    raise InvalidFile(str(path), sorted(problems, key=lambda p: (p.line, p.column)))


def document_of(data: Mapping[str, Any], model: type[Model], where: str) -> Model:
    """A document from a file's keys and values in Python, arrays included.

    Raises:
        InvalidFile: With every key that does not fit.
    """
    try:
        plain = plain_data(data)
    except RecursionError:
        raise BadInput("the dictionary contains itself", where=where) from None
    if not isinstance(plain, dict):
        what = f"expected keys and values in a dictionary, not {type(data).__name__}"
        raise BadInput(what, where=where)
    _require_kind(plain, model, Path(where))
    check_version(plain, model, Path(where), {})
    document, problems = _validated(plain, model, {})
    if document is None:
        raise InvalidFile(where, problems, "correct these keys; the pages on files describe them")
    return document


_MARKS = {
    "plan file": ("rig_hash", "waypoints"),
    "rig file": ("outlets_mm", "winches"),
    "scene file": ("start", "goal"),
    "calibration result": ("kind", "data_sha256"),
}
"""Keys that occur together in only one kind of file."""


def _require_kind(data: Mapping[str, Any], model: type[Document], path: Path) -> None:
    """Refuses a file of another kind, as when the arguments of a command are swapped."""
    known = model.model_fields
    wanted = [kind for kind, marks in _MARKS.items() if all(key in known for key in marks)]
    given = [kind for kind, marks in _MARKS.items() if all(key in data for key in marks)]
    if wanted and given and given[0] not in wanted:
        raise BadInput(
            f"this is a {given[0]}, not a {wanted[0]}",
            where=str(path),
            why="the wrong file was named, or the files in the wrong order",
            next_step=f"pass a {wanted[0]} here; the command's --help shows the order",
        )


def check_version(
    data: Mapping[str, Any],
    model: type[BaseModel],
    path: Path,
    positions: Positions,
    next_step: str = "",
) -> None:
    """Refuses a file of another schema version before checking anything else in it.

    Raises:
        InvalidFile: With that one problem.
    """
    field, key = model.model_fields.get("schema_version"), "schema_version"
    version = _whole(data.get(key))
    if field is None or not isinstance(version, int):
        return
    (known,) = field.annotation.__args__  # type: ignore[union-attr]
    if version != known or isinstance(version, bool):
        what = f"the file has schema version {version}; this program reads version {known}"
        hint = next_step or f"bring the file to version {known}, or use the program it was made for"
        if next_step and version > known:
            hint = f"use the version of cdpr that wrote the file, or {next_step}"
        raise InvalidFile(str(path), [Problem(key, what, *position_of((key,), positions))], hint)


def _validated(
    data: dict[str, Any], model: type[Model], positions: Positions
) -> tuple[Model | None, list[Problem]]:
    document: Model | None = None
    problems: list[Problem] = []
    try:
        document = model.model_validate(data)
        found = document.findings()
    except ValidationError as error:
        problems = problems_of(error, model, positions)
        found = findings_of_sound_parts(data, model, error.errors(include_url=False))
    problems += [
        Problem(key_path(parts), what, *position_of(parts, positions)) for parts, what in found
    ]
    return (document if not problems else None), problems


def findings_of_sound_parts(
    data: dict[str, Any], model: type[Document], errors: Sequence[Any] = ()
) -> list[Finding]:
    """Findings of the rules whose parts are there and valid; ``errors`` are pydantic's."""
    unsound = {item["loc"] for item in errors if item["type"] not in ("missing", "extra_forbidden")}
    partial: Any = _unchecked(model, data, (), unsound)
    found: list[Finding] = []
    for rule in partial.rules():
        # The rule may read an invalid part, such as a point of two numbers.
        with suppress(AttributeError, TypeError, ValueError, ArithmeticError, LookupError):
            found += rule()
    return found


def _unchecked(annotation: Any, value: Any, path: KeyPath, unsound: set[KeyPath]) -> Any:
    """Documents from plain data, unchecked; an invalid value becomes a bare `object`."""
    if path in unsound:
        return object()
    model = model_in(annotation)
    if isinstance(value, dict) and model is not None:
        fields = model.model_fields
        parts = {
            key: _unchecked(fields[key].annotation, part, (*path, key), unsound)
            for key, part in value.items()
            if key in fields
        }
        return model.model_construct(**parts)
    if isinstance(value, list):
        return [_unchecked(annotation, v, (*path, i), unsound) for i, v in enumerate(value)]
    return value


def content_hash(document: Any) -> str:
    """SHA-256 of a JSON-like document, independent of key order and layout."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return "sha256:" + hashlib.sha256(text.encode()).hexdigest()


def document_hash(document: BaseModel, without: Collection[str] = ()) -> str:
    """SHA-256 of a document's content.

    A key with its default value counts as left out. So a key added by a later version of the
    program changes no hash; a changed default does.

    Args:
        without: Top-level keys that do not count.
    """
    content = document.model_dump(mode="json", exclude_defaults=True)
    return content_hash({key: value for key, value in content.items() if key not in without})


def write_atomic(path: Path, text: str, *, durable: bool = False) -> None:
    """As `write_bytes_atomic`, for text."""
    write_bytes_atomic(path, text.encode(errors="backslashreplace"), durable=durable)


def write_bytes_atomic(path: Path, data: bytes, *, durable: bool = False) -> None:
    """Writes a whole file or nothing.

    Args:
        durable: As for `keep_names`.

    Raises:
        BadInput: The folder is missing, cannot be written to or is full.
    """
    try:
        if path.is_dir():
            raise BadInput("this is a folder", where=str(path), next_step="name a file")
        if path.exists() and not path.is_file():
            what = "not a regular file but a device, a pipe or a socket"
            raise BadInput(what, where=str(path), next_step="name a file")
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name[:40]}.")
    except OSError as error:
        hint = "choose an existing folder with write permission"
        raise _not_written(path, error, hint) from None
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(handle)  # or a power failure could leave the new name on an empty file
        with suppress(PermissionError):  # a mount that gives all files one owner and mode
            Path(temporary).chmod(0o644)
        if durable:
            keep_names(path.parent, durable=True)  # refuses before anything is replaced
        Path(temporary).replace(path)
        keep_names(path.parent)
    except OSError as error:
        raise _not_written(path, error, "free some space or choose another folder") from None
    finally:
        Path(temporary).unlink(missing_ok=True)  # already renamed on success


def _not_written(path: Path, error: OSError, next_step: str) -> BadInput:
    return BadInput(
        "the file cannot be written",
        where=str(path),
        why=error.strerror or str(error),
        next_step=next_step,
    )
