"""The report of a run: one page with verdict, scene, charts and tables."""

from __future__ import annotations

from pathlib import Path

from executor.recording.run_folder import RunFolder
from model.files.documents import write_atomic


def build_report(folder: RunFolder) -> Path:
    """Creates ``report.html`` from the other files of a run folder.

    Args:
        folder: A run that ended (`RunFolder.open`).

    Returns:
        Path of the page.

    Raises:
        BadInput: A file of the run is missing or was changed, or the folder cannot be written to.
    """
    from executor.report.page import page
    from executor.report.run_data import read_run

    write_atomic(folder.report, page(read_run(folder)))
    return folder.report
