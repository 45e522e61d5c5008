"""Reading and writing the project's files: all problems at once, content hashes, atomic writes."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from cdpr.document_types import Document, Finding
from cdpr.errors import BadInput, InvalidFile, Problem
from cdpr.file_problems import key_path, model_in, place_of, problems_of
from cdpr.yaml_tree import KeyPath, Places, YamlSyntaxError, YamlTree, parse_yaml

__all__ = [
    "check_version",
    "content_hash",
    "document_hash",
    "key_path",
    "load_yaml",
    "problems_of",
    "read_text",
    "read_yaml",
    "write_atomic",
    "write_bytes_atomic",
]

Model = TypeVar("Model", bound=Document)


def read_text(path: Path) -> str:
    """The text of a file.

    Raises:
        BadInput: The file is missing, a folder, unreadable or not UTF-8.
    """
    try:
        return path.read_bytes().decode("utf-8-sig").replace("\r\n", "\n")
    except FileNotFoundError:
        what, why, hint = "no such file", "", "check the path and its spelling"
    except IsADirectoryError:
        what, why, hint = "this is a folder", "", "name a file"
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        what = f"the file is not UTF-8 text: byte 0x{error.object[error.start]:02x} in line {line}"
        why, hint = "it is no text file, or in another encoding", "save it as UTF-8"
    except OSError as error:
        what, why = "the file cannot be read", error.strerror or str(error)
        hint = "check the path and who may read it"
    raise BadInput(what, where=str(path), why=why, next_step=hint)


def read_yaml(path: Path) -> YamlTree:
    """The plain data of a YAML file, with the place of every key.

    Raises:
        BadInput: The file cannot be read.
        InvalidFile: It is not YAML.
    """
    try:
        return parse_yaml(read_text(path))
    except YamlSyntaxError as error:
        hint = "check the indentation, colons, quotes and brackets there"
        problem = Problem("", error.what, error.line, error.column)
        raise InvalidFile(str(path), [problem], hint) from None


def load_yaml(path: Path, model: type[Model]) -> Model:
    """Reads a YAML file into ``model``, or tells every problem with file:line:column.

    Raises:
        BadInput: The file cannot be read.
        InvalidFile: It is not YAML, has a key twice, or does not fit the model.
    """
    tree = read_yaml(path)
    problems = [Problem(key_path(f.key), f.what, f.line, f.column) for f in tree.faults]
    if isinstance(tree.data, dict):
        check_version(tree.data, model, path, tree.places)
        document, found = _validated(tree.data, model, tree.places)
        problems += found
        if document is not None and not problems:
            return document
    elif not problems:
        empty = tree.data is None
        what = "the file is empty" if empty else "the file must hold keys and values"
        problems.append(Problem("", what, 1, 1))
    raise InvalidFile(str(path), sorted(problems, key=lambda p: (p.line, p.column)))


def check_version(
    data: Mapping[str, Any], model: type[Document], path: Path, places: Places, next_step: str = ""
) -> None:
    """Refuses a file of another schema version before anything else in it is judged.

    Raises:
        InvalidFile: With that one problem.
    """
    field, key = model.model_fields.get("schema_version"), "schema_version"
    version = data.get(key)
    if field is None or type(version) is not int:
        return
    (known,) = field.annotation.__args__  # type: ignore[union-attr]
    if version != known:
        what = f"the file is of schema version {version}; this program reads version {known}"
        hint = next_step or f"bring the file to version {known}, or use the program it was made for"
        raise InvalidFile(str(path), [Problem(key, what, *place_of((key,), places))], hint)


def _validated(
    data: dict[str, Any], model: type[Model], places: Places
) -> tuple[Model | None, list[Problem]]:
    document: Model | None = None
    problems: list[Problem] = []
    try:
        document = model.model_validate(data)
        found = document.findings()
    except ValidationError as error:
        problems = problems_of(error, model, places)
        found = _findings_of_sound_parts(data, model, error)
    problems += [Problem(key_path(parts), what, *place_of(parts, places)) for parts, what in found]
    return (document if not problems else None), problems


def _findings_of_sound_parts(
    data: dict[str, Any], model: type[Document], error: ValidationError
) -> list[Finding]:
    """What the rules between parts find, where the parts they read are sound."""
    unsound = {
        item["loc"]
        for item in error.errors(include_url=False)
        if item["type"] not in ("missing", "extra_forbidden")
    }
    partial: Any = _unchecked(model, data, (), unsound)
    found: list[Finding] = []
    for rule in partial.rules():
        with suppress(AttributeError, TypeError):  # the rule reads a part that is not sound
            found += rule()
    return found


def _unchecked(annotation: Any, value: Any, path: KeyPath, unsound: set[KeyPath]) -> Any:
    """Documents of plain data; in place of an unsound value an object that nothing can use."""
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
    """SHA-256 of a JSON-like document, whatever the order of its keys or its layout."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return "sha256:" + hashlib.sha256(text.encode()).hexdigest()


def document_hash(document: BaseModel, without: Collection[str] = ()) -> str:
    """SHA-256 of what a document says.

    A key that stands at its default counts as left out. So a key that a later version of the
    program adds changes no hash, and a default that it changes does.

    Args:
        document: Read or made.
        without: Keys at its top that do not count.
    """
    said = document.model_dump(mode="json", exclude_defaults=True)
    return content_hash({key: value for key, value in said.items() if key not in without})


def write_atomic(path: Path, text: str) -> None:
    """Writes a whole text file or nothing.

    Raises:
        BadInput: The folder is missing, cannot be written to or is full.
    """
    write_bytes_atomic(path, text.encode())


def write_bytes_atomic(path: Path, data: bytes) -> None:
    """Writes a whole file or nothing.

    Raises:
        BadInput: The folder is missing, cannot be written to or is full.
    """
    if path.is_dir():
        raise BadInput("this is a folder", where=str(path), next_step="name a file")
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        hint = "choose a folder that exists and that you may write to"
        raise _not_written(path, error, hint) from None
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(handle)  # or a power cut could leave the new name on an empty file
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
        _keep_names(path.parent)
    except OSError as error:
        raise _not_written(path, error, "free some space or choose another folder") from None
    finally:
        Path(temporary).unlink(missing_ok=True)  # gone already when all went well


def _keep_names(folder: Path) -> None:
    """A new name outlives a power cut only once its folder is on disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _not_written(path: Path, error: OSError, next_step: str) -> BadInput:
    return BadInput(
        "the file cannot be written",
        where=str(path),
        why=error.strerror or str(error),
        next_step=next_step,
    )
