"""``SHA256SUMS``: checksums of a run's files, as ``sha256sum -c SHA256SUMS`` reads them.

Written when a run ends, and compared whenever its folder is opened: a file that was edited, damaged
or mixed up with that of another run is named. It proves nothing against one who also rewrites the
checksums. Images and the report are left out; a killed run has none. A file that is missing counts
as changed, unless `cdpr report` makes it again (`REBUILT`). Lines of other files are ignored.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from pathlib import Path

from executor.recording.record_files import AGAIN
from model.errors import BadInput
from model.files.documents import write_atomic
from model.files.reading import MEGABYTE, read_text, unreadable

CHECKSUMS = "SHA256SUMS"
_LINE = re.compile(r"([0-9a-f]{64}) [ *](.+)")
#: Files that are compared; cameras have names of their own.
_RECORD = re.compile(
    r"(plan|rig|run|summary)\.json|events\.jsonl|run\.mcap"
    r"|(cycles|clearance|fused|poses|poses-.+)\.csv"
)
#: Files among them that `cdpr report` makes again.
REBUILT = frozenset({"summary.json", "clearance.csv", "fused.csv", "run.mcap"})


def write_checksums(folder: Path, names: Iterable[str]) -> None:
    """Writes the checksums of the files of these names that exist.

    Raises:
        BadInput: A file cannot be read, or the folder cannot be written to.
    """
    found = sorted(name for name in names if (folder / name).is_file())
    lines = [f"{_checksum(folder / name)}  {name}\n" for name in found]
    write_atomic(folder / CHECKSUMS, "".join(lines))


def require_unchanged_files(folder: Path) -> None:
    """Requires the files of a run to be as they were written; any of `REBUILT` may be missing.

    Raises:
        BadInput: One was changed or is missing, or the checksums cannot be read; all are named.
    """
    path = folder / CHECKSUMS
    if not path.is_file():
        return
    changed = []
    for number, line in enumerate(read_text(path, MEGABYTE).splitlines(), start=1):
        found = _LINE.fullmatch(line)
        if found is None:
            raise BadInput("not a checksum", where=f"{path}:{number}", next_step=AGAIN)
        name = found[2].removeprefix("./")
        if not _RECORD.fullmatch(name):
            continue
        if not (folder / name).is_file():
            changed += [f"{name} (missing)"] if name not in REBUILT else []
        elif _checksum(folder / name) != found[1]:
            changed.append(name)
    if changed:
        raise BadInput(
            f"changed after the run: {', '.join(changed)}",
            where=str(folder),
            why=f"edited, damaged, removed, or of another run, according to {CHECKSUMS}",
            next_step=f"{AGAIN}; to use it as it is, remove {CHECKSUMS}",
        )


def _checksum(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise unreadable(path, error) from None
