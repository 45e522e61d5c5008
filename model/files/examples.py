"""The rigs, scenes and recorded sessions that come with the program: list and copies."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from model.errors import AlreadyExists, BadInput
from model.files.documents import write_bytes_atomic
from model.files.reading import read_bytes, read_text, shown, unreadable

_KIND = re.compile(r"\$schema=.*/(rig|scene)\.schema\.json")
_DESCRIPTION = re.compile(r"^description: *(.+)$", re.MULTILINE)
_ABOUT = "README.md"
PAPER_RIG = "gachon_8_6.yaml"
"""The rig file of the paper's robot, in the folder of the examples."""


@dataclass(frozen=True)
class Example:
    """One rig or scene file, or the folder of a recorded session.

    Attributes:
        name: Name on the command line.
        kind: ``rig``, ``scene`` or ``session``.
        about: One line of description.
        source: The file or folder.
        group: Its folder in a clone of the repository.
    """

    name: str
    kind: str
    about: str
    source: Path
    group: str

    @property
    def file_name(self) -> str:
        """Name of a copy."""
        return self.source.name


def ready_folder(name: str = "configs") -> Path:
    """The folder of the example rigs and scenes: in the package `cdpr`, or in the repository.

    Args:
        name: ``examples`` for the recorded sessions instead.
    """
    root = Path(__file__).resolve().parents[2]
    inside = root / "cdpr" / name
    return inside if inside.is_dir() else root / name


def find_examples(configs: Path, sessions: Path) -> list[Example]:
    """All examples: rigs, then scenes, then sessions, each by name.

    Args:
        configs: The folder of the example rigs and scenes.
        sessions: The folder of the recorded sessions.
    """
    files = [_ready_file(path) for path in configs.glob("*.yaml")]
    folders = [_session(path) for path in sessions.iterdir() if (path / _ABOUT).is_file()]
    order = ("rig", "scene", "session")
    return sorted([*files, *folders], key=lambda example: (order.index(example.kind), example.name))


def _ready_file(path: Path) -> Example:
    text = read_text(path)
    lines = text.splitlines()
    kind = _KIND.search(lines[0])
    if kind is None:
        raise BadInput(f"{path.name} names no schema in its first line", where=str(path))
    described = _DESCRIPTION.search(text)
    about = described.group(1) if described else lines[1].removeprefix("# ")
    return Example(path.stem, kind.group(1), about, path, "configs")


def _session(path: Path) -> Example:
    title = read_text(path / _ABOUT).splitlines()[0].removeprefix("# ")
    return Example(path.name, "session", title, path, "examples")


def select_examples(examples: Iterable[Example], names: Iterable[str]) -> list[Example]:
    """The examples with these names.

    Raises:
        BadInput: A name is unknown; the message lists the known ones.
    """
    by_name = {example.name: example for example in examples}
    wanted = [name.removesuffix(".yaml") for name in names]
    unknown = [name for name in wanted if name not in by_name]
    if unknown:
        raise BadInput(
            f"no example {unknown[0]!r}",
            where="cdpr examples",
            next_step=f"name one of these: {', '.join(by_name)}",
        )
    return [by_name[name] for name in dict.fromkeys(wanted)]


def copy_examples(
    examples: Iterable[Example], folder: Path, *, grouped: bool, replace: bool
) -> list[Path]:
    """Copies all examples, or none when a copy exists already.

    Args:
        examples: The examples.
        folder: Target; created with its parents.
        grouped: In ``configs`` and ``examples`` below the folder, as in a clone.
        replace: Replace files that exist.

    Returns:
        The copies.

    Raises:
        BadInput: A copy exists already, or a file cannot be written.
    """
    wanted = [(e, folder / (e.group if grouped else "") / e.file_name) for e in examples]
    existing = [target for _, target in wanted if os.path.lexists(target)]
    if existing and not replace:
        raise AlreadyExists(
            "the file exists already",
            shown(existing[0]),
            f"{len(existing)} of the {len(wanted)} copies exist; nothing was copied",
        )
    for example, target in wanted:
        _copy(example.source, target)
    return [target for _, target in wanted]


def _copy(source: Path, target: Path) -> None:
    files = [source] if source.is_file() else [path for path in source.rglob("*") if path.is_file()]
    for path in files:
        copy = target / path.relative_to(source)
        try:
            copy.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise unreadable(copy.parent, error) from None
        write_bytes_atomic(copy, read_bytes(path))
