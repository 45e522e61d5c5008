"""The kinds of calibration results: reading their files, and putting them into a rig."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import yaml

from calibration.extrinsics.result import ExtrinsicsResult
from calibration.geometry.result import RigResult
from calibration.intrinsics.readout import ReadoutResult
from calibration.intrinsics.result import CameraResult
from calibration.results import ResultDocument, in_order
from calibration.tag_map.result import TagsResult
from model.errors import BadInput
from model.files.documents import load_yaml, read_yaml, write_atomic
from model.progress import SILENT, Listener
from model.rig import Rig

KINDS: dict[str, type[ResultDocument]] = {
    "camera": CameraResult,
    "readout": ReadoutResult,
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
            why="the file was edited, damaged, or written by a version with other defaults",
            next_step=f"run `cdpr calibrate {result.kind}` again; put your own values into"
            " the rig file",
        )
    return result


def _kind_of(path: Path) -> type[ResultDocument]:
    plain = read_yaml(path).data
    kind = plain.get("kind") if isinstance(plain, dict) else None
    if not isinstance(kind, str) or kind not in KINDS:
        raise BadInput(
            "not a calibration result",
            where=str(path),
            why=f"its kind must be one of {', '.join(KINDS)}; it is {kind!r}",
            next_step="pass a file calibration_*.yaml written by `cdpr calibrate`",
        )
    return KINDS[kind]


def with_calibrations(rig: Rig, files: Sequence[Path], listener: Listener = SILENT) -> Rig:
    """The rig with the results of files in place of its file's numbers, in memory only.

    The verdict of each result that is not good enough is reported: it may be used all the same.

    Raises:
        BadInput: A file cannot be used, or is not about this rig.
    """
    if not files:
        return rig
    results = [load_result(file) for file in files]
    better = rig.with_calibration(*results)
    for result in results:
        if not result.good_enough:
            listener.remark(
                f"calibration {result.kind} {result.name}, {result.date}: {result.verdict}"
            )
    return better


def write_calibrated_rig(path: Path, rig: Rig, results: Sequence[ResultDocument]) -> Rig:
    """Writes a new rig file with results in place of a rig's numbers; returns what it describes.

    Comments of the rig's own file are not copied; a comment at its top names the results.

    Args:
        path: The file to write; one that exists is never replaced.
        rig: As its file describes it.
        results: In any order.

    Raises:
        BadInput: The file exists or cannot be written, or a result is not about this rig.
    """
    if path.exists():
        raise BadInput(
            "the file exists already",
            where=str(path),
            why="a calibration never replaces a rig file",
            next_step="choose a new name",
        )
    better = rig.with_calibration(*results)
    used = [f"{one.kind} {one.name} of {one.date}" for one in in_order(results)]
    plain = better.document.model_dump(mode="json", exclude_unset=True)
    body = yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, default_flow_style=None)
    head = f"# {rig.name} with calibration {', '.join(used)}; written by `cdpr calibrate apply`"
    write_atomic(path, f"{head}\n{body}")
    return better
