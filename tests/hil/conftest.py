"""A kernel CAN bus, a trace of all that goes over it, and programs in processes of their own."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import can
import pytest

from cdpr.cli import main
from drivers.can_bus import BusSettings, open_bus
from drivers.cia402.pdo import SYNC_ID
from drivers.cia402.sdo import SetupNetwork
from drivers.cia402.state_machine import DriveState, state_of
from executor.kernels import ready_to_simulate
from tests.cli.plans import RIG, write_short_plan

NODES = range(1, 9)

# What the programs import inside their functions: once here, before they are forked, since an
# import takes long where instructions are counted.
for module in (
    "cdpr.cli.operate.run",
    "cdpr.cli.sim",
    "cv2",
    "drivers.cia402.group",
    "executor.report.page",
    "executor.runner",
    "executor.trajectory.setpoints",
    "mcap.writer",
    "scipy.optimize",
    "simulation.drives.cia402_rig",
):
    import_module(module)
ready_to_simulate()
AHEAD_OF_ALL = 80
TRACE_BUFFER_BYTES = 2**27  # candump waits behind the programs that it listens to


@pytest.fixture(scope="session")
def channel() -> str:
    """The interface that tools/hil made."""
    name = os.environ.get("CDPR_HIL_CHANNEL")
    if not name:
        pytest.fail("no kernel CAN bus; next: run these tests with `make hil`", pytrace=False)
    return name


@pytest.fixture(scope="session")
def artefacts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where traces are kept."""
    folder = os.environ.get("CDPR_HIL_ARTEFACTS")
    return Path(folder) if folder else tmp_path_factory.mktemp("artefacts")


@pytest.fixture(scope="session")
def short_plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """58 mm, about 3 s."""
    return write_short_plan(tmp_path_factory.mktemp("plan") / "plan.json")


@pytest.fixture(autouse=True)
def own_announcements(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)


@pytest.fixture
def trace(
    request: pytest.FixtureRequest, channel: str, artefacts: Path, tmp_path: Path
) -> Iterator[Path]:
    """What candump hears while the test runs; kept afterwards.

    It is not written where it is kept: a virtual machine loses time waiting for a file of the host.
    """
    path = tmp_path / "trace.log"
    with (
        path.open("w") as file,
        subprocess.Popen(
            ["candump", "-L", "-r", str(TRACE_BUFFER_BYTES), channel], stdout=file
        ) as candump,
    ):
        try:
            yield path
        finally:
            candump.terminate()
            candump.wait()
            shutil.copyfile(path, artefacts / f"{request.node.name}.log")


@pytest.fixture
def figures(request: pytest.FixtureRequest, artefacts: Path) -> Callable[[str], None]:
    """Writes down what was measured."""

    def tell(text: str) -> None:
        with (artefacts / "figures.txt").open("a") as file:
            file.write(f"{request.node.name}: {text}\n")

    return tell


class Program:
    """`cdpr ARGUMENTS` in a process group of its own, as from another terminal."""

    def __init__(self, said: Path, arguments: Sequence[str | Path]) -> None:
        self.said = said
        said.touch()
        words = ["cdpr", *map(str, arguments)]
        # Forked: to import everything once more takes a minute where instructions are counted.
        self._process = multiprocessing.get_context("fork").Process(target=_run, args=(words, said))
        self._process.start()

    def send(self, number: signal.Signals) -> None:
        """A signal to the whole group."""
        assert self._process.pid is not None
        os.killpg(self._process.pid, number)

    def ended(self) -> int:
        """Its exit code, once it has ended."""
        self._process.join()
        assert self._process.exitcode is not None
        return self._process.exitcode

    def put_ahead(self) -> None:
        """Lets it run before everything else: drives are computers of their own.

        With one processor for all, the kernel's work on a master that was killed would hold them
        up. Where this is not allowed there are more processors.
        """
        assert self._process.pid is not None
        with suppress(PermissionError):
            priority = os.sched_param(AHEAD_OF_ALL)
            os.sched_setscheduler(self._process.pid, os.SCHED_FIFO, priority)

    @property
    def is_running(self) -> bool:
        return self._process.is_alive()

    def close(self) -> None:
        if self.is_running:
            self.send(signal.SIGKILL)
        self._process.join()
        self._process.close()


