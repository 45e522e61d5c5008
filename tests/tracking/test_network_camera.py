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
    assert "USB" not in caught.value.why
    assert "network" in caught.value.next_step


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
