"""JSON schemas of rig, scene, plan and drive profile files, for editors and other programs.

``python tools/schemas.py`` writes them into ``docs/schema/`` of the repository (``make schema``).
"""

from __future__ import annotations

import json
from pathlib import Path

from model.files.documents import Document
from model.files.drive_profile_file import ProfileDocument
from model.files.plan_file import PlanDocument
from model.files.rig_file import RigDocument
from model.files.scene_file import SceneDocument

DIALECT = "https://json-schema.org/draft/2020-12/schema"
DOCUMENTS: dict[str, type[Document]] = {
    "rig": RigDocument,
    "scene": SceneDocument,
    "plan": PlanDocument,
    "drive-profile": ProfileDocument,
}


def schema_text(document: type[Document]) -> str:
    """The JSON schema of a file, as committed."""
    schema = {"$schema": DIALECT, **document.model_json_schema()}
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


def write_schemas(folder: Path) -> None:
    """Writes one schema per kind of file, such as ``rig.schema.json``, into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, document in DOCUMENTS.items():
        (folder / f"{name}.schema.json").write_text(schema_text(document), encoding="utf-8")


if __name__ == "__main__":
    write_schemas(Path(__file__).resolve().parents[1] / "docs" / "schema")
