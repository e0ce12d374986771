"""`live`: the newest frames of a camera, the flow to them, and the page that shows it."""

import json
import re
import subprocess
import sys
import threading
import time
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import cv2
import numpy as np
import pytest
from dots import Turn, centres
from numpy.typing import NDArray
from textures import as_bytes, moved, table, write_video

from gelflow.baselines import named_methods
from gelflow.cli import main, prediction
from gelflow.cli.prediction import show_live
from gelflow.errors import InputError
from gelflow.files import video as video_files
from gelflow.files.exr import read_flow
from gelflow.files.video import describe, newest_frames
from gelflow.methods.fast import Fast
from gelflow.predict.live import LiveFlow, Pace, follow
from gelflow.predict.page import Page
from gelflow.predict.prediction import motion_of
from gelflow.predict.recording import Recording
from gelflow.predict.stream import Stream

FARNEBACK = named_methods(["farneback"])[0]


def video(path: Path, rate: float) -> Path:
    write_video(path, [as_bytes(moved(64, 96, shift, 0)) for shift in range(8)], rate)
    return path


@pytest.mark.parametrize("reference", ["first", "previous"])
def test_flow_leads_from_the_reference_to_each_newest_frame(tmp_path: Path, reference: str) -> None:
    path, used = video(tmp_path / "a.avi", 10.0), [0]
    for frame, found, motion, *_ in follow(FARNEBACK, str(path), reference):
        assert frame.shape == (64, 96, 3)
        expected = motion.frame - (0 if reference == "first" else used[-1])
        # The limit of test_predict for videos.
        assert np.median(found.flow[..., 0]) == pytest.approx(expected, abs=1 / 8)
        used.append(motion.frame)
    assert used[-1] == 7
    assert used == sorted(set(used))


def test_frames_that_come_while_the_caller_is_busy_are_left_out(tmp_path: Path) -> None:
    seen = []
    for index, *_ in newest_frames(str(video(tmp_path / "a.avi", 20.0))):
        seen.append(index)
        time.sleep(0.15)  # three frames' time
    assert seen == sorted(set(seen))
    assert 2 <= len(seen) < 8


class Slow:
    """Takes three frames' time."""

    name = "slow"

    def flow(self, image1: NDArray, image2: NDArray) -> NDArray:
        time.sleep(0.15)
        return FARNEBACK.flow(image1, image2)


def test_latency_and_the_frames_left_out_are_those_that_were(tmp_path: Path) -> None:
    pace, flows = Pace(), list(follow(Slow(), str(video(tmp_path / "a.avi", 20.0))))
    for flow in flows:
        pace.add(flow)
        assert flow.latency_s >= flow.motion.compute_s
    assert pace.left_out > 0
    # Frame 0 is the reference.
    assert pace.left_out + len(flows) == flows[-1].motion.frame
    median, most = (int(number) for number in re.findall(r"(\d+) ms", str(pace)))
    assert most >= median > 0
    assert f" frames/s, {pace.left_out} left out" in str(pace)


class Camera:
    """A camera that gives three frames, is gone once, and comes back with three further ones."""

    opened = 0

    def __init__(self, *_: object) -> None:
        Camera.opened += 1
        self.left = {1: 3, 3: 3}.get(Camera.opened, 0)

    def isOpened(self) -> bool:
        return self.left > 0

    def get(self, _: int) -> float:
        return -1.0

    def read(self) -> tuple[bool, NDArray | None]:
        self.left -= 1
        time.sleep(0.03)
        return (True, np.zeros((32, 32, 3), np.uint8)) if self.left >= 0 else (False, None)

    def release(self) -> None:
        self.left = 0


def test_a_camera_that_goes_away_and_comes_back_goes_on(monkeypatch) -> None:
    monkeypatch.setattr(video_files.cv2, "VideoCapture", Camera)
    monkeypatch.setattr(video_files, "RETRY_S", 0.01)
    monkeypatch.setattr(video_files, "GONE_S", 0.3)
    monkeypatch.setattr(Camera, "opened", 0)
    with pytest.warns(UserWarning, match="0: gives no more frames; waiting"):
        frames = list(newest_frames("0"))
    assert [frame[0] for frame in frames] == list(range(6))
    times = [frame[1] for frame in frames]
    assert times == sorted(set(times))
    assert Camera.opened > 3  # looked for again, and given up


