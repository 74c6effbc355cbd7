"""A live camera, read by a thread that always keeps the newest picture."""

from __future__ import annotations

import threading
from collections import deque
from contextlib import suppress

import cv2

from drake_pose.camera.sources.frame_source import (
    Clock,
    FrameSource,
    SourceSpecification,
    TimedPicture,
)

FIRST_PAUSE = 0.5
"""After a failure a camera is opened again after this time [s], then after twice as much, ..."""

LONGEST_PAUSE = 10.0
"""... but never later than this [s]."""

# How long closing waits for the thread; OpenCV may hang on a network camera [s].
_PATIENCE = 2.0


class DeviceSource(FrameSource):
    """A live camera: its newest picture, with the time at which it came by the clock [s].

    A slow reader never sees old pictures: those that were not read in time are gone. A camera that
    cannot be opened or fails is reported once and opened again, after growing pauses.
    """

    def __init__(self, specification: SourceSpecification, clock: Clock) -> None:
        super().__init__(specification)
        self._clock = clock
        self._newest: deque[TimedPicture] = deque(maxlen=1)
        self._failed = False
        self._stop = threading.Event()
        self._thread = threading.Thread(
            target=self._run, name=f"camera {specification.camera}", daemon=True
        )
        self._thread.start()

    @property
    def ended(self) -> bool:
        """Whether it was closed, or gives pictures of a wrong size."""
        return self._stop.is_set()

    def close(self) -> None:
        """Ends the thread, which lets go of the camera."""
        self._stop.set()
        self._thread.join(_PATIENCE)

    def _read(self) -> TimedPicture | None:
        return self._newest.pop() if self._newest else None

    def _run(self) -> None:
        """Reads until closed; opens the camera again and again."""
        pause, count = FIRST_PAUSE, 0
        while not self.ended:
            before, capture = count, self._open()
            if capture is not None:
                count = self._keep_newest(capture, count)
                capture.release()
            if self.ended:
                return
            if not self._failed:
                what = "stopped" if count else "cannot be opened"
                self.report(
                    f"'{self.specification.location}' {what}; it is tried again until it answers"
                )
                self._failed = True
            pause = FIRST_PAUSE if count > before else pause
            self._stop.wait(pause)
            pause = min(2.0 * pause, LONGEST_PAUSE)

    def _open(self) -> cv2.VideoCapture | None:
        """The camera, asked for pictures of the calibrated size."""
        given = self.specification
        by_number = given.location.isdigit()
        with suppress(cv2.error):
            capture = cv2.VideoCapture(int(given.location) if by_number else given.location)
            if not capture.isOpened():
                return None
            if by_number:
                capture.set(cv2.CAP_PROP_FRAME_WIDTH, given.width)
                capture.set(cv2.CAP_PROP_FRAME_HEIGHT, given.height)
                if given.rate_hz is not None:
                    capture.set(cv2.CAP_PROP_FPS, given.rate_hz)
            return capture
        return None

    def _keep_newest(self, capture: cv2.VideoCapture, count: int) -> int:
        """Reads until the camera fails or is not wanted; the number of pictures in all."""
        while not self.ended:
            found, picture = False, None
            with suppress(cv2.error):
                found, picture = capture.read()
            if not found or picture is None:
                return count
            time = self._clock() + self.specification.offset
            if wrong := self.specification.wrong_size(picture):
                self.report(f"'{self.specification.location}' {wrong}")
                self._stop.set()
                return count
            if self._failed:
                self.report(f"'{self.specification.location}' answers again")
                self._failed = False
            self._newest.append(
                TimedPicture(time, f"{count:06d}", self.specification.seen(picture))
            )
            count += 1
        return count
