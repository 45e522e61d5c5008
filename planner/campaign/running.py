"""Doing all searches of a campaign, in this process or wherever a pool does them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, as_completed

from planner.campaign.trial import Batch, Trial, run_batch

Progress = Callable[[int], None]
"""Called with the number of searches newly done."""


def run_all(batches: Sequence[Batch], pool: Executor | None, progress: Progress) -> list[Trial]:
    """Does all batches; the trials are in the order of the batches whoever did them.

    Args:
        batches: What to do.
        pool: Does it, in other processes or on other machines; this process without one.
        progress: Told how many searches are newly done.
    """
    if pool is None:
        trials = []
        for batch in batches:
            trials += run_batch(batch)
            progress(len(batch.seeds))
        return trials
    done: dict[int, list[Trial]] = {}
    tasks = {pool.submit(run_batch, batch): k for k, batch in enumerate(batches)}
    try:
        for task in as_completed(tasks):
            done[tasks[task]] = task.result()
            progress(len(batches[tasks[task]].seeds))
    finally:
        for task in tasks:
            task.cancel()
    return [trial for k in range(len(batches)) for trial in done[k]]
