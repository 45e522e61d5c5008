"""The kinds of calibration results: reading their files, and putting them into a rig."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from calibration.camera_result import CameraResult
from calibration.extrinsics_result import ExtrinsicsResult
from calibration.result_file import ResultDocument, in_order
from calibration.rig_result import RigResult
from calibration.tags_result import TagsResult
from cdpr.documents import load_yaml, read_yaml
from cdpr.errors import BadInput
from cdpr.rig import Rig, rig_from_document

KINDS: dict[str, type[ResultDocument]] = {
    "camera": CameraResult,
    "tags": TagsResult,
    "extrinsics": ExtrinsicsResult,
    "rig": RigResult,
}


def load_result(path: Path) -> ResultDocument:
    """Reads a result file.

    Raises:
        BadInput: The file cannot be read, is no calibration result, or was edited.
        InvalidFile: With every problem and its place.
    """
    result = load_yaml(path, _kind_of(path))
    if result.hash != result.sealed().hash:
        raise BadInput(
            "the result's hash does not match its content",
            where=str(path),
            why="the file was edited or damaged, or written by a program with other defaults",
            next_step=f"run `cdpr calibrate {result.kind}` again; numbers of your own belong into"
            " the rig file",
        )
    return result


def _kind_of(path: Path) -> type[ResultDocument]:
    plain = read_yaml(path).data
    kind = plain.get("kind") if isinstance(plain, dict) else None
    if not isinstance(kind, str) or kind not in KINDS:
        raise BadInput(
            "this is no calibration result",
            where=str(path),
            why=f"its kind must be one of {', '.join(KINDS)}; it is {kind!r}",
            next_step="name a file calibration_*.yaml that `cdpr calibrate` has written",
        )
    return KINDS[kind]


def calibrated(rig: Rig, results: Sequence[ResultDocument]) -> Rig:
    """The rig with results in place of its file's numbers, whatever the order they are given in.

    Raises:
        BadInput: A result is not about this rig, or two are of the same thing.
    """
    seen: dict[tuple[str, str], str] = {}
    for result in results:
        what = (result.kind, result.name)
        if what in seen:
            raise BadInput(
                f"two results of kind {result.kind} for {result.name!r}:"
                f" {seen[what]} and {result.date}",
                where="--calibration",
                next_step="pass the one that holds",
            )
        seen[what] = result.date
    document = rig.document
    for result in in_order(results):
        document = result.corrected(document)
    return rig_from_document(document)
