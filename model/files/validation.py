"""YAML with positions, and pydantic's findings as readable sentences."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NoReturn, get_args

import numpy as np
import yaml
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from yaml.composer import Composer

from model.errors import Problem
from model.files.reading import SHORTEN

# YAML text as plain data, with the line and column of every key.
#
# Numbers follow YAML 1.2, as users expect: ``1e5`` is a number, ``010`` is ten, ``1:30`` and dates
# are text. (PyYAML's own rules, YAML 1.1, would read text, eight and ninety.)


KeyPath = tuple[str | int, ...]
Positions = dict[KeyPath, tuple[int, int]]

DEPTH_LIMIT, NODE_LIMIT = 40, 40_000
"""Largest nesting depth of a file, and largest number of its keys and values."""

_TAG = "tag:yaml.org,2002:"


@dataclass(frozen=True, slots=True)
class YamlFault:
    """YAML that our files do not allow."""

    key: KeyPath
    what: str
    line: int
    column: int


@dataclass(slots=True)
class YamlTree:
    """The content of a YAML text.

    Attributes:
        data: Dictionaries, lists, text, numbers, booleans and None; None for an empty text.
        positions: Line and column, counted from 1, of every key and list entry.
        faults: YAML that our files do not allow.
        typed: Whether a tag forces the type of some value; ``data`` is then not read.
    """

    data: Any = None
    positions: Positions = field(default_factory=dict)
    faults: list[YamlFault] = field(default_factory=list)
    typed: bool = False


class YamlSyntaxError(ValueError):
    """Text that is not YAML, or too much of it; ``line`` and ``column`` count from 1."""

    def __init__(
        self,
        what: str,
        line: int,
        column: int,
        next_step: str = "check the indentation, colons, quotes and brackets there",
    ) -> None:
        super().__init__(what)
        self.what = what
        self.line = line
        self.column = column
        self.next_step = next_step


class _Loader(Composer, yaml.CSafeLoader):
    """PyYAML's safe loader with the scalars of YAML 1.2's core schema.

    libyaml parses, several times as fast as Python; the nodes are composed here, to be counted.
    """

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012

    def __init__(self, text: str) -> None:
        yaml.CSafeLoader.__init__(self, text)
        Composer.__init__(self)
        self._count, self._depth = 0, 0
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """A node with all its descendants, counted as often as aliases repeat it."""
        event: Any = self.peek_event()
        self._count, self._depth = self._count + 1, self._depth + 1
        if self._depth > DEPTH_LIMIT:
            what, hint = f"nested too deeply, more than {DEPTH_LIMIT} levels", "write it flatter"
            raise _too_much(what, event.start_mark, hint)
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        if not isinstance(event, yaml.AliasEvent):
            self._sizes[id(node)] = self._written_out(node)
        # A node within itself has no size yet; the model reports that it refers to itself.
        what = f"more than {NODE_LIMIT} keys and values"
        if self._count > NODE_LIMIT:
            raise _too_much(what, event.start_mark, SHORTEN)
        if self._sizes.get(id(node), 0) > NODE_LIMIT:
            hint = "write the file without such aliases"
            raise _too_much(f"{what}, with aliases expanded", event.start_mark, hint)
        return node

    def _written_out(self, node: yaml.Node | None) -> int:
        """Number of nodes with aliases and merges expanded."""
        parts: list[yaml.Node] = []
        if isinstance(node, yaml.MappingNode):
            parts = [part for pair in node.value for part in pair]
        elif isinstance(node, yaml.SequenceNode):
            parts = node.value
        return 1 + sum(self._sizes.get(id(part), 0) for part in parts)


def _whole_number(loader: _Loader, node: yaml.ScalarNode) -> int:
    text = loader.construct_scalar(node)
    return int(text, 0) if text[:2] in ("0x", "0o") else int(text)


for _name, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]{1,400}|0x[0-9a-fA-F]{1,99}|0o[0-7]{1,99}", list("-+0123456789")),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"
        r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
    ("merge", "<<", ["<"]),
):
    _Loader.add_implicit_resolver(_TAG + _name, re.compile(f"^(?:{_pattern})$"), _first)
_Loader.add_constructor(_TAG + "int", _whole_number)


def parse_yaml(text: str) -> YamlTree:
    """Reads one YAML document.

    Raises:
        YamlSyntaxError: The text is not YAML; with the first invalid position.
    """
    try:
        return _parsed(text)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line, column = (mark.line + 1, mark.column + 1) if mark else (0, 0)
        raise YamlSyntaxError(_what(error), line, column) from None
    except yaml.reader.ReaderError as error:
        before = text[: error.position]
        line = before.count("\n") + 1
        column = error.position - (before.rfind("\n") + 1) + 1
        what = f"not valid YAML: character #x{int(error.character):04x} is not allowed in a file"
        raise YamlSyntaxError(what, line, column) from None
    except RecursionError:
        raise YamlSyntaxError("not valid here: nested too deeply", 1, 1) from None


def _too_much(what: str, mark: yaml.Mark, hint: str) -> YamlSyntaxError:
    return YamlSyntaxError(f"too much to read: {what}", mark.line + 1, mark.column + 1, hint)


def _parsed(text: str) -> YamlTree:
    tree = YamlTree()
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
    except (yaml.YAMLError, UnicodeEncodeError):
        yaml.compose(text, Loader=yaml.SafeLoader)  # raises the same error, better worded
        raise
    try:
        if node is None:
            return tree
        _walk(loader, node, (), tree, set())
        if not tree.typed:
            tree.data = loader.construct_document(node)
        return tree
    finally:
        loader.dispose()


def _what(error: yaml.MarkedYAMLError) -> str:
    problem = str(error.problem or error)
    if "'\\t'" in problem:
        return "not valid YAML: a tab is used here; indent YAML with spaces"
    context = f" {error.context}" if error.context else ""
    return f"not valid YAML: {problem}{context}"


def _walk(loader: _Loader, node: yaml.Node, path: KeyPath, tree: YamlTree, seen: set[int]) -> None:
    """Records positions and faults; nodes repeated by an alias have the alias's position."""
    position = _position_of(node)
    tree.positions.setdefault(path, position)
    if id(node) in seen:
        return
    seen.add(id(node))
    if not _is_plain(loader, node):
        tag = node.tag.replace(_TAG, "!!")
        tree.faults.append(YamlFault(path, f"YAML tag {tag} is not allowed", *position))
        tree.typed = True
    elif isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            inner = (*path, _name_of(loader, key, path, tree))
            if inner in tree.positions:
                tree.faults.append(YamlFault(inner, "this key appears twice", *_position_of(key)))
            tree.positions[inner] = _position_of(key)
            _walk(loader, value, inner, tree, seen)
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            _walk(loader, value, (*path, index), tree, seen)


