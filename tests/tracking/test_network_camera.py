"""A camera that sends JPEG images over HTTP, read through OpenCV and FFmpeg."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count, islice

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.cameras import frame_reader
from drivers.cameras.live import LiveCamera
from model.errors import BadInput, Fault, HardwareMissing
from model.rig import Camera

WIDTH, HEIGHT = 320, 240


def jpeg(number: int, width: int = WIDTH, height: int = HEIGHT) -> bytes:
    """An image with noise, whose brightness shows its number."""
    noise = np.random.default_rng(number).normal(0.0, 4.0, (height, width))
    grey = np.clip(brightness(number) + noise, 0, 255).astype(np.uint8)
    return cv2.imencode(".jpg", grey)[1].tobytes()


def brightness(number: int) -> int:
    return 60 + 20 * (number % 7)


def half(data: bytes) -> bytes:
    return data[: len(data) // 2]


@pytest.fixture
def serve(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[Callable[[int], bytes]], str]]:
    """Serves images by number, until the client closes; gives the address."""
    monkeypatch.delenv("http_proxy", raising=False)
    servers: list[tuple[ThreadingHTTPServer, threading.Thread]] = []

    def serve(image: Callable[[int], bytes]) -> str:
        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace;boundary=frame")
                self.end_headers()
                try:
                    for number in count():
                        data = image(number)
                        head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}"
                        self.wfile.write(head.encode() + b"\r\n\r\n" + data + b"\r\n")
                except OSError:
                    pass  # the client has closed

            def log_message(self, *_: object) -> None:
                pass

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        server.daemon_threads = False  # so that closing waits for them
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        servers.append((server, thread))
        return f"http://127.0.0.1:{server.server_port}/video"

    yield serve
    for server, thread in servers:
        server.shutdown()
        server.server_close()
        thread.join()


@pytest.fixture
def small(camera: Camera) -> Camera:
    return replace(camera, width=WIDTH, height=HEIGHT)


def parts(image: NDArray[np.uint8]) -> tuple[float, float]:
    """Mean brightness of the top and bottom rows."""
    return float(image[:16].mean()), float(image[-16:].mean())


def test_a_truncated_image_is_not_completed_from_the_one_before(
    serve: Callable[[Callable[[int], bytes]], str], small: Camera
) -> None:
    """Of FFmpeg's image, the bottom would show where the platform was."""
    address = serve(lambda n: half(jpeg(n)) if n % 3 == 2 else jpeg(n))
    with LiveCamera(address, small, needs_times=False) as live:
        for _ in range(60):
            top, bottom = parts(live.read().image)
            assert top == pytest.approx(bottom, abs=3.0)
        assert live.truncated > 0


def with_gap(data: bytes) -> bytes:
    return data[: len(data) // 3] + data[len(data) // 3 + 64 :]


def restarting(number: int) -> bytes:
    """The same image with a restart marker after every 4 blocks."""
    image = cv2.imdecode(np.frombuffer(jpeg(number), np.uint8), cv2.IMREAD_GRAYSCALE)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_RST_INTERVAL, 4])[1].tobytes()


def progressive(number: int) -> bytes:
    image = cv2.imdecode(np.frombuffer(jpeg(number), np.uint8), cv2.IMREAD_GRAYSCALE)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()


END = b"\xff\xd9"
STRAY = bytes.fromhex("123456789abc")


@pytest.mark.parametrize(
    "sent",
    [
        lambda n: jpeg(n)[:-2],
        lambda n: jpeg(n)[:-2] + STRAY + END,
        lambda n: jpeg(n)[:-2] + b"\xff" + END,
        lambda n: jpeg(n) + bytes(2000),
        restarting,
        lambda n: restarting(n)[:-2],
        progressive,
    ],
    ids=["no end", "stray bytes", "fill byte", "padded", "restarts", "no end, restarts", "scans"],
)
def test_a_complete_image_is_used_as_it_is(
    serve: Callable[[Callable[[int], bytes]], str],
    small: Camera,
    capfd: pytest.CaptureFixture[str],
    sent: Callable[[int], bytes],
) -> None:
    """Some cameras omit the marker at the end, or send bytes before or after it."""
    with LiveCamera(serve(sent), small, needs_times=False) as live:
        for _ in range(20):
            frame = live.read()
            whole = np.frombuffer(jpeg(frame.number), np.uint8)
            expected = cv2.imdecode(whole, cv2.IMREAD_GRAYSCALE)
            assert np.abs(frame.image.astype(int) - expected).max() <= 4
        assert live.truncated == 0
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    "damaged",
    [
        lambda n: with_gap(jpeg(n)),
        lambda n: half(jpeg(n)) + END,
        lambda n: half(jpeg(n)) + jpeg(n + 1),
        lambda n: half(jpeg(n))[:-2] + bytes(8) + END,
        lambda n: half(restarting(n)) + END,
        lambda n: half(restarting(n)) + restarting(n)[len(restarting(n)) // 2 + 300 :],
    ],
    ids=["gap", "ended", "two", "padded", "restarts ended", "restarts lost"],
)
def test_an_image_that_lost_bytes_is_not_measured(
    serve: Callable[[Callable[[int], bytes]], str],
    small: Camera,
    capfd: pytest.CaptureFixture[str],
    damaged: Callable[[int], bytes],
) -> None:
    """The decoder would shift all that follows the gap, and complete the image in grey."""
    address = serve(lambda n: damaged(n) if n % 3 == 2 else jpeg(n))
    with LiveCamera(address, small, needs_times=False) as live:
        for _ in range(40):
            assert live.read().number % 3 != 2
        assert live.truncated > 0
    assert capfd.readouterr().err == ""


