"""The privileges of this process, as it reports them itself."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from executor.realtime import scheduling
from executor.realtime.scheduling import CAP_IPC_LOCK, CAP_SYS_NICE, has_capability

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


@pytest.mark.parametrize(
    ("users", "counts"), [("0 1000 1", False), ("0 0 4294967295", True), (None, True)]
)
def test_in_a_rootless_container_no_capability_counts(
    users: str | None, counts: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """It has all of them there, but the kernel asks for those of the machine."""
    (tmp_path / "status").write_text("Name: python\nCapEff:\t000001ffffffffff\n")
    if users is not None:
        (tmp_path / "uid_map").write_text("".join(f"{each:>11}" for each in users.split()) + "\n")
    monkeypatch.setattr(scheduling, "Path", lambda path: tmp_path / Path(path).name)
    assert [has_capability(each) for each in (CAP_IPC_LOCK, CAP_SYS_NICE)] == [counts] * 2
