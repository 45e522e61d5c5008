"""Reading and writing the project's files: positions of keys, content hashes, atomic writes."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from cdpr.document_types import Document
from cdpr.errors import BadInput, InvalidFile, Problem

Model = TypeVar("Model", bound=Document)
Places = dict[tuple[str | int, ...], tuple[int, int]]


def read_text(path: Path) -> str:
    """The text of a file.

    Raises:
        BadInput: The file is missing, a folder, unreadable or not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise BadInput(
            "no such file", where=str(path), next_step="check the path and its spelling"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(
            "the file cannot be read",
            where=str(path),
            why=str(error),
            next_step="check the file",
        ) from None


def load_yaml(path: Path, model: type[Model]) -> Model:
    """Reads a YAML file into ``model``, or tells every problem with file:line:column.

    Raises:
        BadInput: The file cannot be read.
        InvalidFile: It is not YAML, has a key twice, or does not fit the model.
    """
    text = read_text(path)
    places: Places = {}
    problems: list[Problem] = []
    try:
        node = yaml.compose(text, Loader=yaml.SafeLoader)
        if node is not None:
            _walk(node, (), places, problems)
        data = yaml.safe_load(text)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line, column = (mark.line + 1, mark.column + 1) if mark else (0, 0)
        what = f"not valid YAML: {error.problem or error}"
        raise InvalidFile(str(path), [Problem("", what, line, column)]) from None
    if not isinstance(data, dict):
        problems.append(Problem("", "must be a mapping of keys to values", 1, 1))
        raise InvalidFile(str(path), problems)
    try:
        document = model.model_validate(data)
    except ValidationError as error:
        problems += problems_of(error, model, places)
        raise InvalidFile(
            str(path), sorted(problems, key=lambda p: (p.line, p.column))
        ) from None
    for parts, what in document.findings():
        problems.append(Problem(key_path(parts), what, *_place(parts, places)))
    if problems:
        raise InvalidFile(str(path), problems)
    return document


def _walk(
    node: yaml.Node,
    path: tuple[str | int, ...],
    places: Places,
    problems: list[Problem],
) -> None:
    mark = node.start_mark
    places.setdefault(path, (mark.line + 1, mark.column + 1))
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            inner = (*path, str(key.value))
            if inner in places:
                problems.append(
                    Problem(
                        key_path(inner),
                        "this key stands twice",
                        key.start_mark.line + 1,
                        key.start_mark.column + 1,
                    )
                )
            places[inner] = (key.start_mark.line + 1, key.start_mark.column + 1)
            _walk(value, inner, places, problems)
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            _walk(value, (*path, index), places, problems)


def key_path(parts: tuple[str | int, ...]) -> str:
    """``("winches", 2, "node_id")`` as ``winches[2].node_id``."""
    text = ""
    for part in parts:
        text += f"[{part}]" if isinstance(part, int) else f"{'.' if text else ''}{part}"
    return text


def problems_of(
    error: ValidationError, model: type[BaseModel], places: Places
) -> list[Problem]:
    """Pydantic's findings as our problems, each with its place in the file."""
    found = []
    for item in error.errors(include_url=False):
        parts = tuple(p for p in item["loc"] if not _is_tag(p))
        line, column = _place(parts, places)
        found.append(
            Problem(key_path(parts), _sentence(item, model, parts), line, column)
        )
    return found


def _is_tag(part: str | int) -> bool:
    """True for the parts that pydantic adds for functions and unions."""
    return isinstance(part, str) and ("[" in part or "(" in part)


def _place(parts: tuple[str | int, ...], places: Places) -> tuple[int, int]:
    while parts and parts not in places:
        parts = parts[:-1]
    return places.get(parts, (1, 1))


def _sentence(item: Any, model: type[BaseModel], parts: tuple[str | int, ...]) -> str:
    kind, message = str(item["type"]), str(item["msg"])
    if kind == "extra_forbidden":
        known = _known_keys(model, parts[:-1])
        hint = f"; the keys here are: {', '.join(known)}" if known else ""
        return f"unknown key {parts[-1]!r}{hint}"
    if kind == "missing":
        return "this key is missing"
    if kind == "value_error":
        return message.removeprefix("Value error, ")
    text = message[0].lower() + message[1:]
    value = item.get("input")
    if isinstance(value, str | int | float | bool):
        text += f" (it is {value!r})"
    return text


def _known_keys(model: type[BaseModel], parts: tuple[str | int, ...]) -> list[str]:
    """The keys a model knows at a place; follows nested models and lists of models."""
    current: Any = model
    for part in parts:
        if isinstance(part, int):
            continue
        field = getattr(current, "model_fields", {}).get(part)
        current = _inner_model(field.annotation) if field is not None else None
        if current is None:
            return []
    return list(current.model_fields)


def _inner_model(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        inner = _inner_model(argument)
        if inner is not None:
            return inner
    return None


def content_hash(document: Any) -> str:
    """SHA-256 of a JSON-like document, whatever the order of its keys or its layout."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return "sha256:" + hashlib.sha256(text.encode()).hexdigest()


def write_atomic(path: Path, text: str) -> None:
    """Writes a whole file or nothing.

    Raises:
        BadInput: The folder is missing or cannot be written to.
    """
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise BadInput(
            "the file cannot be written",
            where=str(path),
            why=error.strerror or str(error),
            next_step="choose a folder that exists and that you may write to",
        ) from None
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(text)
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except OSError as error:
        Path(temporary).unlink(missing_ok=True)
        raise BadInput(
            "the file cannot be written",
            where=str(path),
            why=error.strerror or str(error),
            next_step="free some space or choose another folder",
        ) from None
