"""Flow of pairs of images or of a video, written as EXR, Middlebury .flo and pictures."""

import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import astuple, dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.arrays import Estimate, FlowArray, Frame
from gelflow.data.pairs import PairDataset
from gelflow.data.record import PairRecord
from gelflow.errors import InputError
from gelflow.files.atomic import refuse_foreign, write_csv
from gelflow.files.exr import DIRECTIONS, read_flow, write_flo, write_flow
from gelflow.files.image import shown
from gelflow.files.quiet import quiet
from gelflow.files.video import describe, frame_file, frames, image_files
from gelflow.methods.method import Method, estimated
from gelflow.models.working_size import unknown_px
from gelflow.predict.pictures import certain, draw_overlay, robust_scale, write_flow_picture
from gelflow.predict.stream import Indexed, Reference, followed
from gelflow.track.markers import marker_rows, marker_table

MAX_RATE = 600.0
"""Largest number of frames per second of an overlay."""
MOTIONS, MOTIONS_BEGIN = "motion.csv", b"mean_px,p95_px"
"""The table of motions, and what tells it from other tables."""
MARKERS, MARKERS_BEGIN = "markers.csv", b"id,frame,time_s,x"
"""The table of markers, likewise."""
OVERLAY = "overlay.mp4"


@dataclass(frozen=True)
class Motion:
    """Length of the flow, its mean and percentiles over the picture, and the method's run time.

    `frame` is that of a video, or the number of a pair from 1 on; `time_s` is when the video or camera says that it
    was, None for files of images. `unknown` is the share of the picture in which sigma is above
    `gelflow.models.working_size.unknown_px`.
    """

    frame: int
    file: str
    time_s: float | None
    mean_px: float
    p95_px: float
    p99_px: float
    compute_s: float
    unknown: float


MOTION_COLUMNS = [column.name for column in fields(Motion)]


@dataclass(frozen=True)
class Prediction:
    """What `predict` did: the files it wrote, in order, the motion of each pair, and how many frames did not decode."""

    files: list[Path]
    motions: list[Motion]
    lost: int = 0


def predict_pair(method: Method, path1: Path, path2: Path, out: Path) -> Prediction:
    """Writes NAME.exr, NAME.flo and NAME.png, the flow from the first image to the second; replaces an earlier run's.

    NAME is what the two file names have in front of _1 and _2, else FIRST_to_SECOND. InputError where an image cannot
    be read, the two do not fit, or files of these names are somebody else's; OSError where a file cannot be written.
    """
    stem1, stem2 = path1.stem, path2.stem
    common = stem1.removesuffix("_1")
    name = common if stem1 == f"{common}_1" and stem2 == f"{common}_2" else f"{stem1}_to_{stem2}"
    files, motion = _predicted(method, PairDataset(path1, [PairRecord(name, path1, path2)]), 0, out)
    return Prediction(files, [motion])


def predict_pairs(
    method: Method, dataset: PairDataset, out: Path, progress: Callable[[int, int], None] | None = None
) -> Prediction:
    """Writes NAME.exr, NAME.flo and NAME.png for each pair, and motion.csv; exceptions as for `predict_pair`."""
    refuse_foreign(out / MOTIONS, MOTIONS_BEGIN)
    files: list[Path] = []
    motions: list[Motion] = []
    for index in range(len(dataset)):
        written, motion = _predicted(method, dataset, index, out)
        files += written
        motions.append(motion)
        if progress:
            progress(index + 1, len(dataset))
    return Prediction([*files, _write_motions(out, motions)], motions)


def _predicted(method: Method, dataset: PairDataset, index: int, out: Path) -> tuple[list[Path], Motion]:
    """The files written for one pair, and its motion."""
    name = dataset.names[index]
    exr, flo, png = (out / f"{name}{suffix}" for suffix in (".exr", ".flo", ".png"))
    refuse_foreign(exr, DIRECTIONS.encode(), flo, png)
    image1, image2 = dataset.images(index)
    try:
        found, seconds = estimated(method, image1, image2)
    except InputError as error:
        raise InputError(f"pair {name} of {dataset.source}, {method.name}: {error}") from error
    write_flow(exr, found.flow, found.visible, found.sigma)
    write_flo(flo, found.flow)
    write_flow_picture(png, image1, image2, found.flow, found.sigma, f"{name} ({method.name})")
    return [exr, flo, png], motion_of(found, index + 1, name, None, seconds)


def _write_motions(out: Path, motions: list[Motion]) -> Path:
    write_csv(out / MOTIONS, MOTION_COLUMNS, map(astuple, motions))
    return out / MOTIONS


