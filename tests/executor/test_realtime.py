"""The privileges of this process, as it reports them itself."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from executor.realtime.scheduling import CAP_IPC_LOCK, CAP_SYS_NICE

ROOT = Path(__file__).parents[2]
#: Drops a privilege for good, then prints whether it is still there.
SCRIPT = """
import ctypes, sys
from executor.realtime.scheduling import has_capability
data = (ctypes.c_uint32 * 6)()
header = (ctypes.c_uint32 * 2)(0x20080522, 0)  # _LINUX_CAPABILITY_VERSION_3
libc = ctypes.CDLL(None, use_errno=True)
libc.capget(header, data)
dropped = int(sys.argv[1])
data[0] &= ~(1 << dropped)
libc.capset(header, data)
print(has_capability(14), has_capability(23))
"""


@pytest.mark.parametrize(
    ("dropped", "expected"), [(CAP_IPC_LOCK, "False True"), (CAP_SYS_NICE, "True False")]
)
def test_a_privilege_is_distinguished_from_being_root(dropped: int, expected: str) -> None:
    answer = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(dropped)], capture_output=True, text=True, cwd=ROOT
    )
    if answer.stdout.strip() == "False False":
        pytest.skip("only a process with these privileges can give one up")
    assert answer.stdout.strip() == expected, answer.stderr