def _name_of(loader: _Loader, key: yaml.Node, path: KeyPath, tree: YamlTree) -> str:
    name = str(key.value) if isinstance(key, yaml.ScalarNode) else "?"
    if key.tag not in (_TAG + "str", _TAG + "merge"):
        what = f"the key {name} is not text"
        if key.tag in (_TAG + "int", _TAG + "float"):  # as in {payload_kg: 10,5}
            what += "; in numbers write a decimal point, not a comma"
        tree.faults.append(YamlFault((*path, name), what, *_position_of(key)))
        if not (isinstance(key, yaml.ScalarNode) and _is_plain(loader, key)):
            tree.typed = True
    return name


def _is_plain(loader: _Loader, node: yaml.Node) -> bool:
    """False for a value whose type is forced by a tag such as ``!!int`` or ``!!python/name``."""
    if isinstance(node, yaml.ScalarNode):
        implicit = (not node.style, bool(node.style))
        natural = loader.resolve(yaml.ScalarNode, node.value, implicit)  # type: ignore[no-untyped-call]
        return bool(natural == node.tag)
    return node.tag in (_TAG + "map", _TAG + "seq")


def _position_of(node: yaml.Node) -> tuple[int, int]:
    return node.start_mark.line + 1, node.start_mark.column + 1


