"""Textures painted ahead of their sensors' turn, some at a time, in the order in which they are asked for."""

import threading
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor

from synth.arrays import Image
from synth.pipeline.records import JobContext
from synth.pipeline.render_session import paint
from synth.scene import Sensor

TEXTURES = 8
"""That are being painted or wait to be used, at most: up to 94 MB each."""


class Textures:
    """Textures of a job's sensors, painted by the given threads; so many at a time are painted or wait to be used."""

    def __init__(self, context: JobContext, threads: ThreadPoolExecutor, room: int = TEXTURES) -> None:
        self._context, self._threads, self._room = context, threads, room
        self._wanted: deque[tuple[Future[Image], int, Sensor]] = deque()
        self._lock = threading.Lock()

    def request(self, number: int, sensor: Sensor) -> "Future[Image]":
        """The texture of a sensor, by its number, begun when there is room; in any thread."""
        texture: Future[Image] = Future()
        with self._lock:
            self._wanted.append((texture, number, sensor))
            self._begin()
        return texture

    def release(self) -> None:
        """A texture that was requested is no longer held: there is room for another one; in any thread."""
        with self._lock:
            self._room += 1
            self._begin()

    def _begin(self) -> None:
        while self._room and self._wanted:
            self._room -= 1
            self._threads.submit(self._paint, *self._wanted.popleft())

    def _paint(self, texture: "Future[Image]", number: int, sensor: Sensor) -> None:
        try:
            texture.set_result(paint(self._context, number, sensor))
        except BaseException as error:  # whatever it is, it belongs to the thread that renders
            texture.set_exception(error)
