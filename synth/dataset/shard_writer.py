"""One shard's part in a dataset that several processes write at the same time, on one machine or many.

Samples go to their final place, which no other shard touches; lines go to DIR/shards/i-of-N/. Whoever finds himself
alone, the first shard to come or the last to leave, takes the lines of all into the dataset's files (a plain run does,
too), so that the directory is a whole dataset when all shards have ended, without a further step.
"""

from pathlib import Path

from synth.dataset.job import Job
from synth.dataset.joining import FAILURES_FILE, MANIFEST_FILE, SHARDS_FOLDER, failure_key, manifest_key
from synth.dataset.lines import rewrite_lines, scan_lines
from synth.dataset.sample import SAMPLES_FOLDER
from synth.dataset.shard import Shard
from synth.dataset.storage import remove_partials, storage_errors
from synth.dataset.summary import write_summary
from synth.dataset.writer import DatasetWriter
from synth.errors import InputError


class ShardWriter(DatasetWriter):
    """Writes one shard's samples; `finished` tells of these only."""

    def __init__(self, directory: Path | str, job: Job, shard: Shard, pairs_per_trajectory: int) -> None:
        """Creates the directory, or joins those who write the same job.

        Args:
            directory: of the dataset, the same for all shards.
            job: the same for all shards.
            shard: this one.
            pairs_per_trajectory: samples i, i + 1, ... of that number belong to a trajectory.

        Raises:
            InputError: As `DatasetWriter`; or this shard, or a plain run, or a job cut into another number of shards
                is being made there.
        """
        self._shard, self._pairs = shard, pairs_per_trajectory
        super().__init__(directory, job)

    def finalise(self) -> None:
        """Leaves; the last one puts the dataset together.

        Raises:
            InputError: The storage refuses; nothing is lost.
        """
        with self._lock.setup():
            self._lock.leave()
            if not self._lock.try_alone():
                return
            self._tidy()
            if self._run is not None:
                write_summary(self.directory, self._run)
            self._lock.leave()

    def _open(self) -> tuple[set[int], set[tuple[int, int]]]:
        self._home = self.directory / SHARDS_FOLDER / self._shard.name
        with self._lock.setup():
            alone = self._lock.try_alone()
            if not alone:
                self._lock.take_shard(self._shard)  # before anything is touched
            self._adopt_job()
            if alone:
                self._tidy()
                self._lock.take_shard(self._shard)
            self._join_the_others()
        done = self._own_finished(self.directory / MANIFEST_FILE) | self._own_finished(self._home / MANIFEST_FILE)
        return done, self._own_failed()

    def _join_the_others(self) -> None:
        folder = self.directory / SHARDS_FOLDER
        with storage_errors(self._home):
            (self.directory / SAMPLES_FOLDER).mkdir(exist_ok=True)
            others = [home.name for home in folder.iterdir()] if folder.is_dir() else []
            strange = [name for name in others if not name.endswith(f"-of-{self._shard.count}")]
            if strange:
                raise InputError(
                    f"{self.directory}: is being made in another number of shards ({strange[0]}); wait for these to end"
                )
            self._home.mkdir(parents=True, exist_ok=True)
            remove_partials(self._home)
            remove_partials(self.directory / SAMPLES_FOLDER, self._is_mine)
        for name, key in ((MANIFEST_FILE, manifest_key), (FAILURES_FILE, failure_key)):
            path = self._home / name
            rewrite_lines(path, scan_lines(path, key).places.values())  # cuts off a torn line

    def _is_mine(self, name: str) -> bool:
        return name.isdecimal() and self._makes(int(name))

    def _makes(self, index: int) -> bool:
        return self._shard.makes(index // self._pairs)

    def _own_finished(self, manifest: Path) -> set[int]:
        return {i for i in scan_lines(manifest, manifest_key).places if self._makes(i) and self._is_whole(i)}

    def _own_failed(self) -> set[tuple[int, int]]:
        paths = (self.directory / FAILURES_FILE, self._home / FAILURES_FILE)
        return {key for path in paths for key in scan_lines(path, failure_key).places}