class Uneven:
    """A camera whose images come too unevenly; of each three, one is truncated."""

    def __init__(self, number: int) -> None:
        self._number, self._now = number, 0.0

    def isOpened(self) -> bool:  # noqa: N802  # as OpenCV has it
        return True

    def getBackendName(self) -> str:  # noqa: N802  # as OpenCV has it
        return "FFMPEG"

    def get(self, what: int) -> float:
        return cv2.VideoWriter.fourcc(*"MJPG") if what == cv2.CAP_PROP_FOURCC else 0.0

    def set(self, _what: int, _value: float) -> bool:
        return True

    def read(self) -> tuple[bool, NDArray[np.uint8]]:
        self._number += 1
        data = jpeg(self._number, 32, 24)
        return True, np.frombuffer(data if self._number % 3 else half(data), np.uint8)

    def release(self) -> None:
        pass

    def clock(self) -> float:
        self._now += 0.7 if self._number % 2 else 0.02
        return self._now


@pytest.mark.parametrize("first", range(6))
def test_a_camera_with_some_truncated_images_is_not_lost_for_them(first: int) -> None:
    """Whichever comes last before it counts as lost."""
    camera = Uneven(first)
    reader = frame_reader.FrameReader(lambda: camera, camera.clock)
    assert reader.newest(lambda: False) is None
    assert reader.lost == frame_reader.NOT_ON_TIME
    reader.close()


def test_a_camera_with_truncated_images_only_is_lost(
    serve: Callable[[Callable[[int], bytes]], str],
    small: Camera,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(frame_reader, "FROZEN", 0.2)
    address = serve(lambda n: half(jpeg(n)) if n >= 100 else jpeg(n))
    words = "delivered no complete image for 60 s"
    with (
        LiveCamera(address, small, needs_times=False) as live,
        pytest.raises(Fault, match=words) as caught,
    ):
        list(islice(live, 2000))
    assert "overloaded" in caught.value.why


def test_an_image_of_another_size_is_refused_whenever_it_comes(
    serve: Callable[[Callable[[int], bytes]], str], small: Camera
) -> None:
    """OpenCV would scale it to the size of the first."""
    address = serve(lambda n: jpeg(n) if n < 100 else jpeg(n, WIDTH // 2, HEIGHT // 2))
    with (
        LiveCamera(address, small, needs_times=False) as live,
        pytest.raises(BadInput, match=f"{WIDTH // 2} x {HEIGHT // 2} px"),
    ):
        list(islice(live, 2000))


@pytest.mark.parametrize("protocol", ["http", "rtsp"])
def test_an_address_that_does_not_open_is_not_looked_for_at_the_usb_port(
    small: Camera, monkeypatch: pytest.MonkeyPatch, protocol: str
) -> None:
    monkeypatch.delenv("http_proxy", raising=False)
    with pytest.raises(HardwareMissing, match="cannot be opened") as caught:
        LiveCamera(f"{protocol}://127.0.0.1:1/x", small)
    text = f"{caught.value.why} {caught.value.next_step}"
    assert "/dev/video" not in text
    assert "cable" not in text
    for word in ("address", "password", "reached", "browser", "MJPEG"):
        assert word in text


def test_an_interrupted_network_camera_is_not_looked_for_at_the_usb_port(
    serve: Callable[[Callable[[int], bytes]], str], small: Camera
) -> None:
    def image(number: int) -> bytes:
        if number == 100:
            raise ConnectionError("the server ends")
        return jpeg(number)

    with (
        LiveCamera(serve(image), small, needs_times=False) as live,
        pytest.raises(Fault, match="failed to deliver an image") as caught,
    ):
        list(islice(live, 2000))
    for word in ("USB", "single image", "lens"):
        assert word not in caught.value.why
    assert "network" in caught.value.next_step


@pytest.mark.parametrize("needs_times", [True, False])
def test_the_address_of_a_single_image_is_a_likely_cause(
    serve: Callable[[Callable[[int], bytes]], str], small: Camera, needs_times: bool
) -> None:
    """In a browser it shows the image, so that it seems right."""

    def image(number: int) -> bytes:
        if number:
            raise ConnectionError("the server ends")
        return jpeg(number)

    with pytest.raises((HardwareMissing, Fault), match="failed to deliver an image") as caught:
        list(LiveCamera(serve(image), small, needs_times=needs_times))
    assert "a single image, not of a video" in caught.value.why
    assert "lens" not in caught.value.why
    assert "browser" not in caught.value.next_step


def test_opencv_logs_nothing_while_any_camera_is_read(
    serve: Callable[[Callable[[int], bytes]], str], small: Camera
) -> None:
    """It has one log level for all cameras, and warns when one hangs, in its thread."""
    silent, before = cv2.utils.logging.LOG_LEVEL_SILENT, cv2.utils.logging.getLogLevel()
    assert before != silent
    address = serve(jpeg)
    with LiveCamera(address, small, needs_times=False):
        with LiveCamera(address, small, needs_times=False):
            assert cv2.utils.logging.getLogLevel() == silent
        assert cv2.utils.logging.getLogLevel() == silent
    assert cv2.utils.logging.getLogLevel() == before