#: Sentences by pydantic's error type; ``{…}`` are the limits it gives.
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
    "string_too_long": "must have at most {max_length} characters",
    "string_too_short": "must not be empty",
    "string_unicode": "must be text without broken characters",
    "list_type": "must be a list",
    "model_type": "must hold keys and values",
    "dict_type": "must hold keys and values",
    "model_attributes_type": "must hold keys and values",
    "union_tag_invalid": "its {discriminator} {tag!r} is not one of {expected_tags}",
    "literal_error": "must be {expected}",
    "recursion_loop": "refers to itself",
}


def key_path(parts: KeyPath) -> str:
    """``("winches", 2, "node_id")`` as ``winches[2].node_id``."""
    text = ""
    for part in parts:
        text += f"[{part}]" if isinstance(part, int) else f"{'.' if text else ''}{part}"
    return text


def position_of(parts: KeyPath, positions: Positions) -> tuple[int, int]:
    """Line and column of a key, or of its nearest enclosing part in the file.

    Returns:
        Counted from 1; (0, 0) where no position is known.
    """
    while parts and parts not in positions:
        parts = parts[:-1]
    return positions.get(parts, (0, 0))


def problems_of(
    error: ValidationError, model: type[BaseModel], positions: Positions
) -> list[Problem]:
    """Pydantic's findings as our problems, each with its position in the file."""
    found = []
    for item in error.errors(include_url=False):
        if item["type"] != "invalid_key":  # reported with its position by the YAML reader
            parts = _followed(item["loc"], model)[0]
            found.append(
                Problem(key_path(parts), sentence_of(item, model), *position_of(parts, positions))
            )
    return found


def sentence_of(item: Mapping[str, Any], model: type[BaseModel]) -> str:
    """The problem in words, from one entry of `ValidationError.errors`."""
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
        case "union_tag_not_found":
            kinds = ", ".join(map(repr, _followed(item["loc"], model)[2]))
            return f"must have the key {limits['discriminator']}, which is one of {kinds}"
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
    """The keys that a model has at a path; follows nested models and lists of models."""
    current = _followed(parts, model)[1]
    return list(current.model_fields) if current is not None else []


def _followed(
    parts: KeyPath, model: type[BaseModel]
) -> tuple[KeyPath, type[BaseModel] | None, dict[str, type[BaseModel]]]:
    """A key path as in the file, the model at that path, and the choices if it is one of several.

    Where a key holds one of several models, pydantic adds the name of the chosen one after the key;
    the file has no such part.
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
    return tuple(kept), current, choices


def _choices(field: FieldInfo) -> dict[str, type[BaseModel]]:
    """The models a key may hold, by the value of the discriminating entry."""
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


# Data of a script as of a file, and lists of documents, which cannot be changed.


def plain_data(value: Any) -> Any:
    """A value with dictionaries and lists instead of mappings, tuples and arrays."""
    match value:
        case np.ndarray() | np.generic():
            return value.tolist()
        case Mapping():
            return {str(key): plain_data(one) for key, one in value.items()}
        case list() | tuple():
            return [plain_data(one) for one in value]
        case _:
            return value


class FixedList(list[Any]):
    """A list of a document, which cannot be changed; ``list(it)`` copies it."""

    def _refuse(self, *_given: object, **_named: object) -> NoReturn:
        raise TypeError("this list belongs to a document, which cannot be changed; copy it")

    def __reduce__(self) -> tuple[type[FixedList], tuple[list[Any]]]:
        """Copies cannot be changed either."""
        return type(self), (list(self),)


for _name in ("append", "clear", "extend", "insert", "pop", "remove", "reverse", "sort"):
    setattr(FixedList, _name, FixedList._refuse)
for _name in ("setitem", "delitem", "iadd", "imul"):
    setattr(FixedList, f"__{_name}__", FixedList._refuse)


def fixed(value: Any) -> Any:
    """A value whose lists, also within lists, are fixed."""
    if type(value) is list:
        return FixedList([fixed(entry) if type(entry) is list else entry for entry in value])
    return value
