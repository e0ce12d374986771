"""Frames of a video file, of a folder of images in the natural order of their names, or of a running camera.

Frames are (H, W, 3) uint8, RGB, as the decoder gives them.
"""

import re
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from queue import Empty, Queue
from threading import Event, Thread
from typing import Any

import cv2

from gelflow.arrays import Bytes3
from gelflow.errors import InputError
from gelflow.files.image import SUFFIXES as IMAGE_SUFFIXES
from gelflow.files.image import read_image, to_bytes
from gelflow.files.quiet import quiet

SUFFIXES = frozenset({".avi", ".mp4", ".m4v", ".mov", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv"})


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sorting key under which frame2 comes before frame10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]


def image_files(folder: Path) -> list[Path]:
    """The image files directly in a folder, in natural order; hidden files are left out."""
    found = (p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))
    return sorted((p for p in found if p.is_file()), key=lambda p: natural_key(p.name))


@dataclass(frozen=True)
class VideoInfo:
    """Number of frames and their rate per second. Of a damaged video fewer frames may decode."""

    frames: int
    frames_per_second: float


def describe(path: Path) -> VideoInfo:
    """Number of frames and their rate; a folder of images has a nominal rate of 25 frames/s.

    The number is the header's; where the header does not know it, frames are counted. InputError where the video is
    missing or does not open, or the folder holds no image.
    """
    if path.is_dir():
        files = image_files(path)
        if not files:
            raise InputError(f"{path}: the folder holds no image ({', '.join(sorted(IMAGE_SUFFIXES))}); give one video")
        return VideoInfo(len(files), 25.0)
    capture = _open(path)
    with quiet():
        count, rate = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), float(capture.get(cv2.CAP_PROP_FPS))
        if count < 1:
            count = 0
            while capture.grab():
                count += 1
        capture.release()
    return VideoInfo(count, rate if 1.0 <= rate <= 1000.0 else 25.0)


def frames(path: Path, every: int = 1) -> Iterator[tuple[int, Bytes3 | None]]:
    """Yields (index, frame) of every `every`-th frame, beginning with frame 0.

    A video ends at the first frame that does not decode. An image of a folder that cannot be read is yielded as None.
    InputError where the video is missing or does not open.
    """
    if path.is_dir():
        for index, file in enumerate(image_files(path)):
            if index % every == 0:
                image = None
                with suppress(InputError):
                    image = to_bytes(read_image(file))
                yield index, image
        return
    capture = _open(path)
    index = 0
    try:
        while True:
            frame = None
            with quiet():
                decoded = capture.grab()
                if decoded and index % every == 0:
                    decoded, frame = capture.retrieve()
            if not decoded:
                return
            if frame is not None:
                yield index, _rgb(frame)
            index += 1
    finally:
        capture.release()


def newest_frames(source: str) -> Iterator[tuple[int, Bytes3]]:
    """Yields (index, frame) of a camera, leaving out the frames that come while the caller is busy.

    The source is a camera's number, the address of a stream, or a video file, which is played at its own rate. The
    iterator ends with it. InputError where it does not open or is a folder.
    """
    if Path(source).is_dir():
        raise InputError(f"{source}: a folder of images is no camera; predict takes it")
    if Path(source).is_fifo():
        raise InputError(f"{source}: is a pipe, which may never open; give a camera, a stream's address or a video")
    with quiet():
        capture = cv2.VideoCapture(int(source) if re.fullmatch(r"\d{1,4}", source) else source)
    if not capture.isOpened():
        raise InputError(
            f"{source}: it does not open; allowed are a camera's number, such as 0, a stream's address and a video file"
        )
    interval = 1 / describe(Path(source)).frames_per_second if Path(source).is_file() else 0.0
    newest: Queue[tuple[int, Bytes3] | None] = Queue()
    stopped = Event()

    def read() -> None:
        started = time.monotonic()
        try:
            for index in count():
                decoded, frame = capture.read()
                if not decoded or stopped.is_set():
                    return
                with suppress(Empty):
                    newest.get_nowait()
                newest.put((index, _rgb(frame)))
                stopped.wait(max(0.0, started + (index + 1) * interval - time.monotonic()))
        finally:
            capture.release()
            newest.put(None)

    Thread(target=read, daemon=True).start()  # not waited for: a stalled stream keeps it for half a minute
    try:
        while (found := newest.get()) is not None:
            yield found
    finally:
        stopped.set()


def _rgb(frame: Any) -> Bytes3:
    """OpenCV's frame, BGR or grey."""
    return frame[..., None].repeat(3, axis=2) if frame.ndim == 2 else frame[..., ::-1].copy()


def frame_file(path: Path, index: int) -> Path:
    """The file that holds a frame: one of a folder's images, or the video."""
    return image_files(path)[index] if path.is_dir() else path


def _open(path: Path) -> Any:  # a cv2.VideoCapture; OpenCV has no types
    if not path.is_file():
        raise InputError(f"{path}: there is no such video")
    with quiet():
        capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise InputError(f"{path}: the video does not open (not a video, or truncated or damaged)")
    return capture
