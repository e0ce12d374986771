"""The two files of lines of a dataset, and how the lines of shards come into them.

A shard writes its lines into DIR/shards/i-of-N/. They are added to the dataset's own, then the folder is removed: a
stop in between leaves lines twice, which count once.
"""

import shutil
from pathlib import Path
from typing import Any

from synth.dataset.lines import join_lines
from synth.dataset.sample import ManifestEntry
from synth.dataset.storage import storage_errors

MANIFEST_FILE = "manifest.jsonl"
FAILURES_FILE = "failures.jsonl"
SHARDS_FOLDER = "shards"


def manifest_key(record: dict[str, Any]) -> int:
    """Index of a line of the manifest."""
    return ManifestEntry.from_record(record).index


def failure_key(record: dict[str, Any]) -> tuple[int, int]:
    """Index and draw of a line of the failures."""
    return int(record["index"]), int(record["draw"])


def join_shards(directory: Path) -> None:
    """Adds the lines of all shards to the dataset's, not yet in order. No shard may be running.

    Raises:
        InputError: A file is damaged, or the storage refuses; nothing is lost, the same call goes on.
    """
    folder = directory / SHARDS_FOLDER
    if not folder.is_dir():
        return
    homes = sorted(home for home in folder.iterdir() if home.is_dir())
    join_lines(directory / MANIFEST_FILE, [home / MANIFEST_FILE for home in homes], manifest_key)
    join_lines(directory / FAILURES_FILE, [home / FAILURES_FILE for home in homes], failure_key)
    with storage_errors(folder):
        shutil.rmtree(folder)
