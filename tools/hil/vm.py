"""Boots a small virtual machine on this machine's own files and runs one shell command in it.

Its processor counts instructions instead of following the host's clock, and where it waits its time
jumps to what it waits for, so that a busy host makes it slower and not late: no frame is lost
because something else runs beside it. The other side of it: while the machine waits for a file of
the host, its own time flies.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

from kernel import VmFailed, boot_files

QEMU = "qemu-system-x86_64"
MEMORY_MB = 2048
NANOSECONDS_PER_INSTRUCTION = 0
"""As a power of two: 2^0."""

_APPEND = "console=ttyS0 quiet panic=-1 mitigations=off nokaslr random.trust_cpu=on"
_SHARED = "local,security_model=none,multidevs=remap"


def run_in_vm(command: str, job: Path, cache: Path, limit_s: float) -> int:
    """Runs a shell command as root in the machine; what it prints appears here.

    Args:
        command: For ``/bin/sh``. It sees this machine's files, read-only underneath; what it writes
            is gone afterwards, except in ``/mnt/job``.
        job: Folder here that is ``/mnt/job`` there.
        cache: Where kernel and initramfs are kept.
        limit_s: After so long the machine is switched off, [s].

    Returns:
        The command's exit status.

    Raises:
        VmFailed: The machine did not come up, or the command did not end.
    """
    if shutil.which(QEMU) is None:
        raise VmFailed(f"{QEMU} is missing; next: sudo apt-get install qemu-system-x86")
    kernel, initramfs = boot_files(cache)
    status, console = job / "status", job / "console"
    status.unlink(missing_ok=True)
    (job / "run").write_text(command)
    machine = _machine(kernel, initramfs, job, console)
    try:
        subprocess.run(machine, stdin=subprocess.DEVNULL, timeout=limit_s, check=False)
    except subprocess.TimeoutExpired as error:
        raise VmFailed(f"the machine was switched off after {limit_s:.0f} s; see {job}") from error
    if not status.is_file():
        said = console.read_text(errors="replace")[-2000:] if console.is_file() else ""
        raise VmFailed(f"the machine ended without a result; its last words:\n{said}")
    return int(status.read_text())


def _machine(kernel: Path, initramfs: Path, job: Path, console: Path) -> list[str]:
    """QEMU without KVM: it works on machines that are virtual themselves."""
    timing = f"shift={NANOSECONDS_PER_INSTRUCTION},sleep=off"
    return [
        *(QEMU, "-nodefaults", "-no-user-config", "-no-reboot", "-display", "none"),
        *("-machine", "q35", "-cpu", "max", "-m", str(MEMORY_MB)),
        *("-accel", "tcg,thread=single,tb-size=512", "-icount", timing),
        *("-kernel", str(kernel), "-initrd", str(initramfs), "-append", _APPEND),
        *("-serial", f"file:{console}", "-serial", "stdio"),
        *("-fsdev", f"{_SHARED},id=host,path=/,readonly=on"),
        *("-device", "virtio-9p-pci,fsdev=host,mount_tag=host"),
        *("-fsdev", f"{_SHARED},id=job,path={job}"),
        *("-device", "virtio-9p-pci,fsdev=job,mount_tag=job"),
    ]
