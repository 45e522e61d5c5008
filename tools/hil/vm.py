"""Boots a small virtual machine on this machine's files and runs one shell command in it.

Its time is the number of executed instructions, and jumps ahead while it waits, so that a busy host
makes it slower but not late: no frame is lost because of other programs. As a side effect, its time
runs fast while it waits for a file of the host.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

from kernel import VmFailed, boot_files

QEMU = "qemu-system-x86_64"
MEMORY_MB = 2048
NANOSECONDS_PER_INSTRUCTION = 0
"""Exponent of two: 2^0."""

_APPEND = "console=ttyS0 quiet panic=-1 mitigations=off nokaslr random.trust_cpu=on"
_SHARED = "local,security_model=none,multidevs=remap"


def run_in_vm(command: str, job: Path, cache: Path, limit_s: float) -> int:
    """Runs a shell command as root in the machine; its output appears here.

    Args:
        command: For ``/bin/sh``. It sees this machine's files; its changes are discarded, except in
            ``/mnt/job``.
        job: Host folder of ``/mnt/job``.
        cache: Folder of kernel and initramfs.
        limit_s: Time after which the machine is powered off, [s].

    Returns:
        The command's exit status.

    Raises:
        VmFailed: The machine did not boot, or the command did not end.
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
        output = console.read_text(errors="replace")[-2000:] if console.is_file() else ""
        raise VmFailed(f"the machine ended without a result; its last output:\n{output}")
    return int(status.read_text())


def _machine(kernel: Path, initramfs: Path, job: Path, console: Path) -> list[str]:
    """QEMU command without KVM, which also works on virtual machines."""
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
