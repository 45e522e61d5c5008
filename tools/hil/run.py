"""Runs the tests marked `hil` on a virtual CAN bus: of this machine, else of a virtual one.

    python tools/hil/run.py [--artefacts DIR] [--limit-s S] [pytest's arguments]
    python tools/hil/run.py --missing

The exit status is pytest's; 125 when there is no bus to run them on. With --missing it only names
the Debian packages that must be installed before, in one line; needs no environment of its own.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import socket
import subprocess
import sys
from pathlib import Path

from kernel import BUSYBOX, VmFailed
from vm import QEMU, run_in_vm

ROOT = Path(__file__).resolve().parents[2]
CHANNEL = "vcan0"
NO_BUS = 125
TESTS = ("-m", "pytest", "-p", "no:cacheprovider", "tests/hil")
NEEDED = {"ip": "iproute2", "candump": "can-utils"}
NEEDED_BY_VM = {QEMU: "qemu-system-x86", str(BUSYBOX): "busybox-static"}
COMPILED = ("cdpr", "drivers", "executor", "planner", "simulation", "tests", "tracking")


def main() -> int:
    """Chooses where, and runs there."""
    parser = argparse.ArgumentParser(description="run the hardware-in-the-loop tests on vcan")
    parser.add_argument("--artefacts", type=Path, default=_cache() / "last")
    parser.add_argument("--limit-s", type=float, default=1800.0)
    parser.add_argument("--missing", action="store_true")
    options, rest = parser.parse_known_args()
    if options.missing:
        print(*_missing())
        return 0
    artefacts = options.artefacts.resolve()
    if artefacts.is_relative_to(ROOT):
        parser.error(f"--artefacts {artefacts} is inside the repository; name another folder")
    if artefacts == _cache() / "last":
        shutil.rmtree(artefacts, ignore_errors=True)
    elif artefacts.exists() and any(artefacts.iterdir()):
        parser.error(f"--artefacts {artefacts} holds something already; name an empty folder")
    artefacts.mkdir(parents=True, exist_ok=True)
    tests = [*TESTS, *(rest or ["-m", "hil"])]
    try:
        _require_tools()
        if _host_has_can():
            print(f"hil: on this machine's {CHANNEL}; traces in {artefacts}", flush=True)
            return _on_host(tests, artefacts)
        print(f"hil: no AF_CAN here, so in a virtual machine; traces in {artefacts}", flush=True)
        _compile()
        return run_in_vm(_job(tests), artefacts, _cache(), options.limit_s)
    except VmFailed as error:
        print(f"hil: {error}", file=sys.stderr)
        return NO_BUS


def _cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "cdpr" / "hil"


def _require_tools() -> None:
    missing = _missing()
    if missing:
        raise VmFailed(f"tools are missing; next: sudo apt-get install {' '.join(missing)}")


def _missing() -> list[str]:
    """Packages whose tools are not here."""
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
    """On an interface of this machine; one that is missing can be made by root alone."""
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


def _compile() -> None:
    """To bytecode, here: it takes twenty times as long where instructions are counted."""
    command = [sys.executable, "-m", "compileall", "-q", *COMPILED]
    subprocess.run(command, cwd=ROOT, check=False)  # a folder that is read-only costs time alone


def _job(tests: list[str]) -> str:
    """What the virtual machine runs, with this Python and in this folder."""
    passed = {name: value for name, value in os.environ.items() if name.startswith("CDPR_HIL_")}
    environment = {**passed, **_environment(Path("/mnt/job")), "HOME": "/root", "COLUMNS": "100"}
    exports = [f"export {name}={shlex.quote(value)}" for name, value in environment.items()]
    command = shlex.join([sys.executable, *tests])
    return "\n".join([*exports, _bring_up(), f"cd {shlex.quote(str(ROOT))}", f"exec {command}", ""])


if __name__ == "__main__":
    sys.exit(main())
