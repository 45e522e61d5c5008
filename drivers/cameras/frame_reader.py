"""The newest image of a camera that delivers them faster than they are used.

Images wait in queues of the network, the driver and the decoder. A reader slower than the camera
would measure ever older images, so a thread reads all of them and keeps the last.

After a pause of the network or the computer those that waited come in quick succession. If the
driver states when it received them, it is known how long each waited. Otherwise they are skipped:
none gets the present time.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from model.files.reading import jpeg_segments

#: Consecutive failed reads after which a camera counts as lost.
LOST_IMAGES = 5
#: The same without a new image on time for this long, [s]. A video codec may repeat an image of a
#: platform at rest up to its next complete one, for 10 s and more.
FROZEN = 60.0
#: Longest wait for the reading thread when closing, and interval of checks for a stop, [s].
END_TIMEOUT, ROUND = 2.0, 0.1
NOT_OPENED = "cannot be opened"
NOT_ON_TIME = f"delivered no image on time for {FROZEN:g} s"
TRUNCATED = f"delivered no complete image for {FROZEN:g} s"
SAME = f"delivered the same image for {FROZEN:g} s"
"""Why a camera delivers no images, as a predicate."""


@dataclass(frozen=True, slots=True, eq=False)
class Arrived:
    """An image as delivered.

    Attributes:
        number: Number of the camera's image from 0, including skipped ones.
        time: When it arrived, or would have without waiting, on the reader's clock, [s].
        picture: As the camera delivered it.
    """

    number: int
    time: float
    picture: NDArray[np.generic]


# Which images came on time, if it is unknown when the driver received each, only when it was read.


#: Largest lateness of an image on time, [s]: a platform at 20 mm/s moves 1 mm meanwhile. Network,
#: driver and scheduler delay single images by 10 to 40 ms.
TOLERANCE = 0.05
#: Images of this long after the first are skipped, [s]. To find a stream's format, FFmpeg stores up
#: to 5 s of images, which then come as fast as they are decoded, mostly within 1 s.
START = 2.0
#: Images come evenly if at least so many intervals, lasting at least so long [s], differ by at most
#: twice `TOLERANCE`: a single pause, or an image decoded slowly among ones that waited, is no pace.
#: With less tolerance no image would be used of a camera at 15 Hz that loses every third image, or
#: of one at 30 Hz whose images come in threes.
EVEN_INTERVALS, EVEN_TIME = 3, 0.25
#: At a shorter share of the usual interval, images that waited are being read. Also so much of the
#: usual interval counts for each image skipped: the camera may have lost others before.
DRAINING = 0.9
#: The usual interval is the mean over this long, [s]: the times of the images that waited are
#: predicted from it, to `TOLERANCE` for some seconds, and it follows a change of the exposure.
USUAL_TIME = 5.0


class ArrivalSchedule:
    """Judges by their arrivals which images of a camera came on time.

    An image is on time if it came at most `TOLERANCE` after it was due: one usual interval after
    the last one on time was due, and `DRAINING` of it more for each image skipped between them. If
    there are any, the reader must also have waited for it, for half the usual interval.

    Otherwise it may have waited, until images come evenly and not faster than usual: then none
    waits. So the camera may lose images, or take fewer per second. If it takes more, images are
    early, and on time; that is the new usual interval once they come evenly.

    A network or decoder that delivers fewer images per second than the camera takes looks like a
    camera that takes fewer: its images count as on time, though they are ever later, also while
    they catch up.
    """

    def __init__(self) -> None:
        self._number, self._begin, self._due = -1, 0.0, 0.0
        self._recent: deque[float] = deque()
        self._on_time: deque[tuple[int, float]] = deque()

    def is_on_time(self, now: float) -> bool:
        """Takes the arrival of the next image, [s]; returns whether it did not wait before."""
        self._number += 1
        self._begin = self._begin if self._number else now
        recent = self._recent
        recent.append(now)
        while len(recent) > EVEN_INTERVALS + 1 and now - recent[1] >= EVEN_TIME:
            recent.popleft()
        intervals = [after - before for before, after in pairwise(recent)]
        is_even = (
            len(intervals) >= EVEN_INTERVALS
            and now - recent[0] >= EVEN_TIME
            and max(intervals) - min(intervals) <= 2.0 * TOLERANCE
        )
        if self._on_time:
            least = DRAINING * self._usual * len(intervals)
            is_faster = now - recent[0] < least
            if self._is_due(now, intervals[-1]):
                if is_even and is_faster:
                    self._restart()
                return True
            if is_faster:
                return False
        if is_even and now - self._begin >= START:
            self._restart()
            self._due = now
            return True
        return False

    @property
    def _usual(self) -> float:
        """Mean interval of the images on time, [s]."""
        (first, began), (last, ended) = self._on_time[0], self._on_time[-1]
        return (ended - began) / (last - first)

    def _is_due(self, now: float, interval: float) -> bool:
        """Whether an image came when due, or before; if so it is the last one on time."""
        usual, skipped = self._usual, self._number - self._on_time[-1][0] - 1
        due = self._due + usual * (1.0 + DRAINING * skipped)
        if now - due > TOLERANCE:
            return False
        # If the camera now takes more, images seem to catch up too soon, and are ever
        # earlier; so that none is skipped for ever, those `START` before they are due count.
        if skipped and interval < usual / 2.0 and due - now < START:
            return False
        self._due = min(now, due)
        self._on_time.append((self._number, now))
        while len(self._on_time) > EVEN_INTERVALS + 1 and now - self._on_time[1][1] > USUAL_TIME:
            self._on_time.popleft()
        return True

    def _restart(self) -> None:
        """Takes the pace of the last images as the usual one."""
        self._on_time = deque(enumerate(self._recent, self._number + 1 - len(self._recent)))


#: The images of this long have the least age in common, [s]; meanwhile two clocks drift apart by a
#: few milliseconds.
AGE_TIME = 60.0


class DriverTimes:
    """Times of a camera's images from those that its driver states, on any clock.

    The age of an image is its arrival less its stated time. It is least for images that did not
    wait, so the excess over the least age of the last `AGE_TIME` is how long an image waited.

    A driver whose times once do not rise states none.
    """

    def __init__(self) -> None:
        self._begin: float | None = None
        self._stated, self._is_rising = 0.0, True
        self._ages: deque[tuple[float, float]] = deque()  # arrivals and ages, both rising

    def time(self, now: float, stated: float) -> float | None:
        """When an image would have arrived without waiting, later for each image, [s].

        Args:
            now: Its arrival, [s].
            stated: Its time on the driver's clock, [s].

        Returns:
            None if the driver states no times, and for `START` after the first image.
        """
        self._begin = now if self._begin is None else self._begin
        self._is_rising = self._is_rising and stated > self._stated
        self._stated = stated
        if not self._is_rising:
            return None
        age = now - stated
        while self._ages and self._ages[-1][1] >= age:
            self._ages.pop()
        self._ages.append((now, age))
        while now - self._ages[0][0] > AGE_TIME:
            self._ages.popleft()
        if now - self._begin < START:
            return None
        return now - (age - self._ages[0][1])


class CopyCheck:
    """Recognizes images that are copies of the one before, to the bit.

    These are not new ones: noise makes images of a camera differ, but a decoder or driver that
    hangs may repeat its last one, and a recorder or converter the one before a lost one.

    Attributes:
        count: Number of copies so far.
    """

    def __init__(self) -> None:
        self.count = 0
        self._last: NDArray[np.generic] | None = None

    def is_copy(self, picture: NDArray[np.generic]) -> bool:
        """Takes the next image; a few of its rows suffice for most that are not copies."""
        last, self._last = self._last, picture
        is_copy = (
            last is not None
            and np.array_equal(picture[::64], last[::64])
            and np.array_equal(picture, last)
        )
        self.count += is_copy
        return is_copy


class _OpencvLog:
    """The log of OpenCV, of which a process has one."""

    def __init__(self) -> None:
        self._lock, self._holders, self._level = threading.Lock(), 0, 0

    @contextmanager
    def silent(self) -> Iterator[None]:
        """Keeps OpenCV's warnings, which mean nothing to an operator, from the terminal."""
        logging = cv2.utils.logging
        with self._lock:
            if not self._holders:
                self._level = logging.getLogLevel()
                logging.setLogLevel(logging.LOG_LEVEL_SILENT)
            self._holders += 1
        try:
            yield
        finally:
            with self._lock:
                self._holders -= 1
                if not self._holders:
                    logging.setLogLevel(self._level)


