"""The committed JSON schemas say what the program accepts."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

import pytest
import yaml

from model.errors import InvalidFile
from model.files.documents import document_of
from model.files.drive_profile_file import NEEDED
from tests.cli.program import call
from tools.schemas import DOCUMENTS, schema_text, write_schemas

SCHEMAS = Path(__file__).parents[2] / "docs" / "schema"
CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.mark.parametrize("name", DOCUMENTS)
def test_a_committed_schema_is_current(name: str) -> None:
    """After a change to a file's model: `make schema`, and commit what it writes."""
    committed = (SCHEMAS / f"{name}.schema.json").read_text(encoding="utf-8")
    assert committed == schema_text(DOCUMENTS[name])


def test_the_command_writes_all_schemas_and_nothing_else(tmp_path: Path) -> None:
    write_schemas(tmp_path / "schema")
    written = {path.name for path in (tmp_path / "schema").iterdir()}
    assert written == {path.name for path in SCHEMAS.iterdir()}


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.name)
def test_a_ready_file_names_its_schema_for_editors(path: Path) -> None:
    """The comment is relative to the file; one that leads nowhere would be silent in an editor."""
    assert (path.parent / named_by(path)).resolve() in {
        each.resolve() for each in SCHEMAS.iterdir()
    }


def test_a_copied_and_a_new_file_name_the_installed_schema(tmp_path: Path) -> None:
    """A relative path would lead nowhere from wherever they are."""
    assert call("examples", "turn", "hall_10_6", "-o", tmp_path).code == 0
    assert call("new", tmp_path / "mine.yaml", answers="\n" * 50).code == 0
    named = {path.stem: urlsplit(named_by(path)) for path in tmp_path.iterdir()}
    assert {each.scheme for each in named.values()} == {"file"}
    assert {name: Path(url2pathname(each.path)) for name, each in named.items()} == {
        "turn": SCHEMAS / "scene.schema.json",
        "hall_10_6": SCHEMAS / "rig.schema.json",
        "mine": SCHEMAS / "rig.schema.json",
    }


def named_by(path: Path) -> str:
    """The schema that the first line of a file names."""
    key, _, target = path.read_text(encoding="utf-8").splitlines()[0].partition("$schema=")
    assert key == "# yaml-language-server: "
    return target


def test_the_schema_of_profiles_knows_the_names_of_objects_and_codes() -> None:
    """An editor that accepts what the program refuses misleads whoever writes a profile."""
    schema = DOCUMENTS["drive-profile"].model_json_schema()
    keys, parts = schema["properties"], schema["$defs"]
    known = keys["ranges"]["propertyNames"]["enum"]
    missing = keys["absent"]["items"]["enum"]
    assert set(known) - set(missing) == set(NEEDED)
    assert {"6066h:00", "6072h:00"} <= set(missing)
    for pattern, right, wrong in (
        (keys["warnings"]["items"]["pattern"], "33xxh", ("3180", "33XXh", "33xxh:00")),
        (parts["Expected"]["properties"]["object"]["pattern"], "60A8h:00", ("60a8h:00", "60A8h")),
        (parts["TorqueLimit"]["properties"]["object"]["pattern"], "6073h:00", ("6073:00",)),
    ):
        assert re.search(pattern, right)
        assert not any(re.search(pattern, text) for text in wrong)


BALL = {"name": "ball", "sphere": {"radius_mm": 1.0}}
STOP = {"name": "tray", "position_mm": [0.0, 0.0, 400.0]}
PICK = {**STOP, "kind": "pick", "dwell_s": 2.0, "mass_kg": 1.2}


@pytest.mark.parametrize(
    ("obstacle", "is_right"),
    [
        (BALL, True),
        ({**BALL, "box": None}, True),
        ({"name": "nothing"}, False),
        ({"name": "nothing", "box": None}, False),
        ({**BALL, "box": {"size_mm": [1.0, 1.0, 1.0]}}, False),
        ({"name": "ball", "sphere": {"radius_mm": 1e6}}, True),
        ({"name": "ball", "sphere": {"radius_mm": 1.1e6}}, False),
        ({**BALL, "position_mm": [0.0, -1.1e6, 0.0]}, False),
    ],
)
def test_an_editor_and_the_program_agree_about_obstacles(
    obstacle: dict[str, Any], is_right: bool
) -> None:
    scene = ready("environment_3.yaml") | {"obstacles": [obstacle]}
    assert accepted("scene", scene) == (is_right, is_right)


@pytest.mark.parametrize(
    ("stop", "is_right"),
    [
        (STOP, True),
        ({**STOP, "mass_kg": None, "dwell_s": 1.0}, True),
        ({**STOP, "mass_kg": 1.2}, False),
        ({**STOP, "kind": "pass", "mass_centre_mm": [0.0, 0.0, 0.0]}, False),
        (PICK, True),
        ({**PICK, "mass_kg": None}, False),
        ({**PICK, "dwell_s": 0.0}, False),
        ({**STOP, "kind": "pick", "dwell_s": 2.0}, False),
        ({**STOP, "kind": "pick", "mass_kg": 1.2}, False),
    ],
)
def test_an_editor_and_the_program_agree_about_stops(stop: dict[str, Any], is_right: bool) -> None:
    scene = ready("environment_3.yaml") | {"stops": [stop]}
    assert accepted("scene", scene) == (is_right, is_right)


