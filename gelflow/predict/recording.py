"""Recording of a running camera, in the files of `predict`: flow/000001.exr ..., motion.csv and overlay.mp4.

Flows are written beside their computation, which waits only if `MOST_PENDING` frames are still to be written. The
overlay is drawn at the end, when rate and largest motion are known. Until then frames lie in a file without a name.
"""

import csv
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import astuple
from pathlib import Path
from tempfile import TemporaryFile

import cv2
import numpy as np

from gelflow.arrays import Estimate, Frame
from gelflow.files.exr import write_flow
from gelflow.files.image import shown
from gelflow.files.video import NOMINAL_RATE
from gelflow.predict.pictures import certain, robust_scale
from gelflow.predict.prediction import MOTION_COLUMNS, MOTIONS, Motion, earlier_files, flow_file, write_overlay
from gelflow.terminal import progress

MOST_PENDING = 8


class Recording:
    """Replaces an earlier run's files in a folder.

    InputError where files of these names are somebody else's; OSError, also from `add`, where one cannot be written.
    """

    def __init__(self, out: Path) -> None:
        for earlier in earlier_files(out):
            earlier.unlink()
        out.mkdir(parents=True, exist_ok=True)
        self._out, self._table = out, (out / MOTIONS).open("w", newline="", encoding="utf-8")
        csv.writer(self._table).writerow(MOTION_COLUMNS)
        self._frames = TemporaryFile(dir=out)  # noqa: SIM115  # close() closes it
        self._kept: list[tuple[int, float, int]] = []
        self._scale_px = 0.0
        self._writer, self._pending = ThreadPoolExecutor(1), list[Future[None]]()

    def add(self, frame: Frame, found: Estimate, motion: Motion) -> None:
        """Writes a frame, the flow to it, and its motion."""
        self._pending.append(self._writer.submit(self._write, frame, found, motion))
        while len(self._pending) > MOST_PENDING:
            self._pending.pop(0).result()

    def close(self) -> None:
        """Waits for what is still to be written, and draws the overlay."""
        with self._frames:
            with self._writer, self._table:
                for each in self._pending:
                    each.result()
            if self._kept:
                times = [time_s for _, time_s, _ in self._kept]
                rate = float(1 / np.median(np.diff(times))) if len(times) > 1 else NOMINAL_RATE
                write_overlay(self._out, self._shown(), times, rate, self._scale_px)

    def _write(self, frame: Frame, found: Estimate, motion: Motion) -> None:
        write_flow(flow_file(self._out, motion.frame), found.flow, found.visible, found.sigma)
        csv.writer(self._table).writerow(astuple(motion))
        self._table.flush()
        _, jpeg = cv2.imencode(".jpg", shown(frame)[..., ::-1])
        self._kept.append((motion.frame, motion.time_s or 0.0, self._frames.write(jpeg)))
        self._scale_px = max(self._scale_px, robust_scale(certain(found.flow, found.sigma)))

    def _shown(self) -> Iterator[tuple[int, Frame]]:
        """Numbers and pixels of the frames, in order."""
        self._frames.seek(0)
        with progress("overlay (Ctrl-C leaves it out)") as advance:
            for done, (number, _, size) in enumerate(self._kept):
                advance(done, len(self._kept), "")
                jpeg = np.frombuffer(self._frames.read(size), np.uint8)
                yield number, cv2.imdecode(jpeg, cv2.IMREAD_COLOR)[..., ::-1]
