"""The reader of input files, with limits: refuses anything irregular, too large or too deep.

Every file that a user names is read here, so that a device, a pipe or a malicious file ends in one
message before it costs memory or time.
"""

from __future__ import annotations

import csv
import errno
import json
import os
import stat
import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, NoReturn

from model.errors import BadInput

MEGABYTE = 1_000_000
TEXT_LIMIT = 256 * MEGABYTE
"""Largest text file that a user names, [bytes]."""
YAML_LIMIT = 1 * MEGABYTE
"""Largest YAML file, [bytes]; its parser needs several seconds for that."""
IMAGE_LIMIT = 256 * MEGABYTE
"""Largest image file, [bytes]."""


READING_NEEDS = 10
"""Memory for reading a table of a run, which is read whole, as a multiple of its size."""


def table_limit(memory: int) -> int:
    """Largest table of a run, [bytes]: as much as three quarters of the memory suffice to read.

    It is at least `TEXT_LIMIT`.

    Args:
        memory: Of the computer, [bytes].
    """
    return max(TEXT_LIMIT, memory * 3 // (4 * READING_NEEDS))


TABLE_LIMIT = table_limit(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
"""Largest table of a run that this computer reads, [bytes]."""


def ready_folder(name: str = "configs") -> Path:
    """A folder that is installed beside the code: in the package `cdpr`, or in the repository.

    Args:
        name: ``configs`` for the example rigs and scenes, ``examples`` for the recorded sessions,
            ``docs`` for the documentation, ``docs/schema`` for the schemas.
    """
    root = Path(__file__).resolve().parents[2]
    inside = root / "cdpr" / name
    return inside if inside.is_dir() else root / name


def docs_page(name: str) -> str:
    """Path of a page of the documentation, for messages: a user of the wheel has no clone."""
    return str(ready_folder("docs") / name)


SHORTEN = (
    "shorten the file; in a scene, simplify meshes or replace them by convex hulls"
    f" ({docs_page('scene-file.md')})"
)
_SHORTENED = {
    TABLE_LIMIT: "check the path; a computer with more memory reads larger tables",
    YAML_LIMIT: f"check the path, or {SHORTEN}",
}


def read_bytes(path: Path, limit: int = TEXT_LIMIT) -> bytes:
    """The content of a regular file.

    Args:
        limit: Its largest size, [bytes].

    Raises:
        BadInput: The file is missing, a folder, a device or a pipe, unreadable or too large.
    """
    try:
        # A pipe is opened without waiting for its writer, and then refused.
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOCTTY)
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from None
    try:
        with os.fdopen(handle, "rb") as stream:
            _require_regular(path, os.fstat(handle), limit)
            # Piece by piece: reading up to the limit at once would first claim that much memory.
            pieces, size = [], 0
            while size <= limit and (piece := stream.read(MEGABYTE)):
                pieces.append(piece)
                size += len(piece)
            return b"".join(pieces)
    except OSError as error:
        raise unreadable(path, error) from None


def _require_regular(path: Path, found: os.stat_result, limit: int) -> None:
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError
    if not stat.S_ISREG(found.st_mode):
        raise BadInput(
            "not a regular file but a device, a pipe or a socket",
            where=str(path),
            next_step="save its content to a file and pass that file",
        )
    if found.st_size > limit:
        raise BadInput(
            f"the file has {found.st_size / MEGABYTE:.1f} MB; at most {limit / MEGABYTE:.0f} MB"
            " are read",
            where=str(path),
            why="a larger file takes too long to read, or too much memory",
            next_step=_SHORTENED.get(limit, "check the path"),
        )


def unreadable(path: Path, error: Exception) -> BadInput:
    """The error for a file that the operating system cannot read."""
    what, why, hint = "the file cannot be read", "", "check the path and its read permissions"
    match error:
        case FileNotFoundError():
            what, hint = "no such file", "check the path and its spelling"
        case IsADirectoryError():
            what, hint = "this is a folder", "name a file"
        case OSError(errno=errno.ENAMETOOLONG):  # for outputs too
            what, why, hint = "the path cannot be used", str(error.strerror), "shorten its name"
        case OSError():
            why = error.strerror or str(error)
        case _:
            why = str(error)  # such as a zero byte in its name
    return BadInput(what, where=shown(path), why=why, next_step=hint)


def is_folder(path: Path) -> bool:
    """Whether a folder exists there.

    Raises:
        BadInput: The operating system cannot answer, as in another user's folder.
    """
    try:
        return path.is_dir()
    except OSError as error:
        raise unreadable(path, error) from None


#: Seconds since 1970 have at least so many digits in a name; shorter numbers may be counts.
SECONDS_SINCE_1970 = 9


def files_in(folder: Path) -> list[Path]:
    """What a folder contains.

    Raises:
        BadInput: It cannot be read.
    """
    try:
        return list(folder.iterdir())
    except OSError as error:
        raise unreadable(folder, error) from None


def shown(path: Path | str) -> str:
    """A path for a message, shortened in the middle if very long."""
    text = str(path)
    return text if len(text) <= 160 else f"{text[:80]} … {text[-60:]}"


def read_text(path: Path, limit: int = TEXT_LIMIT) -> str:
    """The text of a regular file.

    Raises:
        BadInput: As `read_bytes`, or it is not UTF-8.
    """
    data = read_bytes(path, limit)
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise BadInput(
            f"the file is not UTF-8 text: byte 0x{error.object[error.start]:02x} in line {line}",
            where=str(path),
            why="it is not a text file, or uses another encoding",
            next_step="save it as UTF-8",
        ) from None


def read_json(path: Path, next_step: str) -> Any:
    """The content of a JSON file with finite numbers and unique keys.

    Args:
        next_step: What to do about a damaged file.

    Raises:
        BadInput: It cannot be read or is not such JSON.
    """
    text = read_text(path)
    try:
        return parse_json(text)
    except json.JSONDecodeError as error:
        what = f"not valid JSON: {error.msg}"
        where = f"{path}:{error.lineno}:{error.colno}"
        why = "the file was truncated or edited" if text.strip() else "the file is empty"
        if text.strip() and text.lstrip()[0] not in "{[":
            why, next_step = "it is a file of another kind", f"pass another file, or {next_step}"
        raise BadInput(what, where=where, why=why, next_step=next_step) from None
    except ValueError as error:
        raise BadInput(str(error), where=str(path), next_step=next_step) from None


def parse_json(text: str) -> Any:
    """The content of a JSON text.

    Raises:
        ValueError: It is not JSON, is nested too deeply, has a duplicate key, or a number that is
            infinite, NaN or has too many digits.
    """
    try:
        return json.loads(
            text,
            parse_constant=_no_constant,
            parse_float=_finite,
            parse_int=_whole,
            object_pairs_hook=_unique_keys,
        )
    except RecursionError:
        raise ValueError("the file is nested too deeply") from None


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"the file holds {name}, which is not a number")


