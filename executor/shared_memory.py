"""Memory that two processes share. It has no name, so nothing is left of it whoever is killed."""

from __future__ import annotations

import fcntl
import mmap
import os
from multiprocessing.reduction import DupFd
from typing import Protocol


class _Sent(Protocol):
    """A descriptor on its way to a process that is being started."""

    def detach(self) -> int:
        """The same file here."""
        ...


class SharedMemory:
    """A piece of memory; given to a process that is being started, it is the same piece there.

    Attributes:
        view: Its content.
        size: [bytes].
    """

    def __init__(self, descriptor: int, size: int, *, writable: bool) -> None:
        """Takes over an open memory file; `create` and `sealed` make one."""
        self._descriptor, self._writable = descriptor, writable
        self.size = size
        protection = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
        self.view = mmap.mmap(descriptor, size, prot=protection)

    @classmethod
    def create(cls, size: int) -> SharedMemory:
        """Empty memory that both sides may write to."""
        descriptor = os.memfd_create("cdpr", os.MFD_CLOEXEC)
        os.ftruncate(descriptor, size)
        return cls(descriptor, size, writable=True)

    @classmethod
    def sealed(cls, content: bytes) -> SharedMemory:
        """Memory that nobody can write to any more, in no process."""
        descriptor = os.memfd_create("cdpr", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        left = memoryview(content)
        while left:
            left = left[os.write(descriptor, left) :]
        seals = fcntl.F_SEAL_WRITE | fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, seals)
        return cls(descriptor, len(content), writable=False)

    def close(self) -> None:
        """Lets go of it; what NumPy still looks at stays until that is gone."""
        os.close(self._descriptor)

    def __reduce__(self) -> tuple[object, ...]:
        """Only while a process is being started: the descriptor goes along."""
        return _received, (DupFd(self._descriptor), self.size, self._writable)


def _received(descriptor: _Sent, size: int, writable: bool) -> SharedMemory:
    return SharedMemory(descriptor.detach(), size, writable=writable)
