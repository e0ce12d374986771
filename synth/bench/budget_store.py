"""What a study has measured so far, on disk.

    DIR/budget.json         which study: scenes and solver by their hashes, seed, ladder, reference
    DIR/budget.jsonl        a line per finished press
    DIR/fields/*.npz        displacement at the picture's points, of each press that is complete

A field is written before its line, so that what has a line has its field. One process writes at a time.
"""

import math
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any

from synth.arrays import FloatArray
from synth.bench.budget_field import read_field, write_field
from synth.bench.budget_press import Measurement, Pressed
from synth.bench.budget_study import REFERENCE, Drawn, Job, Study
from synth.dataset.jsontext import read_document, to_document
from synth.dataset.lines import append_line, merge_lines, read_line, scan_lines
from synth.dataset.lock import DirectoryLock
from synth.dataset.storage import remove_partials, replace_file, storage_errors
from synth.errors import InputError

STUDY_FILE, LINES_FILE, FIELDS = "budget.json", "budget.jsonl", "fields"


class Store:
    """The measurements in a directory; hold it open while writing.

    Attributes:
        measurements: by their job, in the order in which they were made; also such as nobody asks for any more.
    """

    def __init__(self, directory: Path, study: Study) -> None:
        """Open a directory that holds part of the same study or none.

        Raises:
            InputError: it holds another study, is damaged, is in use, or the storage refuses.
        """
        self._directory, self._lines, self._study = directory, directory / LINES_FILE, study
        with storage_errors(directory):
            (directory / FIELDS).mkdir(parents=True, exist_ok=True)
        self._lock = DirectoryLock(directory)
        try:
            self._claim(study)
            self.measurements = self._read()
        except BaseException:
            self._lock.release()
            raise

    def __enter__(self) -> "Store":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._lock.release()

    def _claim(self, study: Study) -> None:
        """Note which study this is, or see that it is the one that is there."""
        file, now = self._directory / STUDY_FILE, study.record()
        if not file.exists():
            if self._lines.exists():
                raise InputError(f"{self._lines}: {STUDY_FILE} is missing beside it; give another --out")
            replace_file(file, to_document(now).encode("utf-8"))
            return
        there = read_document(file)
        if there != now:
            differing = [
                f"{name}: {there.get(name)} there, {now.get(name)} now"
                for name in dict.fromkeys([*there, *now])
                if there.get(name) != now.get(name)
            ]
            raise InputError(
                f"{self._directory} holds another study ({'; '.join(differing)}); give another --out, or the same "
                "parameters to go on with that one"
            )

    def _read(self) -> dict[Job, Measurement]:
        with storage_errors(self._directory):
            remove_partials(self._directory)
            remove_partials(self._directory / FIELDS)
        merge_lines(self._lines, _key)  # cuts off what a killed run left of a line
        table = scan_lines(self._lines, _key)
        found = (_measurement(read_line(self._lines, place)) for place in table.places.values())
        return {measurement.job: measurement for measurement in found}

    def known(self, draws: Iterable[Drawn]) -> dict[Job, Measurement]:
        """The measurements that answer what is asked of draws; see `Study.answered`."""
        found = {}
        for one in draws:
            for rung in [REFERENCE, *self._study.rungs(one)]:
                measurement = self.measurements.get(Job(one.template.name, one.index, rung))
                if measurement is not None and self._study.answered(one, rung, measurement.mesh):
                    found[measurement.job] = measurement
        return found

    def keep(self, pressed: Pressed) -> None:
        """Write a press, in place of an earlier one of the same job.

        Raises:
            InputError: the storage refuses.
        """
        measurement = pressed.measurement
        if pressed.displacement is not None:
            write_field(self._file(measurement.job), pressed.points, pressed.frames, pressed.displacement)
        append_line(self._lines, asdict(measurement))
        self.measurements[measurement.job] = measurement

    def field(self, job: Job) -> FloatArray:
        """(k, n, 3) mm: the field of a press that is complete.

        Raises:
            InputError: its file is missing or damaged.
        """
        return read_field(self._file(job))

    def _file(self, job: Job) -> Path:
        return self._directory / FIELDS / f"{job.scene}-{job.index:03d}-{job.rung}.npz"


def _key(line: dict[str, Any]) -> tuple[str, int, str]:
    measurement = _measurement(line)
    return measurement.scene, measurement.index, measurement.rung


def _measurement(line: dict[str, Any]) -> Measurement:
    """JSON has no NaN: `null` stands for a number that there is none of."""
    values: dict[str, Any] = {name: math.nan if value is None else value for name, value in line.items()}
    return Measurement(**values)
