"""A bootable Linux with SocketCAN: the distribution's kernel and a small initramfs.

Nothing is installed on this machine: the kernel package is downloaded with apt and unpacked in
memory; the modules for a virtual CAN bus and a shared root go into an initramfs with busybox and
`guest_init`.
"""

from __future__ import annotations

import hashlib
import io
import lzma
import re
import shutil
import stat
import subprocess
import tarfile
from pathlib import Path

META_PACKAGE = "linux-image-amd64"
"""The standard kernel, as Debian's cloud kernel has no CAN."""

MODULES = ("virtio_pci", "9pnet_virtio", "9p", "overlay", "can_raw", "vcan")
BUSYBOX = Path("/bin/busybox")
GUEST_INIT = Path(__file__).parent / "guest_init"
_NEXT = (
    "next: on Debian sudo apt-get update; elsewhere sudo modprobe vcan (Ubuntu has it in"
    " linux-modules-extra-$(uname -r))"
)
_FOLDERS = ("bin", "dev", "modules", "proc", "sys", "shared", "upper", "new")


class VmFailed(Exception):
    """The machine could not be created or did not boot; the message has the next step."""


def boot_files(cache: Path) -> tuple[Path, Path]:
    """Kernel and initramfs, created once per version of the package and of this folder.

    Raises:
        VmFailed: apt or busybox is missing, or the package is not as expected.
    """
    if not BUSYBOX.is_file():
        raise VmFailed("busybox is missing; next: sudo apt-get install busybox-static")
    package = _package_name()
    parts = GUEST_INIT.read_bytes() + Path(__file__).read_bytes()
    folder = cache / f"{package}-{hashlib.sha256(parts).hexdigest()[:12]}"
    kernel, initramfs = folder / "vmlinuz", folder / "initramfs"
    if not initramfs.is_file():
        making = cache / f"{folder.name}.part"
        shutil.rmtree(making, ignore_errors=True)
        making.mkdir(parents=True)
        _make(package, making)
        making.replace(folder)
    return kernel, initramfs


def _package_name() -> str:
    """The package of the distribution's current kernel, such as linux-image-6.1.0-9-amd64."""
    listed = _apt("apt-cache", "depends", META_PACKAGE)
    found = re.search(r"Depends: (linux-image-\S+)", listed)
    if found is None:
        raise VmFailed(f"apt knows no {META_PACKAGE}; {_NEXT}")
    return found[1]


def _apt(*command: str, folder: Path | None = None) -> str:
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    except FileNotFoundError as error:
        raise VmFailed(
            f"{command[0]} is missing: the virtual machine's kernel comes from Debian's packages;"
            " next: run on a machine whose kernel has vcan (sudo modprobe vcan)"
        ) from error
    except subprocess.CalledProcessError as error:
        output = error.stderr.strip() or error.stdout.strip()
        raise VmFailed(f"{' '.join(command)}: {output}; {_NEXT}") from error
    return done.stdout


def _make(package: str, folder: Path) -> None:
    _apt("apt-get", "-qq", "-o", "APT::Sandbox::User=root", "download", package, folder=folder)
    (deb,) = folder.glob("*.deb")
    image, modules = _unpacked(deb)
    deb.unlink()
    (folder / "vmlinuz").write_bytes(image)
    (folder / "initramfs").write_bytes(_initramfs(_in_order(modules)))


def _unpacked(deb: Path) -> tuple[bytes, dict[str, bytes]]:
    """The kernel image, and every module by name."""
    image, modules = b"", {}
    unpack = ["dpkg-deb", "--fsys-tarfile", deb]
    with (
        subprocess.Popen(unpack, stdout=subprocess.PIPE) as unpacking,
        tarfile.open(fileobj=unpacking.stdout, mode="r|") as archive,
    ):
        for member in archive:
            name = Path(member.name)
            if name.name.startswith("vmlinuz"):
                image = _content(archive, member)
            elif ".ko" in name.suffixes:
                data = _content(archive, member)
                plain = lzma.decompress(data) if name.suffix == ".xz" else data
                modules[_module(name.name.split(".")[0])] = plain
    if not image:
        raise VmFailed(f"there is no kernel in {deb.name}")
    return image, modules


def _content(archive: tarfile.TarFile, member: tarfile.TarInfo) -> bytes:
    file = archive.extractfile(member)
    return file.read() if file else b""


def _module(name: str) -> str:
    """Module name with underscores, as the kernel mixes - and _."""
    return name.replace("-", "_")


def _in_order(modules: dict[str, bytes]) -> dict[str, bytes]:
    """The required modules in loading order; built-in ones have no file."""
    ordered: dict[str, bytes] = {}

    def add(name: str) -> None:
        data = modules.get(_module(name))
        if data is None or _module(name) in ordered:
            return
        needs = re.search(rb"\0depends=([^\0]*)\0", data)
        for other in needs[1].decode().split(",") if needs else ():
            add(other)
        ordered[_module(name)] = data

    for name in MODULES:
        add(name)
    if "vcan" not in ordered:
        raise VmFailed(f"the kernel of {META_PACKAGE} has no vcan")
    return ordered


def _initramfs(modules: dict[str, bytes]) -> bytes:
    """A newc archive: folders, busybox, the modules numbered in the order of loading, init.

    Source: Linux, Documentation/driver-api/early-userspace/buffer-format.rst.
    """
    archive = io.BytesIO()
    for folder in _FOLDERS:
        _append(archive, folder, stat.S_IFDIR | 0o755, b"")
    _append(archive, "bin/busybox", stat.S_IFREG | 0o755, BUSYBOX.read_bytes())
    for number, (name, data) in enumerate(modules.items()):
        _append(archive, f"modules/{number:02d}-{name}.ko", stat.S_IFREG | 0o644, data)
    _append(archive, "init", stat.S_IFREG | 0o755, GUEST_INIT.read_bytes())
    _append(archive, "TRAILER!!!", 0, b"")
    return archive.getvalue()


def _append(archive: io.BytesIO, name: str, mode: int, data: bytes) -> None:
    inode = archive.tell() + 1  # unique in the archive
    path = name.encode() + b"\0"
    numbers = (inode, mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(path), 0)
    archive.write(b"070701" + b"".join(b"%08X" % number for number in numbers) + path)
    archive.write(b"\0" * (-archive.tell() % 4))
    archive.write(data)
    archive.write(b"\0" * (-archive.tell() % 4))