UNIT_6, UNIT_8 = ([[float(i == k) for i in range(n)] for k in range(n)] for n in (6, 8))


@pytest.mark.parametrize(
    ("change", "is_right"),
    [
        ({"distortion": [0.1, 0.2, 0.0, 0.0, 0.1]}, True),
        ({"distortion": [0.1, 0.2, 0.0]}, False),
        ({"lens": "fisheye", "distortion": [0.1, 0.2, 0.0, 0.0]}, True),
        ({"lens": "fisheye", "distortion": [0.1, 0.2, 0.0, 0.0, 0.1]}, False),
        ({"name": "front left"}, True),
        ({"name": "a/b"}, False),
        ({"name": ".front"}, False),
        ({"pose_covariance": UNIT_6}, True),
        ({"pose_covariance": [[1.0, 0.0], [0.0, 1.0]]}, False),
        ({"pose_covariance": [[], [], [], [], [], []]}, False),
        ({"distortion": [0.0, 0.0, 0.0, 0.0], "lens_covariance": UNIT_8}, True),
        ({"distortion": [0.0, 0.0, 0.0, 0.0], "lens_covariance": []}, False),
        ({"distortion": [0.0, 0.0, 0.0, 0.0], "pose_by_lens": [[0.0] * 8] * 6}, True),
        ({"distortion": [0.0, 0.0, 0.0, 0.0], "pose_by_lens": [[0.0] * 8] * 5}, False),
        ({"fx_px": 1.1e12}, False),
        ({"fx_px": 1e-13}, False),
        ({"cx_px": -1.1e12}, False),
        ({"error_mm": 1.1e12}, False),
    ],
)
def test_an_editor_and_the_program_agree_about_cameras(
    change: dict[str, Any], is_right: bool
) -> None:
    rig = ready("gachon_8_6.yaml")
    rig["cameras"] = [rig["cameras"][0] | change]
    assert accepted("rig", rig) == (is_right, is_right)


@pytest.mark.parametrize(("cables", "is_right"), [(6, True), (5, False)])
def test_an_editor_and_the_program_agree_about_the_fewest_cables(
    cables: int, is_right: bool
) -> None:
    rig = ready("gachon_8_6.yaml")
    rig |= {key: rig[key][:cables] for key in ("outlets_mm", "anchors_mm", "winches")}
    assert accepted("rig", rig) == (is_right, is_right)


def test_an_editor_refuses_the_modulus_of_a_cable_for_its_stiffness() -> None:
    rig = ready("gachon_8_6.yaml")
    assert accepted("rig", rig) == (True, True)
    rig["cables"]["stiffness_n"] = 1.2e11
    assert accepted("rig", rig) == (False, False)


def ready(name: str) -> dict[str, Any]:
    """The content of a supplied file."""
    found = yaml.safe_load((CONFIGS / name).read_text(encoding="utf-8"))
    assert isinstance(found, dict)
    return found


def accepted(kind: str, document: Mapping[str, Any]) -> tuple[bool, bool]:
    """Whether an editor with the schema accepts a document, and whether the program does."""
    schema = DOCUMENTS[kind].model_json_schema()
    try:
        document_of(copy.deepcopy(document), DOCUMENTS[kind], kind)
    except InvalidFile:
        return fits(document, schema, schema["$defs"]), False
    return fits(document, schema, schema["$defs"]), True


TYPES: dict[str, type | tuple[type, ...]] = {
    "array": list,
    "boolean": bool,
    "integer": int,
    "null": type(None),
    "number": (int, float),
    "object": dict,
    "string": str,
}


def fits(value: Any, schema: Mapping[str, Any], parts: Mapping[str, Any]) -> bool:
    """Whether a value fits a JSON schema, by the keywords that these schemas use."""

    def by(other: Mapping[str, Any]) -> bool:
        return fits(value, other, parts)

    if "$ref" in schema and not by(parts[schema["$ref"].removeprefix("#/$defs/")]):
        return False
    if "if" in schema and not by(schema.get("then" if by(schema["if"]) else "else", {})):
        return False
    if "anyOf" in schema and not any(map(by, schema["anyOf"])):
        return False
    if "oneOf" in schema and sum(map(by, schema["oneOf"])) != 1:
        return False
    if "type" in schema and not isinstance(value, TYPES[schema["type"]]):
        return False
    if value not in schema.get("enum", [schema.get("const", value)]):
        return False
    match value:
        case dict():
            known = schema.get("properties", {})
            return (
                set(schema.get("required", ())) <= set(value)
                and (schema.get("additionalProperties", True) or set(value) <= set(known))
                and all(fits(value[key], known[key], parts) for key in known if key in value)
            )
        case list():
            fewest, most = schema.get("minItems", 0), schema.get("maxItems", len(value))
            items = schema.get("items", {})
            return fewest <= len(value) <= most and all(fits(each, items, parts) for each in value)
        case str():
            return re.search(schema.get("pattern", ""), value) is not None
        case int() | float():
            low, high = schema.get("minimum", value), schema.get("maximum", value)
            return bool(low <= value <= high and value > schema.get("exclusiveMinimum", -1e300))
    return True
