"""Textures painted ahead of their sensors' turn, some at a time, in the order in which they are asked for."""

import threading
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor

from synth.arrays import Image
from synth.pipeline.records import Workplace
from synth.pipeline.render_session import paint
from synth.scene import Sensor

TEXTURES = 8
"""That are being painted or wait to be used, at most: up to 94 MB each."""


class Textures:
    """Textures of a job's sensors.

    Args:
        place: of the job.
        painters: threads that paint.
        room: textures at a time.
    """

    def __init__(self, place: Workplace, painters: ThreadPoolExecutor, room: int = TEXTURES) -> None:
        self._place, self._painters, self._room = place, painters, room
        self._wanted: deque[tuple[Future[Image], int, Sensor]] = deque()
        self._lock = threading.Lock()

    def ask(self, sensor: int, scene: Sensor) -> "Future[Image]":
        """A sensor's texture, begun when there is room; in any thread."""
        texture: Future[Image] = Future()
        with self._lock:
            self._wanted.append((texture, sensor, scene))
            self._begin()
        return texture

    def used(self) -> None:
        """A texture that was asked for is no longer kept: there is room for another one; in any thread."""
        with self._lock:
            self._room += 1
            self._begin()

    def _begin(self) -> None:
        while self._room and self._wanted:
            self._room -= 1
            self._painters.submit(self._paint, *self._wanted.popleft())

    def _paint(self, texture: "Future[Image]", sensor: int, scene: Sensor) -> None:
        try:
            texture.set_result(paint(self._place, sensor, scene))
        except BaseException as error:  # whatever it is, it belongs to the thread that renders
            texture.set_exception(error)
