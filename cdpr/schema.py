"""The JSON schemas of the files, as committed in docs/schema: ``python -m cdpr.schema``."""

from __future__ import annotations

import json
from pathlib import Path

from cdpr.document_types import Document
from cdpr.plan_file import PlanDocument
from cdpr.rig_file import RigDocument
from cdpr.scene_file import SceneDocument

FOLDER = Path("docs/schema")
DOCUMENTS: dict[str, type[Document]] = {
    "rig": RigDocument,
    "scene": SceneDocument,
    "plan": PlanDocument,
}


def schema_text(name: str) -> str:
    """The JSON schema of a kind of file, as text."""
    schema = DOCUMENTS[name].model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    return json.dumps(schema, indent=2, sort_keys=True) + "\n"


def write_schemas(folder: Path) -> None:
    """Writes all schemas into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in DOCUMENTS:
        (folder / f"{name}.schema.json").write_text(schema_text(name), encoding="utf-8")


if __name__ == "__main__":
    write_schemas(FOLDER)