def next_message(ear: can.BusABC, sender: Program) -> can.Message:
    """What is heard next, however long it takes, unless the sender has ended.

    No duration could be right: the clock of a virtual machine that waits for a file of the host
    jumps to whatever would time out next.
    """
    while (message := ear.recv(1.0)) is None:
        assert sender.is_running, sender.said.read_text()
    return message


def _run(words: list[str], said: Path) -> None:
    os.setpgid(0, 0)
    descriptor = os.open(said, os.O_WRONLY | os.O_APPEND)
    for stream in (1, 2):
        os.dup2(descriptor, stream)
    sys.argv = words
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
    main()


@dataclass(frozen=True, slots=True)
class Rig:
    """Simulated drives in one process, and what a test does to them from another.

    Attributes:
        channel: The interface.
        plan: A plan from where the platform hangs.
        folder: For run folders.
        drives: `cdpr sim`.
        ear: A listener on the bus.
        started: Every run that was started.
    """

    channel: str
    plan: Path
    folder: Path
    drives: Program
    ear: can.BusABC
    started: list[Program]

    def run(self, name: str = "run") -> Program:
        """Starts `cdpr run`."""
        words = (
            *("run", self.plan, "--rig", RIG, "-o", self.folder / name, "--no-camera"),
            *("--interface", "socketcan", "--channel", self.channel, "--yes", "--json"),
        )
        self.started.append(Program(self.folder / f"{name}.txt", words))
        return self.started[-1]

    def summary(self, name: str = "run") -> dict[str, Any]:
        """What a run left behind."""
        found: dict[str, Any] = json.loads((self.folder / name / "summary.json").read_text())
        return found

    def wait_for_cycles(self, count: int, running: Program) -> None:
        """Until the master has sent so many SYNCs from now."""
        while self.ear.recv(0.0) is not None:
            pass
        while count:
            count -= next_message(self.ear, running).arbitration_id == SYNC_ID

    def wait_for_motion(self, running: Program) -> None:
        """Until the run has told that it moves along the path."""
        events = self.folder / "run" / "events.jsonl"
        while not (events.is_file() and '"moving"' in events.read_text()):
            assert running.is_running, running.said.read_text()
            self.wait_for_cycles(5, running)
        self.drives.put_ahead()

    def read(self, index: int) -> list[int]:
        """An object of every drive, as any CANopen tool reads it."""
        with open_bus(BusSettings("socketcan", self.channel)) as bus:
            network = SetupNetwork(bus, None, NODES)
            data = [network.client(node).read(index, 0, "object") for node in NODES]
        return [int.from_bytes(value, "little", signed=True) for value in data]

    def states(self) -> set[DriveState]:
        return {state_of(word & 0xFFFF) for word in self.read(0x6041)}

    def positions(self) -> list[int]:
        return self.read(0x6064)


@contextmanager
def _drives(channel: str, plan: Path, folder: Path) -> Iterator[Rig]:
    bus = ("--interface", "socketcan", "--channel", channel)
    drives = Program(folder / "drives.txt", ("sim", RIG, *bus, "--plan", plan))
    started: list[Program] = []
    with stopped_programs([drives]), stopped_programs(started):
        with open_bus(BusSettings("socketcan", channel)) as ear:
            next_message(ear, drives)  # the boot-up message of the first drive
            yield Rig(channel, plan, folder, drives, ear, started)
        assert drives.is_running, drives.said.read_text()
        drives.send(signal.SIGINT)
        assert drives.ended() == 0, drives.said.read_text()


@contextmanager
def stopped_programs(started: list[Program]) -> Iterator[None]:
    """Whatever is in the list ends with the block."""
    try:
        yield
    finally:
        for program in started:
            program.close()


@pytest.fixture
def drives_at(channel: str, trace: Path, tmp_path: Path) -> Callable[[Path], Any]:
    """Starts the drives of the rig where a plan begins; the trace runs already."""
    return lambda plan: _drives(channel, plan, tmp_path)