def test_a_recording_has_the_files_of_predict(tmp_path: Path, capsys) -> None:
    path, out = str(video(tmp_path / "a.avi", 10.0)), tmp_path / "out"
    options = ["--method", "farneback", "--out", str(out)]
    (out / "flow").mkdir(parents=True)
    (out / "flow" / "000001.exr").write_text("somebody's")
    assert main(["live", path, *options]) == 2
    assert "does not come from this command" in capsys.readouterr().err
    (out / "flow" / "000001.exr").unlink()
    for _ in range(2):
        assert main(["live", path, *options]) == 0
    rows, flows = table(out / "motion.csv"), sorted((out / "flow").iterdir())
    assert [int(row["frame"]) for row in rows] == [int(flow.stem) for flow in flows]
    last = read_flow(flows[-1])
    assert last.sigma is not None
    assert np.median(last.flow[..., 0]) == pytest.approx(7, abs=1)
    assert not list(out.glob("*.tmp")) + list(out.glob(".*"))
    info, shown = describe(out / "overlay.mp4"), [frame for _, _, frame in video_files.frames(out / "overlay.mp4")]
    # From the first flow on; of frames left out the rate is lower, by which the last one's stay is longer.
    assert info.frames / info.frames_per_second == pytest.approx(0.1 * (8 - int(rows[0]["frame"])), abs=0.1)
    assert main(["predict", path, *options]) == 0
    assert list(table(out / "motion.csv")[0]) == list(rows[0])
    *_, (_, _, last_shown) = video_files.frames(out / "overlay.mp4")
    # Both show frame 7 and the flow to it at the scale of the largest motion; JPEG and MPEG-4 err by grey levels.
    assert np.abs(shown[-1].astype(float) - last_shown).mean() < 3


def test_writing_a_recording_takes_no_line_from_the_output(tmp_path: Path, capfd) -> None:
    recording, flow = Recording(tmp_path / "out"), dotted(3.0)
    for number in range(1, 100):
        recording.add(flow.frame, flow.found, replace(flow.motion, frame=number, time_s=number / 10))
        print(number, flush=True)
    recording.close()
    assert capfd.readouterr().out.split() == [str(number) for number in range(1, 100)]


def test_a_source_that_does_not_open_replaces_no_recording(tmp_path: Path) -> None:
    out, path = tmp_path / "out", str(video(tmp_path / "a.avi", 10.0))
    options = ["--method", "farneback", "--out", str(out), "--markers", str(out / "markers.csv")]
    assert main(["live", path, *options]) == 0
    files = {file: file.read_bytes() for file in out.rglob("*") if file.is_file()}
    assert {"markers.csv", "motion.csv", "overlay.mp4"} < {file.name for file in files}
    assert main(["live", str(tmp_path / "none.avi"), *options]) == 2
    assert {file: file.read_bytes() for file in out.rglob("*") if file.is_file()} == files
    assert main(["live", path, *options[:-2]]) == 0
    assert not (out / "markers.csv").exists()  # it would be of another run


def test_a_reader_that_is_left_ends_before_its_frames_do(tmp_path: Path) -> None:
    newest = newest_frames(str(video(tmp_path / "a.avi", 10.0)))
    others = set(threading.enumerate())
    next(newest)
    (reader,) = set(threading.enumerate()) - others
    newest.close()
    assert not reader.is_alive()  # Python would abort while it ends, if the thread came back from OpenCV then


def test_what_does_not_open_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_text("no video")
    for source in (tmp_path / "a.mp4", tmp_path / "none.mp4"):
        with pytest.raises(InputError, match=source.name):
            next(newest_frames(str(source)))


def test_a_source_of_one_frame_has_no_flow_and_a_folder_is_no_camera(tmp_path: Path) -> None:
    path = tmp_path / "a.avi"
    write_video(path, [as_bytes(moved(64, 96, 0, 0))], 10.0)
    with pytest.raises(InputError, match=r"a\.avi: fewer than two frames"):
        next(follow(FARNEBACK, str(path)))
    with pytest.raises(InputError, match="predict takes it"):
        next(newest_frames(str(tmp_path)))


def test_a_page_streams_the_newest_picture_as_a_network_camera_does() -> None:
    page, picture = Page(0), np.full((48, 64, 3), (200, 100, 50), np.uint8)
    page.show(picture)
    with urlopen(page.address, timeout=10) as answer:
        lines = [answer.readline().strip() for _ in range(4)]
        jpeg = answer.read(int(lines[2].split()[-1]))
    decoded = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(decoded.astype(int) - picture).max() <= 5
    page.close()