def predict_video(
    method: Method,
    path: Path,
    out: Path,
    reference: Reference = "first",
    every: int = 1,
    progress: Callable[[int, int], None] | None = None,
    markers: bool = False,
    places: FlowArray | None = None,
) -> Prediction:
    """Writes flow/000001.exr ... (numbered by frame), motion.csv and overlay.mp4 in place of an earlier run's.

    Every `every`-th frame of a video file or a folder of images is taken; the flow leads to it from the first one or
    from its predecessor. With `markers`, markers.csv holds those of the first frame in each other, in mm where `places`
    (`gelflow.track.places`) are given. `progress` is called with the number of frames done and to be done; each counts
    twice, for flow and overlay. InputError where the video does not open, fewer than two frames decode, a frame cannot
    be used, or files of these names are somebody else's; OSError where a file cannot be written.
    """
    if every < 1:
        raise InputError(f"every = {every}: at least 1 is needed")
    info = describe(path)
    expected = -(-info.frames // every) - 1
    if info.frames < 2:
        raise InputError(f"{path}: fewer than two frames decode; a flow needs two")
    if expected < 1:
        words = f"takes one of the {info.frames} frames, a flow needs two; allowed are 1 to {info.frames - 1}"
        raise InputError(f"{path}: every = {every} {words}")
    former = earlier_files(out)
    sources = dict(enumerate(image_files(path))) if path.is_dir() else {}
    files: list[Path] = []
    motions: list[Motion] = []
    times: list[float] = []
    marked: list[tuple[int, float | None, NDArray[Any]]] = []
    scale = 0.0

    def timed() -> Iterator[Indexed]:
        for index, time_s, frame in _frames(path, every):
            times.append(index / info.frames_per_second if time_s is None else time_s)
            yield index, time_s, frame

    def named(index: int) -> Path:
        return sources.get(index, path)

    for (index, time_s, _), (found, seconds, moved) in followed(method, timed(), named, reference, markers, places):
        motion = motion_of(found, index, named(index).name, time_s, seconds)
        if moved is not None:
            marked.append((index, time_s, moved))
        if not files:
            for earlier in former:
                earlier.unlink()
        files.append(flow_file(out, index))
        write_flow(files[-1], found.flow, found.visible, found.sigma)
        motions.append(motion)
        scale = max(scale, robust_scale(certain(found.flow, found.sigma)))
        if progress:
            progress(len(motions), 2 * expected)
    tables = [_write_motions(out, motions)]
    if markers:
        rows = (row for index, time_s, moved in marked for row in marker_rows(index, time_s, moved, places))
        write_csv(out / MARKERS, marker_table(places), rows)
        tables.append(out / MARKERS)

    def drawn() -> Iterator[tuple[int, Frame]]:
        for index, _, frame in _frames(path, every):
            yield index, frame
            if progress and index > 0:
                progress(len(motions) + index // every, 2 * expected)

    video = write_overlay(out, drawn(), times, info.frames_per_second / every, scale)
    return Prediction([*files, *tables, video], motions, info.lost)


def motion_of(found: Estimate, frame: int, file: str, time_s: float | None, seconds: float) -> Motion:
    """What `Motion` tells of a flow that took so many seconds."""
    length = np.hypot(found.flow[..., 0], found.flow[..., 1])
    p95, p99 = (float(value) for value in np.nanpercentile(length, (95, 99)))
    unknown = float((found.sigma > unknown_px(*found.sigma.shape)).mean())
    return Motion(frame, file, time_s, float(np.nanmean(length)), p95, p99, seconds, unknown)


def _frames(path: Path, every: int) -> Iterator[tuple[int, float | None, Frame]]:
    """Index, time and pixels of each frame; InputError for one that cannot be read."""
    for index, time_s, frame in frames(path, every):
        if frame is None:
            raise InputError(f"{frame_file(path, index)}: cannot be read (truncated or damaged)")
        yield index, time_s, frame


def write_overlay(
    out: Path, frames: Iterable[tuple[int, Frame]], times: list[float], frames_per_second: float, scale_px: float
) -> Path:
    """Writes a video of numbered frames with the flow to each, which is read from its file; frame 0 has none.

    Each frame stays until the time of the next. OSError where the video cannot be written.
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
            picture = draw_overlay(shown(frame), flow, scale_px)
            if writer is None:
                size = (picture.shape[1], picture.shape[0])
                with quiet():
                    writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter.fourcc(*"mp4v"), rate, size)
            for _ in range(place, following):
                writer.write(np.ascontiguousarray(picture[..., ::-1]))
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


def flow_file(out: Path, index: int) -> Path:
    """The file of the flow to a frame."""
    return out / "flow" / f"{index:06d}.exr"


def earlier_files(out: Path) -> list[Path]:
    """Flows and markers that an earlier run left; InputError where a file that a run replaces is somebody else's."""
    flows = [path for path in (out / "flow").glob("*.exr") if re.fullmatch(r"[0-9]{6,}", path.stem)]
    refuse_foreign(out / MOTIONS, MOTIONS_BEGIN, out / OVERLAY)
    refuse_foreign(out / MARKERS, MARKERS_BEGIN)
    for flow in flows:
        refuse_foreign(flow, DIRECTIONS.encode())
    return [path for path in (*flows, out / MARKERS) if path.exists()]
