"""The newest image of a camera, for viewer programs while it measures.

The camera's process writes it to shared memory without waiting: viewers announce themselves there,
copy complete images, and miss others. The memory has no name; a viewer opens it by process and
descriptor (`ImageReader`), which the system allows only the same user and root.
"""

from __future__ import annotations

import json
import mmap
import os
import stat
import struct
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from executor.realtime.shared_memory import SharedMemory
from model.pose import Pose
from model.rig import Camera
from tracking.measurement import NoPose, Observation, PoseMeasurement

#: Shortest interval of shown images, [s]; images in between are skipped.
SHOWN_EVERY = 0.2
#: Images are shown while a viewer has read within this time, [s].
VIEWER_TIMEOUT = 1.0

_SIGN = b"cdpr-img"
#: Signature, write count (odd during a write), last read [s], frame, height, width, note length.
_HEAD = struct.Struct("<8sQdQIII")
_WRITES, _LOOKED = 8, 16
_NUMBER, _MOMENT = struct.Struct("<Q"), struct.Struct("<d")
#: Size of the note with the measurement, [bytes].
_NOTE = 2048
_PIXELS = _HEAD.size + _NOTE


@dataclass(frozen=True, slots=True, eq=False)
class LiveImage:
    """One image and its measurement.

    Attributes:
        frame: Frame number.
        image: Grey, shape (height, width).
        found: The pose without its covariance, or why there is none.
    """

    frame: int
    image: NDArray[np.uint8]
    found: Observation


def memory_for(camera: Camera) -> SharedMemory:
    """Memory for one image of a camera."""
    memory = SharedMemory.create(_PIXELS + camera.width * camera.height)
    _HEAD.pack_into(memory.view, 0, _SIGN, 0, float("-inf"), 0, 0, 0, 0)
    return memory


class ImageBoard:
    """The camera process's side: shows images at a low rate while there is a viewer."""

    def __init__(self, memory: SharedMemory) -> None:
        """Uses memory of `memory_for`."""
        self._view = memory.view
        self._pixels = np.frombuffer(memory.view, np.uint8, offset=_PIXELS)
        self._shown, self._writes = float("-inf"), 0

    def show(self, frame: int, image: NDArray[np.uint8], found: Observation) -> bool:
        """Shows an image if one is due and there is a viewer; returns whether it did."""
        now = time.monotonic()
        (looked,) = _MOMENT.unpack_from(self._view, _LOOKED)
        if now - looked > VIEWER_TIMEOUT or now - self._shown < SHOWN_EVERY:
            return False
        note = json.dumps(_noted(found)).encode()
        if image.size > self._pixels.size or len(note) > _NOTE:
            return False
        self._shown = now
        _NUMBER.pack_into(self._view, _WRITES, self._writes + 1)
        self._view[_HEAD.size : _HEAD.size + len(note)] = note
        self._pixels[: image.size] = image.reshape(-1)
        self._writes += 2
        height, width = image.shape
        head = (_SIGN, self._writes - 1, looked, frame, height, width, len(note))
        _HEAD.pack_into(self._view, 0, *head)
        _NUMBER.pack_into(self._view, _WRITES, self._writes)
        return True


def _noted(found: Observation) -> dict[str, Any]:
    if isinstance(found, NoPose):
        return {"time": found.time, "reason": found.reason[:200]}
    return {
        "time": found.time,
        "position": found.pose.position.tolist(),
        "quaternion": found.pose.quaternion.tolist(),
        "tags": list(found.tags),
    }


class ImageReader:
    """The viewer's side, in another process."""

    def __init__(self, process: int, descriptor: int) -> None:
        """Opens the memory of a process.

        Args:
            descriptor: Of the memory there; see ``live_image`` in `executor.remote.status`.

        Raises:
            OSError: It does not exist any more, or is not such memory.
        """
        path = f"/proc/{int(process)}/fd/{int(descriptor)}"
        opened = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            about = os.fstat(opened)
            if not stat.S_ISREG(about.st_mode) or about.st_size <= _PIXELS:
                raise OSError("not an image")
            self._view = mmap.mmap(opened, about.st_size)
        finally:
            os.close(opened)
        if self._view[: len(_SIGN)] != _SIGN:
            self._view.close()
            raise OSError("not an image")
        self._seen = 0

    def close(self) -> None:
        """Closes the memory."""
        self._view.close()

    def newest(self) -> LiveImage | None:
        """The newest image; None if already read, or being written."""
        _MOMENT.pack_into(self._view, _LOOKED, time.monotonic())
        _, writes, _, frame, height, width, length = _HEAD.unpack_from(self._view)
        if writes == self._seen or writes % 2:
            return None
        if length > _NOTE or _PIXELS + height * width > len(self._view):
            return None
        note = bytes(self._view[_HEAD.size : _HEAD.size + length])
        pixels = bytes(self._view[_PIXELS : _PIXELS + height * width])
        if _NUMBER.unpack_from(self._view, _WRITES)[0] != writes:
            return None
        self._seen = writes
        image = np.frombuffer(pixels, np.uint8).reshape(height, width)
        return LiveImage(frame, image, _found(json.loads(note)))


def _found(note: dict[str, Any]) -> Observation:
    if "reason" in note:
        return NoPose(note["time"], note["reason"])
    pose = Pose.from_quaternion(np.array(note["position"]), np.array(note["quaternion"]))
    return PoseMeasurement(
        note["time"], pose, np.zeros((6, 6)), tuple(note["tags"]), float("nan"), "tracked"
    )