class Elements(HTMLParser):
    """The elements of a page that have a name, and their sources."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sources: dict[str, str | None] = {}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        if found.get("id"):
            self.sources[str(found["id"])] = found.get("src")


def dotted(shift: float) -> LiveFlow:
    """A frame of dots that moved."""
    frames = [Turn(shift=(moved, 0.0)).frame(120, 160, centres(120, 160)) for moved in (0.0, shift)]
    found, seconds, markers = Stream(Fast(), frames[0], "first", markers=True).update(frames[1])
    return LiveFlow(frames[1], found, motion_of(found, 1, "camera", 0.1, seconds), markers, seconds, 0)


def test_the_page_has_flow_sigma_and_markers() -> None:
    page, flow = Page(0), dotted(3.0)
    flow.markers[["u", "visible"]][0] = (np.nan, False)
    show_live(page, flow, "some words", 0.0)
    with urlopen(Request(page.address, headers={"Accept": "text/html"}), timeout=10) as answer:
        sources = Elements(answer.read().decode()).sources
    assert set(sources) == {"words", "flow", "sigma", "markers"}
    for name in ("flow", "sigma"):
        with urlopen(page.address + str(sources[name]), timeout=10) as answer:
            lines = [answer.readline().strip() for _ in range(4)]
            jpeg = answer.read(int(lines[2].split()[-1]))
        assert cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR) is not None
    with urlopen(f"{page.address}/state", timeout=10) as answer:
        state = json.loads(answer.read(), parse_constant=pytest.fail)
    assert state["words"] == "some words"
    assert len(state["markers"]) == flow.markers["visible"].sum() < len(flow.markers)
    assert np.median([u for _, _, _, u, *_ in state["markers"]]) == pytest.approx(3, abs=0.1)
    with pytest.raises(HTTPError, match="404"):
        urlopen(f"{page.address}/elsewhere", timeout=10)
    page.close()


BROWSER = """
import os, sys
os.environ.update(QT_QPA_PLATFORM="offscreen", QTWEBENGINE_CHROMIUM_FLAGS="--no-sandbox --disable-gpu")
from PyQt6.QtCore import QTimer, QUrl
from PyQt6.QtWebEngineWidgets import QWebEngineView
from PyQt6.QtWidgets import QApplication
NUMBERS = [
    "document.getElementById('markers').textContent.split('\\\\n').length",
    "document.getElementById('flow').naturalWidth",
    "document.getElementById('sigma').naturalWidth", "document.getElementById('words').textContent",
]
app, view, timer = QApplication(sys.argv), QWebEngineView(), QTimer()
def look(found):
    if found and all(found) and found[0] > 1:
        print(*found, sep='|', flush=True)
        os._exit(0)  # Qt takes seconds to end
timer.timeout.connect(lambda: view.page().runJavaScript(f"[{', '.join(NUMBERS)}]", look))
timer.start(200)
view.load(QUrl(sys.argv[1]))
view.show()
app.exec()
"""


def test_a_browser_shows_the_page() -> None:
    """Chromium, as the package PyQt6-WebEngine holds it, without a screen."""
    pytest.importorskip("PyQt6.QtWebEngineCore", reason="needs pip install PyQt6-WebEngine")
    page, flow, stopped = Page(0), dotted(3.0), threading.Event()

    def film() -> None:  # a browser shows a picture of a stream when the next one begins
        while not stopped.wait(0.1):
            show_live(page, flow, "some words", 0.0)

    filming = threading.Thread(target=film)
    filming.start()
    try:
        command = [sys.executable, "-c", BROWSER, page.address]
        said = subprocess.run(command, capture_output=True, text=True, timeout=60).stdout
    finally:
        stopped.set()
        filming.join()
        page.close()
    rows, wide, small, words = said.strip().split("|")
    assert int(rows) == flow.markers["visible"].sum()
    assert int(wide) > int(small) == 160
    assert words == "some words"


def test_a_stream_is_followed_over_the_network() -> None:
    page, stopped = Page(0), threading.Event()

    def film() -> None:
        for shift in range(1000):
            page.show(as_bytes(moved(64, 96, shift % 5, 0)))
            if stopped.wait(0.02):
                return

    filming = threading.Thread(target=film)
    filming.start()
    try:
        seen = [index for index, _ in zip(range(3), newest_frames(page.address), strict=False)]
    finally:
        stopped.set()
        filming.join()
        page.close()
    assert len(seen) == 3


def test_a_port_that_is_taken_or_none_is_named() -> None:
    page = Page(0)
    for port in (int(page.address.rpartition(":")[2]), 70000):
        with pytest.raises(InputError, match=f"port {port}: "):
            Page(port)
    page.close()


def test_the_command_prints_a_line_for_each_frame_and_stops_in_time(tmp_path: Path, capsys) -> None:
    path = str(video(tmp_path / "a.avi", 10.0))
    assert main(["live", path, "--method", "farneback", "--json", "--port", "0"]) == 0
    said = capsys.readouterr()
    motions = [json.loads(line) for line in said.out.splitlines()]
    assert motions[-1]["frame"] == 7
    assert motions[-1]["mean_px"] == pytest.approx(7, abs=1)
    assert "Farnebäck at http://127.0.0.1:" in said.err
    assert main(["live", path, "--method", "farneback", "--seconds", "0"]) == 0
    assert [line[:5] for line in capsys.readouterr().out.splitlines()] == ["frame"]


def test_no_frame_waits_for_the_page_to_be_drawn(tmp_path: Path, monkeypatch) -> None:
    said, finished, waited = [], threading.Event(), []

    def slow(_page: Page, _flow: LiveFlow, words: str, _scale: float) -> float:
        waited.append(finished.wait(60))
        return 1.0

    def counted(*words: object, **_: object) -> None:
        said.append(words)
        if len(said) == 3:  # the page's address, and two frames
            finished.set()

    monkeypatch.setattr(prediction, "show_live", slow)
    monkeypatch.setattr(prediction, "print", counted, raising=False)
    assert main(["live", str(video(tmp_path / "a.avi", 10.0)), "--method", "dis-fast", "--port", "0"]) == 0
    assert all(waited)
