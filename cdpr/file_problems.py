"""What pydantic finds in a file, said in sentences for people."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from cdpr.errors import Problem
from cdpr.yaml_tree import KeyPath, Places

#: Sentences by pydantic's kind of finding; ``{…}`` are the limits it gives.
SENTENCES = {
    "missing": "this key is missing",
    "greater_than": "must be more than {gt:g}",
    "greater_than_equal": "must be {ge:g} or more",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be {le:g} or less",
    "finite_number": "must be a finite number",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "string_type": "must be text",
    "string_too_short": "must not be empty",
    "string_unicode": "must be text without broken characters",
    "list_type": "must be a list",
    "model_type": "must hold keys and values",
    "dict_type": "must hold keys and values",
    "model_attributes_type": "must hold keys and values",
    "union_tag_invalid": "its {discriminator} {tag!r} is none of {expected_tags}",
    "union_tag_not_found": "must tell its {discriminator}",
    "literal_error": "must be {expected}",
    "recursion_loop": "refers to itself",
}


def key_path(parts: KeyPath) -> str:
    """``("winches", 2, "node_id")`` as ``winches[2].node_id``."""
    text = ""
    for part in parts:
        text += f"[{part}]" if isinstance(part, int) else f"{'.' if text else ''}{part}"
    return text


def place_of(parts: KeyPath, places: Places) -> tuple[int, int]:
    """Line and column of a key, or of the nearest part around it that the file has.

    Returns:
        Counted from 1; (0, 0) where no places are known.
    """
    while parts and parts not in places:
        parts = parts[:-1]
    return places.get(parts, (0, 0))


def problems_of(error: ValidationError, model: type[BaseModel], places: Places) -> list[Problem]:
    """Pydantic's findings as our problems, each with its place in the file."""
    found = []
    for item in error.errors(include_url=False):
        if item["type"] != "invalid_key":  # told with its place by whoever read the text
            parts, _ = _followed(item["loc"], model)
            found.append(
                Problem(key_path(parts), sentence_of(item, model), *place_of(parts, places))
            )
    return found


def sentence_of(item: Mapping[str, Any], model: type[BaseModel]) -> str:
    """What is wrong, from one entry of `ValidationError.errors`."""
    kind, limits, value = str(item["type"]), item.get("ctx", {}), item.get("input")
    match kind:
        case "extra_forbidden":
            return _unknown_key(item["loc"], model)
        case "missing":
            return SENTENCES[kind]
        case "value_error":
            return str(item["msg"]).removeprefix("Value error, ")
        case "too_short":
            return f"needs {_entries(limits['min_length'])} or more, it has {len(value or ())}"
        case "too_long":
            return f"takes {_entries(limits['max_length'])} at most, it has {len(value or ())}"
    if kind in SENTENCES:
        text = SENTENCES[kind].format(**limits)
    else:
        text = str(item["msg"]).replace("Input should be", "must be")
    return f"{text} ({_shown(value)})"


def _shown(value: object) -> str:
    match value:
        case None:
            return "it is empty"
        case bool():
            return f"it is {str(value).lower()}"
        case int() | float():
            return f"it is {str(value)[:40]}"
        case str():
            return f"it is the text {value[:60]!r}"
        case Mapping():
            return "it holds keys and values"
        case Sequence():
            return f"it is a list of {_entries(len(value))}"
        case _:
            return f"it is {value!r}"


def _entries(count: int) -> str:
    return "1 entry" if count == 1 else f"{count} entries"


def _unknown_key(parts: KeyPath, model: type[BaseModel]) -> str:
    name = str(parts[-1])
    known = _known_keys(model, parts[:-1])
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    keys = f" The keys here are: {', '.join(known)}" if known else ""
    return f"unknown key {name!r}{hint or ('.' if keys else '')}{keys}"


def _known_keys(model: type[BaseModel], parts: KeyPath) -> list[str]:
    """The keys a model knows at a place; follows nested models and lists of models."""
    _, current = _followed(parts, model)
    return list(current.model_fields) if current is not None else []


def _followed(parts: KeyPath, model: type[BaseModel]) -> tuple[KeyPath, type[BaseModel] | None]:
    """A place as the file has it, and the model that stands there.

    Where a key holds one of several models, pydantic puts the name of the one chosen behind the
    key; the file has no such part.
    """
    current: type[BaseModel] | None = model
    kept: list[str | int] = []
    choices: dict[str, type[BaseModel]] = {}
    for part in parts:
        if part in choices:
            current, choices = choices[str(part)], {}
            continue
        kept.append(part)
        if isinstance(part, int) or current is None:
            continue
        field = current.model_fields.get(part)
        choices = _choices(field) if field is not None else {}
        current = model_in(field.annotation) if field is not None else None
    return tuple(kept), current


def _choices(field: FieldInfo) -> dict[str, type[BaseModel]]:
    """The models a key may hold, by the value of the entry that tells them apart."""
    if not isinstance(field.discriminator, str):
        return {}
    name, found = field.discriminator, {}
    for model in get_args(field.annotation):
        found.update(dict.fromkeys(get_args(model.model_fields[name].annotation), model))
    return found


def model_in(annotation: Any) -> type[BaseModel] | None:
    """The model that a field holds, alone, in a list or optionally; None for other fields."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        inner = model_in(argument)
        if inner is not None:
            return inner
    return None
