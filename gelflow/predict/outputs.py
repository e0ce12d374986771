"""The files that a video's or a camera's run leaves in its folder, and the overlay, which is made of the others."""

import os
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gelflow.arrays import Frame
from gelflow.errors import InputError
from gelflow.files.atomic import refuse_foreign
from gelflow.files.exr import DIRECTIONS, read_flow
from gelflow.files.image import full_range, in_unit_range, to_bytes
from gelflow.files.quiet import quiet
from gelflow.files.video import describe
from gelflow.predict.pictures import certain, draw_overlay

MAX_RATE = 600.0
"""Largest number of frames per second of an overlay."""
MOTIONS, MOTIONS_BEGIN = "motion.csv", b"mean_px,p95_px"
"""The table of motions, and what tells it from other tables."""
MARKERS, MARKERS_BEGIN = "markers.csv", b"id,frame,time_s,x"
"""The table of markers, likewise."""
OVERLAY = "overlay.mp4"


def flow_file(out: Path, index: int) -> Path:
    """The file of the flow to a frame."""
    return out / "flow" / f"{index:06d}.exr"


def earlier_flows(out: Path) -> list[Path]:
    """The flows that an earlier run left, which may have had other frames: files named by six digits or more.

    InputError where one of them, or another file that a run replaces, is somebody else's.
    """
    refuse_foreign(out / MOTIONS, MOTIONS_BEGIN, out / OVERLAY)
    refuse_foreign(out / MARKERS, MARKERS_BEGIN)
    flows = [path for path in (out / "flow").glob("*.exr") if re.fullmatch(r"[0-9]{6,}", path.stem)]
    for flow in flows:
        refuse_foreign(flow, DIRECTIONS.encode())
    return flows


def write_overlay(
    out: Path,
    frames: Iterable[tuple[int, Frame]],
    times: list[float],
    frames_per_second: float,
    scale_px: float,
    drawn: Callable[[int], None],
) -> Path:
    """Writes a video of numbered frames with the flow to each, which is read from its file; frame 0 has none.

    Each frame stays until the time of the next. `drawn` is called with each frame's number. OSError where the video
    cannot be written.
    """
    video, temporary = out / OVERLAY, out / ".overlay.part.mp4"
    places, rate = _places(times, frames_per_second)
    writer: Any = None  # OpenCV has no types
    try:
        for (index, frame), place, following in zip(frames, places, [*places[1:], places[-1] + 1], strict=True):
            flow = np.zeros((*frame.shape[:2], 2), np.float32)
            if index > 0:
                field = read_flow(flow_file(out, index))
                flow = certain(field.flow, field.sigma)
            image = in_unit_range(frame)
            picture = draw_overlay(to_bytes(full_range(image, image)[0]), flow, scale_px)
            if writer is None:
                size = (picture.shape[1], picture.shape[0])
                with quiet():
                    writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter.fourcc(*"mp4v"), rate, size)
            for _ in range(place, following):
                writer.write(np.ascontiguousarray(picture[..., ::-1]))
            drawn(index)
        with quiet():
            writer.release()
        count, arrived = places[-1] + 1, 0
        with suppress(InputError):  # OpenCV does not report a failed write (a full disk): count what arrived
            arrived = describe(temporary).frames
        if arrived != count:
            raise OSError(f"cannot write {video}: the encoder did not take all {count} frames (is the disk full?)")
        os.replace(temporary, video)
    finally:
        temporary.unlink(missing_ok=True)
    return video


def _places(times: list[float], frames_per_second: float) -> tuple[list[int], float]:
    """Numbers of the frames in a video of a constant rate, and the rate, as fine as keeps the frames apart.

    OpenCV writes no time stamps. MPEG-4 takes no rates above `MAX_RATE`, and no finer fractions.
    """
    while True:
        rate = round(min(max(frames_per_second, 1.0), MAX_RATE), 2)
        places = [round((time_s - times[0]) * rate) for time_s in times]
        if frames_per_second >= MAX_RATE or all(one < other for one, other in pairwise(places)):
            return places, rate
        frames_per_second *= 2
