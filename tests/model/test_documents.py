"""Content hashes and atomic writes."""

from __future__ import annotations

import errno
import hashlib
import os
import pickle
import re
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from executor.recording.record_files import append_lines
from model.errors import BadInput, without_passwords
from model.files.documents import content_hash, write_atomic

json_values = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(),
        st.floats(allow_nan=False, allow_infinity=False),
        st.text(),
    ),
    lambda inner: st.one_of(st.lists(inner), st.dictionaries(st.text(), inner)),
    max_leaves=10,
)


@given(st.dictionaries(st.text(), json_values))
def test_the_order_of_keys_does_not_change_a_hash(data: dict[str, Any]) -> None:
    assert content_hash(dict(reversed(data.items()))) == content_hash(data)


@given(json_values, json_values)
def test_different_content_has_different_hashes(a: Any, b: Any) -> None:
    assert (content_hash(a) == content_hash(b)) == (repr_sorted(a) == repr_sorted(b))


def repr_sorted(value: Any) -> str:
    """An independent canonical form: types and signs of zero count."""
    if isinstance(value, dict):
        inner = ",".join(f"{k!r}:{repr_sorted(value[k])}" for k in sorted(value))
        return f"{{{inner}}}"
    return f"[{','.join(map(repr_sorted, value))}]" if isinstance(value, list) else repr(value)


def test_a_hash_stays_the_same_from_version_to_version() -> None:
    """Plans on disk depend on it."""
    text = rb'{"a":"\u00e9","b":[1,2.5,null,true]}'
    expected = "sha256:" + hashlib.sha256(text).hexdigest()
    assert content_hash({"b": [1, 2.5, None, True], "a": "é"}) == expected


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_nan_and_infinity_have_no_hash(value: float) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        content_hash({"a": value})


def test_a_file_is_replaced_whole_and_nothing_else_is_left(tmp_path: Path) -> None:
    path = tmp_path / "a folder" / "file.json"
    path.parent.mkdir()
    path.write_text("old")
    write_atomic(path, "new é\n")
    assert path.read_bytes() == "new é\n".encode()
    assert [p.name for p in path.parent.iterdir()] == ["file.json"]
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize("step", ["fsync", "replace"])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_a_failed_write_leaves_the_old_file_and_no_other(
    step: str, number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "file.json"
    path.write_text("old")

    def fail(*_: object) -> NoReturn:
        raise OSError(number, os.strerror(number))

    if step == "fsync":
        monkeypatch.setattr(os, "fsync", fail)
    else:
        monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(BadInput, match="cannot be written") as caught:
        write_atomic(path, "new")
    assert caught.value.why == os.strerror(number)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["file.json"]


def syncing_no_folder(number: int) -> Callable[[int], None]:
    """A file system whose folders cannot be synced."""
    fsync = os.fsync

    def of_files(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(number, os.strerror(number))
        fsync(handle)

    return of_files


@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOTSUP])
def test_a_file_system_without_modes_and_synced_folders_takes_files(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As mounts of a network drive or of a virtual machine's host may be."""

    def denied(*_: object) -> NoReturn:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "fsync", syncing_no_folder(number))
    monkeypatch.setattr(Path, "chmod", denied)
    write_atomic(tmp_path / "file.json", "new")
    append_lines(tmp_path / "lines.csv", "a\n", fsync=True)
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["file.json", "lines.csv"]
    with pytest.raises(BadInput, match="file system cannot sync folders"):
        write_atomic(tmp_path / "file.json", "newer", durable=True)
    assert (tmp_path / "file.json").read_text() == "new"


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_a_folder_that_the_disk_fails_to_sync_is_reported(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", syncing_no_folder(number))
    with pytest.raises(BadInput, match="cannot be written"):
        write_atomic(tmp_path / "file.json", "new")
    with pytest.raises(OSError, match=os.strerror(number)):
        append_lines(tmp_path / "lines.csv", "a\n", fsync=True)


def test_an_interrupted_write_leaves_no_temporary_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(_: int) -> NoReturn:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_atomic(tmp_path / "file.json", "new")
    assert list(tmp_path.iterdir()) == []


def test_text_that_cannot_be_encoded_is_written_as_its_escape(tmp_path: Path) -> None:
    """Such as the name of a file that is not UTF-8."""
    write_atomic(tmp_path / "file.json", "a \ud800")
    assert (tmp_path / "file.json").read_text() == "a \\ud800"
    assert [path.name for path in tmp_path.iterdir()] == ["file.json"]


def test_a_folder_that_may_not_be_written_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Root may write everywhere, so the system's reply is mocked."""

    def denied(**_: object) -> NoReturn:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(tempfile, "mkstemp", denied)
    with pytest.raises(BadInput, match="cannot be written") as caught:
        write_atomic(tmp_path / "file.json", "new")
    assert caught.value.why == "Permission denied"
    assert "write permission" in caught.value.next_step


PART = st.text(
    st.characters(min_codepoint=33, max_codepoint=126, exclude_characters="/?#@:[]"), min_size=3
)


@given(
    st.sampled_from(("rtsp", "http", "RTSPS")),
    PART,
    st.text(st.characters(min_codepoint=32, max_codepoint=126), min_size=1),
    PART,
    st.sampled_from(("", ":554", "/stream", ":554/cam@1?x=1", "/?a=b@c")),
)
def test_no_password_of_an_address_is_in_a_message(
    scheme: str, user: str, password: str, host: str, rest: str
) -> None:
    assume(not re.match(r"\d{1,5}[/?#]", password) and not re.search(r"[/?#].*\s", password))
    address = f"{scheme}://{user}:{password}@{host}{rest}"
    for text in (address, f"front={address}", f"camera front ({address})"):
        shown = without_passwords(text)
        assert f":{password}@" not in shown or password == "***"
        assert f"{scheme}://{user}:***@" in shown
    error = pickle.loads(pickle.dumps(BadInput(address, where=address, why=address)))
    assert f":{password}@" not in f"{error} {error.as_dict()} {error.args}" or password == "***"


@pytest.mark.parametrize(
    "text",
    [
        "rtsp://10.0.0.5:554/cam@1", "rtsp://user@host/x", "http://[fe80::1]:80/x", "0",
        "/dev/video0", "front=http://h:80/?x=1", "a folder/with user:name@host.png",
    ],
)  # fmt: skip
def test_an_address_without_a_password_is_shown_as_it_is(text: str) -> None:
    assert without_passwords(text) == text


@pytest.mark.parametrize("key", ["password", "passwd", "pass", "pwd", "PWD"])
def test_a_password_among_the_parameters_of_an_address_is_left_out(key: str) -> None:
    shown = without_passwords(f"http://h/video?user=me&{key}=s3cret&channel=1")
    assert shown == f"http://h/video?user=me&{key}=***&channel=1"