silent_opencv = _OpencvLog().silent


class FrameReader:
    """Opens a camera and reads all its images in a thread, in which OpenCV logs nothing.

    Images that waited in a queue are skipped, unless the driver states their times, and so are
    copies and truncated images.

    Attributes:
        lost: Why the camera delivers no more, as a predicate of it.
        late: Number of images skipped as they may have waited, since the first on time.
        truncated: Number of truncated images since then.
    """

    def __init__(
        self,
        opened: Callable[[], cv2.VideoCapture],
        clock: Callable[[], float],
        *,
        needs_times: bool = True,
    ) -> None:
        """Starts the thread.

        Args:
            opened: Opens the camera, called by the thread: it may take half a minute.
            clock: Monotonic time, [s].
            needs_times: Skips images that may have waited for an unknown time.
        """
        self._opened, self._clock, self._needs_times = opened, clock, needs_times
        self._changed = threading.Condition()
        self._newest: Arrived | None = None
        self.lost, self.late, self.truncated = "", 0, 0
        self._ended = self._is_closing = False
        self._thread = threading.Thread(target=self._read, name="cdpr-pictures", daemon=True)
        self._thread.start()

    def newest(self, stopped: Callable[[], bool]) -> Arrived | None:
        """Waits for the newest image on time that was not returned before.

        Args:
            stopped: Called repeatedly; True ends the wait.

        Returns:
            None once the camera delivers no more, or the wait was ended.
        """
        with self._changed:
            while not self._changed.wait_for(lambda: self._newest or self._ended, ROUND):
                if stopped():
                    break
            newest, self._newest = self._newest, None
            return newest

    def close(self) -> None:
        """Stops the thread; a hanging camera keeps it until this process ends."""
        self._is_closing = True
        if threading.current_thread() is not self._thread:
            self._thread.join(END_TIMEOUT)

    def _read(self) -> None:
        try:
            with silent_opencv():
                capture = self._opened()
                try:
                    self._read_all(capture)
                finally:
                    capture.release()
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def _read_all(self, capture: cv2.VideoCapture) -> None:
        """Puts each image of a camera until that is lost, or this closed."""
        number, failed = -1, 0
        copies, schedule, driver_times = CopyCheck(), ArrivalSchedule(), DriverTimes()
        used = complete = new = self._clock()  # when the last of each kind came
        is_used = False
        self.lost = "" if capture.isOpened() else NOT_OPENED
        decoded = _decoded_jpeg if not self.lost and _delivers_jpeg(capture) else np.asarray
        while not (self.lost or self._is_closing):
            good, picture = capture.read()
            now = self._clock()
            failed = 0 if good else failed + 1
            if failed == LOST_IMAGES:
                self.lost = f"failed to deliver an image {LOST_IMAGES} times in a row"
            if not good:
                continue
            number += 1
            time = driver_times.time(now, _stated_time(capture))
            is_on_time = schedule.is_on_time(now) or time is not None or not self._needs_times
            image = decoded(picture)
            if image is None:
                self.truncated += is_used
            else:
                complete, is_copy = now, copies.is_copy(image)
                new = new if is_copy else now
                self.late += is_used and not is_on_time
                if is_on_time and not (is_copy and is_used):
                    is_used, used = True, now
                    self._put(Arrived(number, now if time is None else time, image))
            if now <= used + FROZEN:
                continue
            if now > complete + FROZEN:
                self.lost = TRUNCATED
            else:
                self.lost = SAME if now > new + FROZEN else NOT_ON_TIME

    def _put(self, arrived: Arrived) -> None:
        with self._changed:
            self._newest = arrived
            self._changed.notify_all()