def _finite(text: str) -> float:
    value = float(text)
    if value in (float("inf"), float("-inf")):
        raise ValueError(f"the file holds {text[:40]}, which is not a finite number")
    return value


def _whole(text: str) -> int:
    if len(text) > 40:
        raise ValueError(f"the file holds a number of {len(text)} digits")
    return int(text)


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data = dict(pairs)
    if len(data) != len(pairs):
        (twice, _), *_ = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"the key {twice[:60]!r} appears twice")
    return data


# Size stated in the header of an image file, read before decoding.
#
# Source: PNG specification (W3C), 11.2.1; JPEG, ITU-T T.81, annex B; BMP,
# Microsoft's BITMAPINFOHEADER.


MOST_PIXELS = 2**28
"""Largest number of pixels of an image, above any camera in use; 256 MB in grey."""

_NO_SIZE = frozenset({0x01, *range(0xD0, 0xD9)})  # markers without a length
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def stated_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of a PNG, JPEG or BMP file, [px]; None for other or damaged files."""
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            width, height = struct.unpack_from(">II", data, 16)
        elif data.startswith(b"\xff\xd8"):
            return _jpeg(data)
        elif data.startswith(b"BM"):
            width, height = struct.unpack_from("<ii", data, 18)
        else:
            return None
    except struct.error:
        return None
    return abs(width), abs(height)


def is_too_large(data: bytes) -> bool:
    """Whether an image states more than `MOST_PIXELS`; OpenCV limits other formats itself."""
    size = stated_size(data)
    return size is not None and size[0] * size[1] > MOST_PIXELS


def _jpeg(data: bytes) -> tuple[int, int] | None:
    """Size from the first frame header."""
    for marker, at in jpeg_segments(data):
        if marker in _FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 3)
            return int(width), int(height)
    return None


def jpeg_segments(data: bytes | memoryview) -> Iterator[tuple[int, int]]:
    """Marker of each segment of a JPEG file up to the first scan, and offset of its length.

    The data may end there: segments are not known to be whole.
    """
    at = 2
    with suppress(struct.error):
        while True:
            sign, marker = struct.unpack_from(">BB", data, at)
            if sign != 0xFF:
                return
            at += 2 if marker != 0xFF else 1
            if marker == 0xFF or marker in _NO_SIZE:
                continue
            yield marker, at
            (length,) = struct.unpack_from(">H", data, at)
            at += max(2, length)


# Entries of a TIFF file, and of EXIF data.
#
# Source: TIFF revision 6.0 (Adobe), section 2; a file has one directory per image.


_SHORT, _WIDTH, _HEIGHT, _KIND, _ORIENTATION = 3, 0x100, 0x101, 0xFE, 0x112
_NO_PAGE = 0b101  # a thumbnail, or a mask
_MOST_ENTRIES = 1_000_000
_EXIF_WITHIN = 65536
"""Largest offset of an EXIF block in a file, and its largest length, [bytes]."""


def _tiff_entries(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Directory from 0, tag and number of each entry; nothing of other files."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(data[:4])
    if order is None:
        return
    known: set[int] = set()  # directories of a damaged file may form a circle
    with suppress(struct.error):
        (at,) = struct.unpack_from(f"{order}I", data, 4)
        while at and at not in known:
            (entries,) = struct.unpack_from(f"{order}H", data, at)
            for start in range(at + 2, at + 2 + 12 * entries, 12):
                tag, kind = struct.unpack_from(f"{order}HH", data, start)
                form = "H" if kind == _SHORT else "I"
                (value,) = struct.unpack_from(f"{order}{form}", data, start + 8)
                yield len(known), tag, value
            known.add(at)
            (at,) = struct.unpack_from(f"{order}I", data, at + 2 + 12 * entries)


def page_count(data: bytes) -> int:
    """Number of images of the first one's size in a TIFF file; 1 for other files."""
    pages: dict[int, dict[int, int]] = {}
    for directory, tag, value in islice(_tiff_entries(data), _MOST_ENTRIES):
        pages.setdefault(directory, {})[tag] = value
    sizes = [
        (page.get(_WIDTH), page.get(_HEIGHT))
        for page in pages.values()
        if not page.get(_KIND, 0) & _NO_PAGE
    ]
    return max(1, sizes.count(sizes[0])) if sizes else 1


