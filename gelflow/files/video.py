"""Frames of a video file, of a folder of images in the natural order of their names, or of a running camera.

Frames are (H, W, 3), RGB, as the decoder gives them: uint8, of images uint16, too.
"""

import math
import re
import time
import warnings
from collections.abc import Generator, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from queue import Empty, Queue
from threading import Event, Thread
from typing import Any

import cv2

from gelflow.arrays import Bytes3, Frame
from gelflow.errors import InputError
from gelflow.files.image import SUFFIXES as IMAGE_SUFFIXES
from gelflow.files.image import read_pixels
from gelflow.files.quiet import quiet

SUFFIXES = frozenset(
    {".avi", ".mp4", ".m4v", ".mov", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv", ".flv", ".ts", ".mts", ".3gp", ".ogv"}
)
COUNTED_SUFFIXES = frozenset({".avi", ".mp4", ".m4v", ".mov"})
"""Files whose headers count frames; others estimate their number from duration and rate."""
STALL_S = 10
"""A stream that gives no frame for so long is gone."""
GONE_S, RETRY_S = 30, 0.5
"""For so long a camera that is gone is waited for, and looked for so often."""
NOMINAL_RATE = 25.0
"""Frames per second of what has no rate of its own."""


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sorting key under which frame2 comes before frame10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]


def image_files(folder: Path) -> list[Path]:
    """The image files directly in a folder, in natural order; hidden files are left out."""
    found = (p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))
    return sorted((p for p in found if p.is_file()), key=lambda p: natural_key(p.name))


@dataclass(frozen=True)
class VideoInfo:
    """Number of frames that decode, their nominal rate per second, and how many more the header counts at the end."""

    frames: int
    frames_per_second: float
    lost: int = 0


def describe(path: Path) -> VideoInfo:
    """Number of frames and their rate; a folder of images has a nominal rate of 25 frames/s.

    The frames of a video are counted by decoding it. InputError where the video is missing or does not open, or the
    folder holds no image.
    """
    if path.is_dir():
        files = image_files(path)
        if not files:
            raise InputError(f"{path}: the folder holds no image ({', '.join(sorted(IMAGE_SUFFIXES))}); give one video")
        return VideoInfo(len(files), NOMINAL_RATE)
    capture = _open(path)
    rate, promised = _rate(capture), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    frames, last_s = 0, 0.0
    for frames, last_s in enumerate(_times(capture, rate), start=1):  # noqa: B007  # the last ones are what counts
        pass
    # Frames that were dropped in recording count in the header and take time, but are none. Other containers estimate.
    lost = promised - max(frames, round(last_s * rate) + 1) if path.suffix.lower() in COUNTED_SUFFIXES else 0
    return VideoInfo(frames, rate, max(0, lost))


def frames(path: Path, every: int = 1) -> Iterator[tuple[int, float | None, Frame | None]]:
    """Yields (index, time, frame) of every `every`-th frame, beginning with frame 0.

    The time is the file's time stamp in s, None for the images of a folder. A video ends at the first frame that does
    not decode. An image of a folder that cannot be read is yielded as None. InputError where the video is missing or
    does not open.
    """
    if path.is_dir():
        for index, file in enumerate(image_files(path)[::every]):
            image = None
            with suppress(InputError):
                image = read_pixels(file)
            yield index * every, None, image
        return
    capture = _open(path)
    for index, time_s in enumerate(_times(capture, _rate(capture))):
        if index % every == 0:
            with quiet():
                decoded, frame = capture.retrieve()
            if decoded:
                yield index, time_s, _rgb(frame)


def _times(capture: Any, rate: float) -> Iterator[float]:
    """Grabs one frame after the other, and yields the time of each, s; releases the video in the end."""
    last_s = -1 / rate
    try:
        while True:
            with quiet():
                if not capture.grab():
                    return
                last_s = _stamp(capture, last_s, rate)
            yield last_s
    finally:
        capture.release()


def _stamp(capture: Any, last_s: float, rate: float) -> float:
    """The time of the frame that was grabbed; without time stamps, frames follow at the nominal rate."""
    time_s = float(capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000
    return round(time_s if time_s > last_s else last_s + 1 / rate, 6)


def _rate(capture: Any) -> float:
    rate = float(capture.get(cv2.CAP_PROP_FPS))
    return rate if 1.0 <= rate <= 1000.0 else NOMINAL_RATE


Newest = tuple[int, float, Bytes3, float]
"""A frame's number, its time, s since the source was opened, its pixels, and `time.monotonic` of its arrival."""


def newest_frames(source: str) -> Generator[Newest, None, None]:
    """Yields frames of a camera, leaving out those that come while the caller is busy.

    The source is a camera's number, the address of a stream, or a video file, which is played as its time stamps say.
    A camera's frame has the time of its arrival. A camera or stream that goes away, or gives nothing for `STALL_S`, is
    opened again, with a warning; after `GONE_S` without a frame the iterator ends, as it does with a video. When it is
    closed, it waits for a frame that is being read. InputError where the source does not open or is a folder.
    """
    if Path(source).is_dir():
        raise InputError(f"{source}: a folder of images is no camera; predict takes it")
    if Path(source).is_fifo():
        raise InputError(f"{source}: is a pipe, which may never open; give a camera, a stream's address or a video")
    capture = _camera(source)
    if not capture.isOpened():
        raise InputError(
            f"{source}: it does not open; allowed are a camera's number, such as 0, a stream's address and a video file"
        )
    recorded, ends, rate = Path(source).is_file(), capture.get(cv2.CAP_PROP_FRAME_COUNT) > 0, _rate(capture)
    newest: Queue[Newest | None] = Queue()
    stopped, last = Event(), -math.inf

    def captures() -> Iterator[Any]:
        """The source, and the source again as long as it comes back."""
        nonlocal capture
        yield capture
        while not ends and time.monotonic() < last + GONE_S:
            warnings.warn(f"{source}: gives no more frames; waiting {GONE_S} s for it to come back", stacklevel=1)
            capture.release()
            if stopped.wait(RETRY_S):
                return
            capture = _camera(source)
            yield capture

    def read() -> None:
        nonlocal last
        started, time_s, numbers = time.monotonic(), -1 / rate, count()
        try:
            for each in captures():
                while (found := each.read())[0]:
                    last = time.monotonic()
                    time_s = _stamp(each, time_s, rate) if recorded else last - started
                    if stopped.wait(max(0.0, started + time_s - time.monotonic())):
                        return
                    with suppress(Empty):
                        newest.get_nowait()
                    newest.put((next(numbers), time_s, _rgb(found[1]), started + time_s))
        finally:
            capture.release()
            newest.put(None)

    reader = Thread(target=read, daemon=True)
    reader.start()
    try:
        while (found := newest.get()) is not None:
            yield found
    finally:
        stopped.set()
        reader.join(STALL_S + 1)  # Python aborts where it ends while a library's call is about to return


def _camera(source: str) -> Any:
    """A cv2.VideoCapture of a camera's number, a stream's address or a file."""
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 1000 * STALL_S, cv2.CAP_PROP_READ_TIMEOUT_MSEC, 1000 * STALL_S]
    with quiet():
        camera = int(source) if re.fullmatch(r"\d{1,4}", source) else source
        return cv2.VideoCapture(camera, cv2.CAP_ANY, limits if "://" in source else [])


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