_MJPEG = cv2.VideoWriter.fourcc(*"MJPG")


def _delivers_jpeg(capture: cv2.VideoCapture) -> bool:
    """Makes a camera whose images FFmpeg receives as JPEG deliver them undecoded.

    FFmpeg would leave the missing part of a truncated image as it was in the one before, and OpenCV
    scale an image of another size to that of the first.
    """
    return (
        capture.getBackendName() == "FFMPEG"
        and capture.get(cv2.CAP_PROP_FOURCC) == _MJPEG
        and capture.set(cv2.CAP_PROP_FORMAT, -1)
    )


#: The decoder reads up to this many bytes ahead, and waits for them before the last block. Zeros
#: are less than a block with the standard Huffman tables.
AHEAD = 8
#: Markers of JPEG files: the first of those that restart the decoder, and their number, after which
#: they begin again; a sequential Huffman-coded image; a scan. Source: ITU-T T.81, table B.1.
_RESTART, _RESTARTS, _SEQUENTIAL, _SCAN = 0xD0, 8, (0xC0, 0xC1), 0xDA


def _decoded_jpeg(data: NDArray[np.generic]) -> NDArray[np.generic] | None:
    """The grey image in the data of a JPEG file; None if it is truncated.

    At the marker that ends an image, the decoder completes one of which bytes are missing, and
    prints a warning. Without that marker, which some cameras omit, it runs out of data. It needs
    the marker for an image of several scans, such as a progressive one.
    """
    file = np.asarray(data, np.uint8).ravel()
    begin = _single_scan(file)
    if begin:
        found = begin + np.flatnonzero(file[begin:-1] == 0xFF)
        kinds = file[found + 1]
        restarts = (kinds >= _RESTART) & (kinds < _RESTART + _RESTARTS)
        ends = found[(kinds != 0) & (kinds != 0xFF) & ~restarts]  # 0: a byte of data
        end = ends[0] if ends.size else len(file)
        order = kinds[restarts & (found < end)]
        if not np.array_equal(order, _RESTART + np.arange(len(order)) % _RESTARTS):
            return None
        file = np.concatenate([file[:end], np.zeros(AHEAD, np.uint8)])
    try:
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        return cv2.imdecode(file, flags)
    except cv2.error:  # no data, or a size beyond its limit
        return None


def _single_scan(file: NDArray[np.uint8]) -> int:
    """Where the scan of a sequential JPEG file begins; 0 if it has several, or is another file."""
    components = 0
    for marker, at in jpeg_segments(file.data):
        if at + 8 > len(file):
            break
        if marker in _SEQUENTIAL:
            components = file[at + 7]
        if marker == _SCAN:
            after = at + int.from_bytes(file[at : at + 2].tobytes())
            return after if file[at + 2] == components else 0
    return 0


def _stated_time(capture: cv2.VideoCapture) -> float:
    """When the driver received the image last read, on its clock, [s]; 0 if it is unknown.

    Source: OpenCV, `modules/videoio/src/cap_v4l.cpp`: the time stamp of the V4L2 buffer. Other
    interfaces state the position in a stream.
    """
    if capture.getBackendName() != "V4L2":
        return 0.0
    return capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
