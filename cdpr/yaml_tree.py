"""YAML text as plain data, with the line and column of every key.

Numbers follow YAML 1.2, as people expect them: ``1e5`` is a number, ``010`` is ten, ``1:30`` and
dates are text. (PyYAML's own rules, YAML 1.1, would read text, eight and ninety.)
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import yaml

KeyPath = tuple[str | int, ...]
Places = dict[KeyPath, tuple[int, int]]

_TAG = "tag:yaml.org,2002:"


@dataclass(frozen=True, slots=True)
class YamlFault:
    """Something that YAML allows and our files do not."""

    key: KeyPath
    what: str
    line: int
    column: int


@dataclass(slots=True)
class YamlTree:
    """What a YAML text holds.

    Attributes:
        data: Dictionaries, lists, text, numbers, booleans and None; None for an empty text.
        places: Line and column, counted from 1, of every key and list entry.
        faults: What YAML allows and our files do not.
        typed: Some value has its type forced by a tag; ``data`` is not read then.
    """

    data: Any = None
    places: Places = field(default_factory=dict)
    faults: list[YamlFault] = field(default_factory=list)
    typed: bool = False


class YamlSyntaxError(ValueError):
    """Text that is not YAML; ``line`` and ``column`` count from 1."""

    def __init__(self, what: str, line: int, column: int) -> None:
        super().__init__(what)
        self.what = what
        self.line = line
        self.column = column


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader with the scalars of YAML 1.2's core schema."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012


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
        YamlSyntaxError: The text is not YAML; with the first place where it is not.
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


def _parsed(text: str) -> YamlTree:
    tree = YamlTree()
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
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
        return "not valid YAML: a tab stands here; YAML is indented with spaces"
    context = f" {error.context}" if error.context else ""
    return f"not valid YAML: {problem}{context}"


def _walk(loader: _Loader, node: yaml.Node, path: KeyPath, tree: YamlTree, seen: set[int]) -> None:
    """Notes places and faults; what an alias repeats has the place of the alias."""
    place = _place_of(node)
    tree.places.setdefault(path, place)
    if id(node) in seen:
        return
    seen.add(id(node))
    if not _is_plain(loader, node):
        tag = node.tag.replace(_TAG, "!!")
        tree.faults.append(YamlFault(path, f"YAML tag {tag} is not allowed", *place))
        tree.typed = True
    elif isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            inner = (*path, _name_of(loader, key, path, tree))
            if inner in tree.places:
                tree.faults.append(YamlFault(inner, "this key stands twice", *_place_of(key)))
            tree.places[inner] = _place_of(key)
            _walk(loader, value, inner, tree, seen)
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            _walk(loader, value, (*path, index), tree, seen)


def _name_of(loader: _Loader, key: yaml.Node, path: KeyPath, tree: YamlTree) -> str:
    name = str(key.value) if isinstance(key, yaml.ScalarNode) else "?"
    if key.tag not in (_TAG + "str", _TAG + "merge"):
        what = f"the key {name} is not text"
        tree.faults.append(YamlFault((*path, name), what, *_place_of(key)))
    return name


def _is_plain(loader: _Loader, node: yaml.Node) -> bool:
    """False for a value whose type is forced by a tag such as ``!!int`` or ``!!python/name``."""
    if isinstance(node, yaml.ScalarNode):
        implicit = (node.style is None, node.style is not None)
        natural = loader.resolve(yaml.ScalarNode, node.value, implicit)  # type: ignore[no-untyped-call]
        return bool(natural == node.tag)
    return node.tag in (_TAG + "map", _TAG + "seq")


def _place_of(node: yaml.Node) -> tuple[int, int]:
    return node.start_mark.line + 1, node.start_mark.column + 1
