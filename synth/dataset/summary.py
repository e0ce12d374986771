"""summary.json: what a dataset took, and what its last run did.

The totals are counted from manifest and failures, so that they hold whatever was interrupted in between.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from synth.dataset.jsontext import to_document
from synth.dataset.manifest import FAILURES_FILE, MANIFEST_FILE

SUMMARY_FILE = "summary.json"


def reason_group(stage: str, reason: str) -> str:
    """Stage and reason with the numbers left out: attempts that fail alike fall into one group."""
    line = reason.strip().splitlines()[0] if reason.strip() else "no reason given"
    return f"{stage}: {re.sub(r'[-+]?[0-9]+([.][0-9]+)?(e[-+]?[0-9]+)?', '#', line)[:200]}"


def shares(seconds: Mapping[str, float]) -> dict[str, float]:
    """Each stage's share of all seconds; empty where there are none."""
    total = sum(seconds.values())
    return {stage: round(value / total, 4) for stage, value in seconds.items()} if total > 0 else {}


def summary_document(folder: Path, run: Mapping[str, Any], asked_for: int) -> bytes:
    """The file's content, from a folder that holds sorted manifest and failures."""
    seconds: Counter[str] = Counter()
    samples = 0
    for entry in _lines(folder / MANIFEST_FILE):
        samples += 1
        seconds.update(entry["seconds"])
    reasons = Counter(reason_group(failure["stage"], failure["reason"]) for failure in _lines(folder / FAILURES_FILE))
    content = {
        "samples": samples,
        "asked_for": asked_for,
        "seconds_per_stage": {stage: round(value, 3) for stage, value in seconds.items()},
        "share_per_stage": shares(seconds),
        "failed_draws": reasons.total(),
        "failures_by_reason": dict(sorted(reasons.items(), key=lambda item: (-item[1], item[0]))),
        "last_run": run,
    }
    return to_document(content).encode("utf-8")


def _lines(path: Path) -> Iterator[dict[str, Any]]:
    with path.open("rb") as file:
        for line in file:
            yield json.loads(line)
