"""A page on this machine that shows the flow of a running camera."""

import json
from collections.abc import Mapping
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
                if self.headers.get("Host", "").partition(":")[0] not in ("127.0.0.1", "localhost"):
                    self.send_error(403, "Ask for 127.0.0.1 or localhost")  # another name may be a stranger's page
                elif self.path == "/" and "text/html" in self.headers.get("Accept", ""):
                    self._send("text/html; charset=utf-8", HTML.encode())
                elif self.path == "/state":
                    self._send("application/json", page._newer_than(0)[1]["/state"])
                elif self.path in ("/", "/flow", "/sigma"):
                    self._stream("/flow" if self.path == "/" else self.path)
                else:
                    self.send_error(404)

            def _send(self, kind: str, content: bytes) -> None:
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(content)))
                self.send_header("Cache-Control", "no-store")
                self.end_headers()
                self.wfile.write(content)

            def _stream(self, name: str) -> None:
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=picture")
                self.end_headers()
                seen = 0
                with suppress(ConnectionError):
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

    def show(self, picture: Bytes3, sigma: Bytes3 | None = None, state: Mapping[str, Any] | None = None) -> None:
        """Replaces the pictures, RGB, and the state, whose numbers are finite or None."""
        shown = {f"/{name}": _jpeg(image) for name, image in (("flow", picture), ("sigma", sigma)) if image is not None}
        shown = {"/sigma": shown["/flow"], **shown, "/state": json.dumps(state or {}, allow_nan=False).encode()}
        with self._changed:
            self._shown, self._number = shown, self._number + 1
            self._changed.notify_all()

    def _newer_than(self, seen: int) -> tuple[int, dict[str, bytes]]:
        """The number of the newest pictures, and these; waits for some after those that were seen."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > seen)
            return self._number, self._shown

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


def _jpeg(picture: Bytes3) -> bytes:
    return cv2.imencode(".jpg", picture[..., ::-1])[1].tobytes()


HTML = """<!doctype html>
<meta charset="utf-8"><title>gelflow live</title>
<style>
body { font: 14px sans-serif; margin: 1em } img { max-width: 100%; display: block }
td, th { padding: 0 .6em; text-align: right } .hidden { color: #aaa }
</style>
<p id="words">waiting for a frame</p>
<img id="flow" src="/flow" alt="motion of the gel">
<p>sigma: dark where the flow is certain, bright toward 1 px, grey where it is unknown</p>
<img id="sigma" src="/sigma" alt="sigma of the flow">
<table><thead><tr><th>id<th>x<th>y<th>u<th>v<th>sigma</thead><tbody id="markers"></tbody></table>
<script>
const whole = value => value.toFixed(0);
const text = value => value === null ? "?" : value.toFixed(2);
async function update() {
  try {
    const state = await (await fetch("/state")).json();
    document.getElementById("words").textContent =
      `frame ${state.frame}: mean motion ${text(state.mean_px)} px, unknown on ${whole(100 * state.unknown)} %; ` +
      `latency ${whole(1e3 * state.latency_median_s)} ms in the median, ${whole(1e3 * state.latency_95_s)} at 95 %; ` +
      `${text(state.frames_per_s)} frames/s, ${state.left_out} left out`;
    document.getElementById("markers").replaceChildren(...state.markers.map(marker => {
      const row = document.createElement("tr");
      row.className = marker.visible ? "" : "hidden";
      row.append(...["id", "x", "y", "u", "v", "sigma"].map(name => {
        const cell = document.createElement("td");
        cell.textContent = name === "id" ? marker.id : text(marker[name]);
        return cell;
      }));
      return row;
    }));
  } catch (error) {}
  setTimeout(update, 200);
}
update();
</script>
"""
