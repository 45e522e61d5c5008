"""YAML as users mean it: numbers of YAML 1.2, and the position of everything."""

from __future__ import annotations

import math
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from model.files.validation import YamlSyntaxError, parse_yaml


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("10", 10),
        ("010", 10),
        ("-7", -7),
        ("0x1F", 31),
        ("0o17", 15),
        ("1e5", 1e5),
        ("8.5E-3", 8.5e-3),
        ("1.", 1.0),
        (".5", 0.5),
        ("-.5", -0.5),
        (".inf", math.inf),
        ("-.inf", -math.inf),
        ("~", None),
        ("null", None),
        ("", None),
        ("true", True),
        ("False", False),
        ("yes", "yes"),
        ("off", "off"),
        ("1:30", "1:30"),
        ("2024-01-31", "2024-01-31"),
        ("1_000", "1_000"),
        ("'10'", "10"),
        ("1e", "1e"),
        ("0x", "0x"),
        ("-", [None]),
        ("1.2.3", "1.2.3"),
    ],
)
def test_a_scalar_is_what_it_looks_like(text: str, value: object) -> None:
    data = parse_yaml(f"a: {text}\n" if text != "-" else "a:\n  -\n").data
    assert data == {"a": value}
    assert type(data["a"]) is type(value)


def test_not_a_number_is_read_as_such() -> None:
    assert math.isnan(parse_yaml("a: .nan").data["a"])


@given(st.floats(allow_nan=False))
def test_every_float_that_python_prints_comes_back(value: float) -> None:
    text = repr(value).replace("inf", ".inf")
    assert float(parse_yaml(f"a: {text}").data["a"]) == value


@given(st.integers(-(10**30), 10**30))
def test_every_integer_comes_back(value: int) -> None:
    assert parse_yaml(f"a: {value}").data == {"a": value}


plain_text = st.text(st.characters(codec="ascii", exclude_categories=("Cc",)), min_size=1)
trees = st.recursive(
    st.one_of(st.integers(-9, 9), st.booleans(), st.none(), plain_text.map(lambda s: f"t {s}")),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(st.sampled_from(["alpha", "beta", "gamma"]), inner, max_size=3),
    ),
    max_leaves=12,
)


@given(trees, st.sampled_from([True, False, None]))
def test_each_value_is_at_its_stated_position(tree: Any, flow: bool | None) -> None:
    text = yaml.safe_dump({"top": tree}, default_flow_style=flow, width=60)
    found = parse_yaml(text)
    assert found.data == {"top": tree}
    assert found.faults == []
    lines = text.splitlines()
    for path, (line, column) in found.positions.items():
        if path and isinstance(path[-1], str):
            assert lines[line - 1][column - 1 :].startswith((path[-1], "? "))


def test_a_key_twice_is_reported_at_its_second_position() -> None:
    [fault] = parse_yaml("a:\n  x: 1\n  y: 2\n  x: 3\n").faults
    assert (fault.key, fault.line, fault.column) == (("a", "x"), 4, 3)


def test_a_key_that_a_merge_brings_may_be_overridden() -> None:
    tree = parse_yaml("a: &a {x: 1, y: 2}\nb: {<<: *a, x: 5}\n")
    assert tree.faults == []
    assert tree.data["b"] == {"x": 5, "y": 2}


def test_what_an_alias_repeats_has_the_position_of_the_alias() -> None:
    positions = parse_yaml("a: &a [1, 2]\nb: *a\n").positions
    assert positions[("b",)] == (2, 1)
    assert ("b", 0) not in positions


def levels(line: str) -> str:
    """Ten levels of ten references each."""
    lines = ["a0: &a0 {k: 1}"]
    lines += [f"a{i}: &a{i} {line.format(', '.join([f'*a{i - 1}'] * 10))}" for i in range(1, 10)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    "text",
    [
        levels("[{}]"),
        levels("{{<<: [{}]}}"),
        "a: [" + "1, " * 50_000 + "]",
        "[" * 100,
        "- " * 100,
    ],
)
def test_a_text_that_would_expand_too_far_is_refused_first(text: str) -> None:
    with pytest.raises(YamlSyntaxError, match=r"too much to read: (more than|nested too deeply)"):
        parse_yaml(text)


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        (levels("[{}]"), "without such aliases"),
        ("a: [" + "1, " * 50_000 + "]", "simplify meshes or replace them by convex hulls"),
        ("[" * 100, "flatter"),
    ],
)
def test_the_advice_about_a_long_text_is_the_one_that_helps(text: str, hint: str) -> None:
    with pytest.raises(YamlSyntaxError) as refused:
        parse_yaml(text)
    assert hint in refused.value.next_step
    assert ("aliases" in f"{refused.value.what} {refused.value.next_step}") == ("*a" in text)


def test_a_text_that_contains_itself_is_read_in_finite_time() -> None:
    data = parse_yaml("a: &a [*a]").data
    assert data["a"][0] is data["a"]


@pytest.mark.parametrize(
    "text",
    [
        "!!python/object/apply:os.system [ls]",
        "!!int x",
        "!!timestamp x",
        "!mine {}",
        "{!!int x: 1}",
        "{? [!!int x] : 1}",
    ],
)
def test_a_tag_constructs_nothing(text: str) -> None:
    tree = parse_yaml(f"a: {text}")
    assert tree.data is None
    assert "is not allowed" in tree.faults[0].what or "is not text" in tree.faults[0].what


@given(st.text(st.sampled_from("ab:-[]{},&*!?#'\"|> \n\t%@`1.~<\x00\u2028é"), max_size=25))
def test_any_text_is_read_or_refused_with_a_position(text: str) -> None:
    found = None
    try:
        parse_yaml(text)
    except YamlSyntaxError as error:
        found = error
    assert found is None or (found.line >= 0 and found.what.startswith("not valid"))
