"""Harmful images: absurd sizes are refused before decoding; outputs are complete or absent."""

from __future__ import annotations

import errno
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import NoReturn

import cv2
import numpy as np
import pytest

from drivers.cameras.files import ImageFolder, ImageOutput, SingleCameraImages, read_image
from drivers.cameras.live import VideoFile
from model.cameras import generic_camera
from model.errors import BadInput, Fault
from model.files.reading import MOST_PIXELS, is_too_large, page_count, stated_size

IMAGE = np.full((48, 64, 3), 90, np.uint8)


def png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        whole = kind + data
        return struct.pack(">I", len(data)) + whole + struct.pack(">I", zlib.crc32(whole))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    rows = zlib.compress(b"\0" * 10_000_000)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", rows), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize("ending", [".png", ".jpg", ".bmp"])
@pytest.mark.parametrize("size", [(64, 48), (1, 1), (301, 7)])
def test_the_stated_size_is_the_decoded_one(ending: str, size: tuple[int, int]) -> None:
    done, data = cv2.imencode(ending, np.zeros((size[1], size[0]), np.uint8))
    assert done
    assert stated_size(data.tobytes()) == size


@pytest.mark.parametrize("ending", [".png", ".jpg", ".bmp"])
def test_a_header_cut_off_anywhere_has_a_size_or_none(ending: str) -> None:
    data = cv2.imencode(ending, IMAGE)[1].tobytes()
    for end in range(min(len(data), 700)):
        assert stated_size(data[:end]) in (None, (64, 48))


def test_a_picture_of_900_megapixels_is_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def decoded(*_: object) -> NoReturn:
        raise AssertionError("it was decoded")

    (tmp_path / "a.png").write_bytes(png(30_000, 30_000))
    monkeypatch.setattr(cv2, "imdecode", decoded)
    assert is_too_large((tmp_path / "a.png").read_bytes())
    assert read_image(tmp_path / "a.png") is None


