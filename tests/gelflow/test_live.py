"""`live`: the newest frames of a camera, the flow to them, and the page that shows it."""

import json
import threading
import time
from pathlib import Path
from urllib.request import urlopen

import cv2
import numpy as np
import pytest
from textures import as_bytes, moved, write_video

from gelflow.baselines import named_methods
from gelflow.cli import main
from gelflow.errors import InputError
from gelflow.files.video import newest_frames
from gelflow.predict.live import Page, follow

FARNEBACK = named_methods(["farneback"])[0]


def video(path: Path, rate: float) -> Path:
    write_video(path, [as_bytes(moved(64, 96, shift, 0)) for shift in range(8)], rate)
    return path


@pytest.mark.parametrize("reference", ["first", "previous"])
def test_flow_leads_from_the_reference_to_each_newest_frame(tmp_path: Path, reference: str) -> None:
    path, used = video(tmp_path / "a.avi", 10.0), [0]
    for frame, found, motion, _ in follow(FARNEBACK, str(path), reference):
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
