"""`tools/fuzz` calls the verbs with values that they accept."""

from __future__ import annotations

import random
import sys
from collections import defaultdict
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import pytest

from cdpr.cli.arguments import OUTPUTS

ROOT = Path(__file__).parents[2]
SEEDS = 20


@pytest.fixture
def fuzzer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Any]:
    """A fuzzer of the verbs with one valid file of every kind."""
    monkeypatch.syspath_prepend(str(ROOT / "tools" / "fuzz"))
    monkeypatch.chdir(tmp_path)
    import verbs

    monkeypatch.setattr(verbs, "PRELOADED", ())
    valid, scratch = tmp_path / "corpus" / "valid", tmp_path / "scratch"
    valid.parent.mkdir()
    valid.touch()
    scratch.mkdir()
    monkeypatch.chdir(scratch)
    yield verbs.VerbFuzzer(defaultdict(lambda: [valid]), scratch)
    sys.modules.pop("verbs")


def usual(fuzzer: Any, wanted: Any) -> Iterator[tuple[str, Any, set[str]]]:
    """Each parameter of a wanted kind: its name, its kind, and its usual values."""
    for words, command in fuzzer._verbs.items():
        for param in command.params:
            if not hasattr(param, "type_descriptor"):
                continue
            kind = param.type_descriptor.annotation
            kind = get_args(kind)[0] if get_origin(kind) is list else kind
            if wanted(kind):
                chances = map(random.Random, range(SEEDS))
                values = {value for chance in chances for value in fuzzer._usual(param, chance)}
                yield f"{' '.join(words)}: {param.name}", kind, values


def test_a_choice_gets_one_of_its_values(fuzzer: Any) -> None:
    def is_choice(kind: Any) -> bool:
        return get_origin(kind) is Literal or (isinstance(kind, type) and issubclass(kind, Enum))

    found = list(usual(fuzzer, is_choice))
    assert found
    for name, kind, values in found:
        assert len(values) > 1, name
        assert values <= {getattr(one, "value", one) for one in get_args(kind) or kind}, name


def test_a_path_to_read_exists(fuzzer: Any) -> None:
    found = list(usual(fuzzer, lambda kind: kind is Path))
    assert found
    for name, _, values in found:
        is_output = name.split(": ")[1] in (*OUTPUTS, "foxglove_layout")
        assert all(is_output or Path(value).exists() for value in values), name
        assert all(value.startswith("out/") for value in values if is_output), name