SPLIT = "save each image as a file of its own"
"""Next step for a file of several images."""


def require_one_page(path: Path) -> None:
    """Requires at most one image in a TIFF file, of which OpenCV reads the first as a video.

    Raises:
        BadInput: It cannot be read, or has several.
    """
    if (pages := page_count(read_bytes(path, IMAGE_LIMIT))) > 1:
        what = f"the file has {pages} pages"
        raise BadInput(what, where=str(path), next_step=f"{SPLIT}, and name their folder")


def exif_orientation(data: bytes) -> int:
    """The orientation in a JPEG file's EXIF data, 1 to 8; 1 if it states none."""
    tiff = data[: 2 * _EXIF_WITHIN].partition(b"Exif\0\0")[2]
    first = (entry[1:] for entry in _tiff_entries(tiff) if entry[0] == 0)
    return next((value for tag, value in first if tag == _ORIENTATION), 1)


# Tables.


class CsvFile:
    """The rows of a CSV file with any line ends.

    Args:
        path: The file.
        text: Its content, if the caller has read it already.

    Attributes:
        rows: Lists of texts, empty lines left out.
        lines: The line in which each row ends, counted from 1.

    Raises:
        BadInput: It cannot be read, or is not CSV.
    """

    def __init__(self, path: Path, text: str | None = None) -> None:
        text = (read_text(path) if text is None else text).replace("\r", "\n")
        self.rows: list[list[str]] = []
        self.lines: list[int] = []
        for line, row in _rows(text, path):
            if row:
                self.rows.append(row)
                self.lines.append(line)


def _lines(text: str) -> Iterator[str]:
    """The lines of a text; `io.StringIO` would need four bytes of memory for every character."""
    start = 0
    while start < len(text):
        end = text.find("\n", start) + 1 or len(text)
        yield text[start:end]
        start = end


def _rows(text: str, path: Path) -> Iterator[tuple[int, list[str]]]:
    reader = csv.reader(_lines(text))
    try:
        for row in reader:
            yield reader.line_num, row
    except csv.Error as error:
        raise BadInput(
            f"not valid CSV: {error}",
            where=f"{path}:{reader.line_num}",
            why="a quote is not closed, or this is not a CSV file",
            next_step="write a header line, then comma-separated lines of values",
        ) from None
