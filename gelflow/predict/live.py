"""Flow of a running camera, and a page that shows it."""

from collections.abc import Generator
from contextlib import closing, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Condition, Thread
from typing import Any, NamedTuple

import cv2
from numpy.typing import NDArray

from gelflow.arrays import Bytes3, Estimate
from gelflow.baselines.method import Method
from gelflow.errors import InputError
from gelflow.files.image import full_range, in_unit_range, to_bytes
from gelflow.files.video import newest_frames
from gelflow.predict.prediction import Motion, motion_of
from gelflow.predict.stream import Reference, Stream


class LiveFlow(NamedTuple):
    """The newest frame, the flow that leads to it, its motion, and the markers, if they were asked for."""

    frame: Bytes3
    found: Estimate
    motion: Motion
    markers: NDArray[Any] | None


def follow(
    method: Method, source: str, reference: Reference = "first", markers: bool = False
) -> Generator[LiveFlow, None, None]:
    """Yields the flow to each newest frame, from the first frame or from the one that was used before.

    The source is as `newest_frames` takes it. InputError where it does not open or gives fewer than two frames, its
    frames change their size, or the method cannot use them.
    """
    stream: Stream | None = None
    used = 0
    with closing(newest_frames(source)) as newest:
        for index, time_s, frame in newest:
            used += 1
            try:
                if stream is None:
                    stream = Stream(method, frame, reference, markers)
                    continue
                found, seconds, moved = stream.update(frame)
            except InputError as error:
                raise InputError(f"{source}, frame {index}, {method.name}: {error}") from error
            image = in_unit_range(frame)
            motion = motion_of(found, index, source, time_s, seconds)
            yield LiveFlow(to_bytes(full_range(image, image)[0]), found, motion, moved)
    if used < 2:
        raise InputError(f"{source}: fewer than two frames came; does another program use the camera?")


class Page:
    """Serves the newest picture to browsers of this machine, as a stream of JPEG images."""

    def __init__(self, port: int) -> None:
        """InputError where the port, 0 for any free one, is taken or no port."""
        self._jpeg, self._number, self._changed = b"", 0, Condition()
        page = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if self.headers.get("Host", "").partition(":")[0] not in ("127.0.0.1", "localhost"):
                    self.send_error(403, "Ask for 127.0.0.1 or localhost")  # another name may be a stranger's page
                    return
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=picture")
                self.end_headers()
                seen = 0
                with suppress(ConnectionError):
                    while True:
                        seen, jpeg = page._newer_than(seen)
                        head = f"--picture\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                        self.wfile.write(head.encode() + jpeg + b"\r\n")

            def log_message(self, *_: object) -> None:
                """Nothing is logged."""

        try:
            self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        except (OSError, OverflowError) as error:
            raise InputError(f"port {port}: {error}") from None
        Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self._server.server_port}"

    def show(self, picture: Bytes3) -> None:
        """Replaces the picture, RGB."""
        jpeg = cv2.imencode(".jpg", picture[..., ::-1])[1].tobytes()
        with self._changed:
            self._jpeg, self._number = jpeg, self._number + 1
            self._changed.notify_all()

    def _newer_than(self, seen: int) -> tuple[int, bytes]:
        """The number of the newest picture, and the picture; waits for one after those that were seen."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > seen)
            return self._number, self._jpeg

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
