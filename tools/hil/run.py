"""Runs the tests marked `hil` on a virtual CAN bus of this or of a virtual machine.

    python tools/hil/run.py [--part all|runs|table|epos4|nanotec-c5e|akd] [--artefacts DIR]
        [--limit-s S] [pytest's arguments]
    python tools/hil/run.py --missing

The exit status is pytest's, or 125 without a bus. With --missing it only prints the Debian packages
to install first, in one line; this needs no virtual environment. Parts may run at the same time:
each in its own virtual machine, or one after the other on this machine's bus.
"""

from __future__ import annotations

import argparse
import fcntl
import os
import shlex
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from kernel import BUSYBOX, VmFailed, boot_files
from vm import QEMU, run_in_vm

ROOT = Path(__file__).resolve().parents[2]
CHANNEL = "vcan0"
NO_BUS = 125
PYTEST = ("-m", "pytest", "-p", "no:cacheprovider")
TABLE = "tests/hil/test_fault_table_on_vcan.py"
MAKERS = "tests/hil/test_makers_on_vcan.py"
MAKES = ("epos4", "nanotec-c5e", "akd")
PARTS = {
    "all": ("tests/hil",),
    "runs": ("tests/hil", f"--ignore={TABLE}", f"--ignore={MAKERS}"),
    "table": (TABLE,),
    **{make: (MAKERS, "-k", make) for make in MAKES},
}
"""Arguments of each part."""
NEEDED = {"ip": "iproute2", "candump": "can-utils"}
NEEDED_BY_VM = {QEMU: "qemu-system-x86", str(BUSYBOX): "busybox-static"}
KERNELS = "from executor.kernels import ready_to_simulate; ready_to_simulate()"
PLAN = "configs/gachon_8_6.yaml configs/environment_1.yaml --rounds 1 --force --json -o"
COMPILED = (
    "calibration",
    "cdpr",
    "drivers",
    "executor",
    "model",
    "planner",
    "simulation",
    "tests",
    "tracking",
)


def main() -> int:
    """Selects a bus, and runs the tests on it."""
    parser = argparse.ArgumentParser(description="run the hardware-in-the-loop tests on vcan")
    parser.add_argument("--part", choices=list(PARTS), default="all")
    parser.add_argument("--artefacts", type=Path)
    parser.add_argument("--limit-s", type=float, default=1800.0)
    parser.add_argument("--missing", action="store_true")
    options, rest = parser.parse_known_args()
    if options.missing:
        print(*_missing())
        return 0
    own = _cache() / "last" / options.part
    artefacts = (options.artefacts or own).resolve()
    if artefacts.is_relative_to(ROOT):
        parser.error(f"--artefacts {artefacts} is inside the repository; name another folder")
    if artefacts == own.resolve():
        shutil.rmtree(artefacts, ignore_errors=True)
    elif artefacts.exists() and any(artefacts.iterdir()):
        parser.error(f"--artefacts {artefacts} is not empty; name an empty folder")
    artefacts.mkdir(parents=True, exist_ok=True)
    tests = [*PYTEST, *PARTS[options.part], *(rest or ["-m", "hil"])]
    try:
        _require_tools()
        if _host_has_can():
            print(f"hil: on this machine's {CHANNEL}; traces in {artefacts}", flush=True)
            with _exclusive():
                return _on_host(tests, artefacts)
        print(f"hil: no AF_CAN here, so in a virtual machine; traces in {artefacts}", flush=True)
        with _exclusive():
            _compile(plans=options.part in MAKES)
            boot_files(_cache())
        return run_in_vm(_job(tests), artefacts, _cache(), options.limit_s)
    except VmFailed as error:
        print(f"hil: {error}", file=sys.stderr)
        return NO_BUS


def _cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "cdpr" / "hil"


@contextmanager
def _exclusive() -> Iterator[None]:
    """Excludes other parts, which wait for the bus or for shared files."""
    _cache().mkdir(parents=True, exist_ok=True)
    with (_cache() / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _require_tools() -> None:
    missing = _missing()
    if missing:
        raise VmFailed(f"tools are missing; next: sudo apt-get install {' '.join(missing)}")


def _missing() -> list[str]:
    """Packages of missing tools."""
    path = os.pathsep.join((os.environ.get("PATH", ""), "/usr/sbin", "/sbin"))
    needed = NEEDED if _host_has_can() else NEEDED | NEEDED_BY_VM
    return [package for tool, package in needed.items() if not shutil.which(tool, path=path)]


def _host_has_can() -> bool:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True


def _on_host(tests: list[str], artefacts: Path) -> int:
    """Runs on an interface of this machine; creating a missing one requires root."""
    if not Path("/sys/class/net", CHANNEL).exists():
        made = subprocess.run(
            ["sh", "-c", _bring_up()], capture_output=True, text=True, check=False
        )
        if made.returncode:
            raise VmFailed(f"{made.stderr.strip()}; next, as root: {_bring_up()}")
    environment = {**os.environ, **_environment(artefacts)}
    return subprocess.run([sys.executable, *tests], cwd=ROOT, env=environment).returncode


def _bring_up() -> str:
    return f"ip link add dev {CHANNEL} type vcan && ip link set {CHANNEL} up txqueuelen 128"


def _environment(artefacts: Path) -> dict[str, str]:
    return {"CDPR_HIL_CHANNEL": CHANNEL, "CDPR_HIL_ARTEFACTS": str(artefacts)}


def _compile(*, plans: bool) -> None:
    """Compiles the programs here, as the virtual machine would take twenty times as long.

    To bytecode, and the simulated platform to machine code for both processors; also the planner
    for a part that uses planned paths.
    """
    command = [sys.executable, "-m", "compileall", "-q", *COMPILED]
    subprocess.run(command, cwd=ROOT, check=False)  # a read-only folder only costs time
    environment = {**os.environ, **_for_any_processor()}
    subprocess.run([sys.executable, "-c", KERNELS], cwd=ROOT, env=environment, check=True)
    if plans:
        words = ["plan", *PLAN.split(), str(_cache() / "plan.json")]
        program = "from cdpr.cli import main; main()"
        command = [sys.executable, "-c", program, *words]
        subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, check=True)


def _for_any_processor() -> dict[str, str]:
    """Settings for machine code that both processors share: Numba caches it by processor."""
    kept = str(_cache() / "kernels")
    return {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": kept}


def _job(tests: list[str]) -> str:
    """Shell script for the virtual machine, with this Python in this folder."""
    passed = {name: value for name, value in os.environ.items() if name.startswith("CDPR_HIL_")}
    own = {"HOME": "/root", "COLUMNS": "100"}
    environment = {**passed, **_environment(Path("/mnt/job")), **_for_any_processor(), **own}
    exports = [f"export {name}={shlex.quote(value)}" for name, value in environment.items()]
    # Its clock is not one to time a test with: it jumps while a file of the host is waited for.
    command = shlex.join([sys.executable, *tests, "--timeout=0"])
    return "\n".join([*exports, _bring_up(), f"cd {shlex.quote(str(ROOT))}", f"exec {command}", ""])


if __name__ == "__main__":
    sys.exit(main())
