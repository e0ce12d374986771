"""A page on this machine that shows the flow of a running camera."""

import json
from collections.abc import Sequence
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Condition, Thread
from typing import Any

import cv2

from gelflow.arrays import Bytes3
from gelflow.errors import InputError


class Page:
    """Serves the newest pictures to browsers of this machine.

    `/` is a page with all of it; to whom does not ask for HTML, and at `/flow` and `/sigma`, pictures are a stream of
    JPEG images, as network cameras send it. `/state` is what `show` was given beside them, as JSON.
    """

    def __init__(self, port: int) -> None:
        """InputError where the port, 0 for any free one, is taken or no port."""
        self._shown: dict[str, bytes] = {}
        self._number, self._changed = 0, Condition()
        page = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                name = "/flow" if self.path == "/" else self.path
                if self.headers.get("Host", "").partition(":")[0] not in ("127.0.0.1", "localhost"):
                    self.send_error(403, "Ask for 127.0.0.1 or localhost")  # another name may be a stranger's page
                elif self.path == "/" and "text/html" in self.headers.get("Accept", ""):
                    self._begin("text/html; charset=utf-8")
                    self.wfile.write(HTML.encode())
                elif name == "/state":
                    self._begin("application/json")
                    self.wfile.write(page._newer_than(0)[1][name])
                elif name in ("/flow", "/sigma"):
                    self._begin("multipart/x-mixed-replace; boundary=picture")
                    with suppress(ConnectionError):
                        self._stream(name)
                else:
                    self.send_error(404)

            def _begin(self, kind: str) -> None:
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.end_headers()

            def _stream(self, name: str) -> None:
                seen = 0
                while True:
                    seen, shown = page._newer_than(seen)
                    head = f"--picture\r\nContent-Type: image/jpeg\r\nContent-Length: {len(shown[name])}\r\n\r\n"
                    self.wfile.write(head.encode() + shown[name] + b"\r\n")

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

    def show(self, picture: Bytes3, sigma: Bytes3 | None = None, words: str = "", markers: Sequence[Any] = ()) -> None:
        """Replaces the pictures, RGB, a line of words, and the markers, whose fields are finite."""
        state = {"words": words, "markers": markers}
        jpegs = [cv2.imencode(".jpg", each[..., ::-1])[1].tobytes() for each in (picture, sigma) if each is not None]
        with self._changed:
            self._shown = {"/flow": jpegs[0], "/sigma": jpegs[-1], "/state": json.dumps(state).encode()}
            self._number += 1
            self._changed.notify_all()

    def _newer_than(self, seen: int) -> tuple[int, dict[str, bytes]]:
        """The number of the newest pictures, and these; waits for some after those that were seen."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > seen)
            return self._number, self._shown

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


HTML = """<!doctype html>
<meta charset="utf-8"><title>gelflow live</title>
<p id="words">waiting for a frame</p>
<img id="flow" src="/flow" alt="motion of the gel">
<p>sigma: dark where the flow is certain, bright toward 1 px, grey where it is unknown</p>
<img id="sigma" src="/sigma" alt="sigma of the flow">
<p>markers that are seen: id; x, y, u, v and sigma in px</p>
<pre id="markers"></pre>
<script>
const numbers = ([id, ...rest]) => [id, ...rest.map(value => value.toFixed(2))].join("\\t");
setInterval(async () => {
  const state = await (await fetch("/state")).json();
  document.getElementById("words").textContent = state.words;
  document.getElementById("markers").textContent = state.markers.map(numbers).join("\\n");
}, 200);
</script>
"""
