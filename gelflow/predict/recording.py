"""Recording of a running camera, in the files of `predict`: flow/000001.exr ... and motion.csv.

Files are written beside the flow's computation, which waits only if `MOST_PENDING` frames are still to be written.
"""

import csv
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import astuple
from pathlib import Path

from gelflow.arrays import Estimate
from gelflow.files.atomic import refuse_foreign
from gelflow.files.exr import DIRECTIONS, write_flow
from gelflow.predict.prediction import MOTION_COLUMNS, MOTIONS, MOTIONS_BEGIN, Motion, earlier_flows, flow_file

MOST_PENDING = 8


class Recording:
    """Replaces an earlier run's files in a folder.

    InputError where files of these names are somebody else's; OSError, also from `add`, where one cannot be written.
    """

    def __init__(self, out: Path) -> None:
        refuse_foreign(out / MOTIONS, MOTIONS_BEGIN)
        for earlier in earlier_flows(out):
            refuse_foreign(earlier, DIRECTIONS.encode())
            earlier.unlink()
        out.mkdir(parents=True, exist_ok=True)
        self._out, self._table = out, (out / MOTIONS).open("w", newline="", encoding="utf-8")
        csv.writer(self._table).writerow(MOTION_COLUMNS)
        self._writer, self._pending = ThreadPoolExecutor(1), list[Future[None]]()

    def add(self, found: Estimate, motion: Motion) -> None:
        """Writes the flow to a frame, and its motion."""
        self._pending.append(self._writer.submit(self._write, found, motion))
        while len(self._pending) > MOST_PENDING:
            self._pending.pop(0).result()

    def close(self) -> None:
        """Waits for what is still to be written."""
        with self._writer, self._table:
            for each in self._pending:
                each.result()

    def _write(self, found: Estimate, motion: Motion) -> None:
        write_flow(flow_file(self._out, motion.frame), found.flow, found.visible, found.sigma)
        csv.writer(self._table).writerow(astuple(motion))
        self._table.flush()
