"""What holds for every test: the same examples every time, and nothing left running behind it."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import threading
import zlib
from collections.abc import Generator, Iterator
from functools import partial
from multiprocessing import resource_tracker
from pathlib import Path

# Before NumPy is loaded: the suite runs on several workers, one thread each.
for variable in (
    "OPENBLAS_NUM_THREADS",
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
):
    os.environ.setdefault(variable, "1")
os.environ.setdefault("MPLBACKEND", "Agg")
# As in a terminal: under `nohup` or in the background programs would be deaf to these.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
signal.signal(signal.SIGINT, signal.default_int_handler)

import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

from tests.held_up import LATE, LIMIT_S, REPEATS, HoldUp, reports_late_cycles  # noqa: E402

ROOT = Path(__file__).parents[1]
GRACE_S = 2.0  # for a thread that was told to end and is just returning
HELD_UP = pytest.StashKey[HoldUp]()

settings.register_profile("ci", derandomize=True, deadline=None, max_examples=40, print_blob=True)
settings.register_profile("explore", deadline=None, max_examples=1000, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


def _threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.is_alive()}


def _children() -> set[int]:
    """Ids of this process's children, finished but not waited for included."""
    multiprocessing.active_children()  # reaps multiprocessing's own that have ended
    found: set[int] = set()
    for listing in Path("/proc/self/task").glob("*/children"):
        try:
            found.update(int(child) for child in listing.read_text().split())
        except OSError:  # the thread ended while we looked
            continue
    # Python keeps one tracker process for shared memory, to the end of the interpreter.
    tracker = getattr(resource_tracker._resource_tracker, "_pid", None)
    return found - {tracker}


def _command(child: int) -> str:
    try:
        words = Path(f"/proc/{child}/cmdline").read_text().split("\0")
    except OSError:
        return "ended meanwhile"
    return " ".join(words).strip() or "just started, or ended and not waited for"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Tests of root run for root alone; those that need more than a computer when asked.

    Of the latter `make hil` asks for those on a kernel CAN bus, `make test-quiet` for those in real
    time at 100 Hz, which a computer that does something else at once holds up. Files come in an
    order drawn once and for all, so that those that wait in real time lie between those that
    compute, and not last, where others would wait for them.
    """
    waiting = {item.path for item in items if _in_real_time(item)}
    items.sort(key=lambda item: _drawn(item.path) * (0.85 if item.path in waiting else 1.0))
    for item in items:
        if _in_real_time(item):
            again = partial(_was_held_up, item)
            item.add_marker(pytest.mark.flaky(reruns=REPEATS, condition=again))
    if os.geteuid() != 0:
        for item in items:
            if item.get_closest_marker("root"):
                item.add_marker(pytest.mark.skip(reason="only root may act for two users"))
    unasked = [name for name in ("hil", "quiet") if name not in config.option.markexpr]
    needing = [i for i in items if any(i.get_closest_marker(name) for name in unasked)]
    if needing:
        config.hook.pytest_deselected(items=needing)
        items[:] = [item for item in items if item not in needing]


def pytest_collection_finish() -> None:
    """Spares each later garbage collection what lives to the end anyway: modules and tests."""
    gc.collect()
    gc.freeze()


def _drawn(path: Path) -> int:
    """A number that is the same on every machine."""
    return zlib.crc32(str(path.relative_to(ROOT)).encode())


def _in_real_time(item: pytest.Item) -> bool:
    return any(item.get_closest_marker(name) for name in ("real_time", "browser"))


def _was_held_up(item: pytest.Item) -> bool:
    return item.stash[HELD_UP].worst_s > LIMIT_S or item.stash.get(LATE, False)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if call.excinfo is not None:
        item.stash[LATE] = reports_late_cycles(str(call.excinfo.value))
    return report


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """A test in real time is repeated where this computer held it up, its fixtures included."""
    if _in_real_time(item):
        item.stash[HELD_UP] = HoldUp()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Generator[None]:
    try:
        yield
    finally:
        if _in_real_time(item):
            item.stash[HELD_UP].end()


@pytest.fixture(autouse=True)
def nothing_left_running() -> Iterator[None]:
    """Fails a test that leaves a thread or a child process behind."""
    threads, children = _threads(), _children()
    yield
    for thread in _threads() - threads:
        thread.join(GRACE_S)
    left = [f"thread {thread.name!r}" for thread in _threads() - threads]
    left += [f"process {child} ({_command(child)})" for child in _children() - children]
    if left:
        pytest.fail(f"the test left running: {', '.join(sorted(left))}", pytrace=False)