def test_opencv_itself_refuses_it_in_formats_whose_header_is_not_read(tmp_path: Path) -> None:
    """With a lower limit for a small image; ours is set before OpenCV is loaded."""
    assert os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"] == str(MOST_PIXELS)
    cv2.imwrite(str(tmp_path / "a.pgm"), IMAGE[:, :, 0])
    reads = (
        "import sys; from pathlib import Path; from drivers.cameras.files import read_image;"
        " print(read_image(Path(sys.argv[1])) is None)"
    )
    answers = [
        subprocess.run(
            [sys.executable, "-c", reads, str(tmp_path / "a.pgm")],
            env={**os.environ, "OPENCV_IO_MAX_IMAGE_PIXELS": str(limit)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
        for limit in (100, 10_000)
    ]
    assert answers == ["True", "False"]


def test_a_pipe_or_device_among_pictures_is_none(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.png")
    assert read_image(tmp_path / "a.png") is None
    assert read_image(Path("/dev/zero")) is None


def test_a_full_disk_leaves_no_empty_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> NoReturn:
        raise OSError(errno.ENOSPC, "No space left on device")

    with ImageOutput(tmp_path / "drawn", 10.0) as out:
        out.write(IMAGE, "a.png")
        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(Fault, match="cannot be written") as caught:
            out.write(IMAGE, "b.png")
    assert caught.value.why == "No space left on device"
    assert [path.name for path in (tmp_path / "drawn").iterdir()] == ["a.png"]


def test_no_drawn_picture_replaces_another(tmp_path: Path) -> None:
    """Names that differ in signs or in the suffix only have a file each."""
    names = ["a b.jpg", "a+b.jpg", "a_b.jpg", "a_b.png", "a.png", "a.jpg", "a.jpg.png"]
    with ImageOutput(tmp_path / "drawn", 10.0) as out:
        for k, name in enumerate(names):
            out.write(np.full((4, 6, 3), k, np.uint8), name)
    written = ["a_b.png", "a_b.jpg.png", "a_b-2.png", "a_b.png.png"]
    written += ["a.png", "a.jpg.png", "a.jpg.png.png"]
    drawn = [cv2.imread(str(tmp_path / "drawn" / name)) for name in written]
    assert [int(picture[0, 0, 0]) for picture in drawn if picture is not None] == [*range(7)]


@pytest.mark.parametrize("name", ["a.mp4", "a.avi"])
def test_a_video_has_its_name_once_it_is_whole(tmp_path: Path, name: str) -> None:
    with ImageOutput(tmp_path / name, 10.0) as out:
        for _ in range(3):
            out.write(IMAGE, "")
        assert not (tmp_path / name).exists()
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("error", [Fault("the camera was unplugged"), KeyboardInterrupt()])
def test_a_video_ended_by_an_error_has_the_images_until_then(
    tmp_path: Path, error: BaseException
) -> None:
    out = ImageOutput(tmp_path / "a.mp4", 10.0)
    out.write(IMAGE, "")
    out.__exit__(type(error), error, None)
    capture = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 1
    capture.release()


def test_a_video_without_an_encoder_is_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.cameras.files.VIDEO_CODES", {".mp4": "none"})
    out = ImageOutput(tmp_path / "a.mp4", 10.0)
    with pytest.raises(Fault, match="cannot be written") as caught:
        out.write(IMAGE, "")
    assert "no encoder" in caught.value.why
    out.__exit__(Fault, caught.value, None)
    assert list(tmp_path.iterdir()) == []


def test_a_video_that_a_full_disk_cut_short_is_not_kept(tmp_path: Path) -> None:
    """OpenCV does not report write failures; the video's images are counted afterwards."""
    out = ImageOutput(tmp_path / "a.avi", 10.0)
    for _ in range(3):
        out.write(IMAGE, "")
    out._count = 5
    with pytest.raises(Fault, match="cannot be written") as caught:
        out.__exit__(None, None, None)
    assert "3 of 5" in caught.value.why
    assert list(tmp_path.iterdir()) == []


def test_a_video_that_was_not_finished_leaves_what_was_there(tmp_path: Path) -> None:
    (tmp_path / "a.avi").write_bytes(b"before")
    out = ImageOutput(tmp_path / "a.avi", 10.0, force=True)
    out.write(IMAGE, "")
    out.__exit__(RuntimeError, RuntimeError(), None)
    assert (tmp_path / "a.avi").read_bytes() == b"before"
    assert len(list(tmp_path.iterdir())) == 1


def test_pictures_whose_names_differ_only_in_their_ending_are_both_kept(tmp_path: Path) -> None:
    with ImageOutput(tmp_path / "drawn", 10.0) as out:
        for name in ("a.jpg", "a.png", "a.jpg"):
            out.write(IMAGE, name)
    assert sorted(p.name for p in (tmp_path / "drawn").iterdir()) == ["a.png", "a.png.png"]


GREY = IMAGE[..., 0]
SPLIT = "save each image as a file of its own"


def test_a_tiff_file_of_several_pages_is_not_used_and_the_reason_states_them(
    tmp_path: Path,
) -> None:
    """Its first page alone was used, without a word about the others."""
    stack, camera = tmp_path / "stack.tif", generic_camera((64, 48))
    cv2.imwritemulti(str(stack), [GREY, GREY + 1, GREY + 2])
    for read in (lambda: SingleCameraImages(tmp_path), lambda: list(ImageFolder(tmp_path, camera))):
        with pytest.raises(BadInput, match="none of the 1 files is a readable image") as caught:
            read()
        assert caught.value.why == f"stack.tif has 3 pages; {SPLIT}"
    with pytest.raises(BadInput, match="has 3 pages") as caught:
        VideoFile(stack, camera)
    assert SPLIT in caught.value.next_step
    cv2.imwrite(str(tmp_path / "one.TIFF"), GREY)
    folder, calibrated = ImageFolder(tmp_path, camera), SingleCameraImages(tmp_path)
    assert [frame.name for frame in folder] == list(calibrated.names) == ["one.TIFF"]
    assert folder.unused == calibrated.unused == {"stack.tif": f"has 3 pages; {SPLIT}"}
    assert len(list(VideoFile(tmp_path / "one.TIFF", camera))) == 1


def test_a_tiff_file_with_a_thumbnail_is_an_image(tmp_path: Path) -> None:
    for name, first in (("a.tif", GREY), ("b.tif", GREY.astype(np.uint16) * 16)):
        cv2.imwritemulti(str(tmp_path / name), [first, first[::4, ::4]])
        image = read_image(tmp_path / name)
        assert image is not None
        assert image.shape == GREY.shape


def directory(order: str, following: int, entries: list[tuple[int, int, int]]) -> bytes:
    """A directory of a TIFF file: tag, type (3: 16 bits, 4: 32 bits) and value of each entry."""
    body = struct.pack(f"{order}H", len(entries))
    for tag, kind, value in entries:
        body += struct.pack(f"{order}HHI{'H2x' if kind == 3 else 'I'}", tag, kind, 1, value)
    return body + struct.pack(f"{order}I", following)


def tiff(order: str, *directories: list[tuple[int, int, int]]) -> bytes:
    data = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}I", 8)
    for k, entries in enumerate(directories):
        end = len(data) + 6 + 12 * len(entries)
        data += directory(order, end if k < len(directories) - 1 else 0, entries)
    return data


WIDE, HIGH, KIND = 256, 257, 254


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("number", [3, 4])
@pytest.mark.parametrize(("kind", "pages"), [(None, 2), (0, 2), (2, 2), (1, 1), (4, 1), (5, 1)])
def test_thumbnails_and_masks_are_no_pages(
    order: str, number: int, kind: int | None, pages: int
) -> None:
    """Source: TIFF 6.0, NewSubfileType: bit 0 a reduced image, bit 1 a page, bit 2 a mask."""
    size = [(WIDE, number, 64), (HIGH, number, 48)]
    second = size if kind is None else [(KIND, 4, kind), *size]
    assert page_count(tiff(order, size, second)) == pages
    smaller = [(WIDE, number, 16), (HIGH, number, 12)]
    assert page_count(tiff(order, size, second, smaller)) == pages


def test_damaged_directories_end() -> None:
    size = [(WIDE, 3, 64), (HIGH, 3, 48)]
    whole = tiff("<", size, size)
    assert page_count(whole) == 2
    for end in range(len(whole)):
        assert page_count(whole[:end]) in (1, 2)
    for entries in ([], size):
        circle = b"II*\0" + struct.pack("<I", 8) + directory("<", 8, entries)
        assert page_count(circle) == 1
    assert page_count(IMAGE.tobytes()) == page_count(b"") == 1
