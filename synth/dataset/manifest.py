"""Lines of manifest.jsonl, one for each finished sample, and the keys of its lines and of those of failures.jsonl.

`synth.dataset.sample_files` makes the entries.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

MANIFEST_FILE = "manifest.jsonl"
FAILURES_FILE = "failures.jsonl"


@dataclass(frozen=True)
class ManifestEntry:
    """A line of manifest.jsonl.

    `sha256` is by file name, "left/flow.exr" for a further camera's; `max_flow_px` is the main camera's, None where no
    pixel of it sees the gel.
    """

    index: int
    trajectory: int
    frames: tuple[int, int]
    seed: int
    sha256: Mapping[str, str]
    seconds: Mapping[str, float]
    diagnostics: Mapping[str, Any]
    force_n: tuple[tuple[float, ...], ...]
    torque_nmm: tuple[tuple[float, ...], ...]
    max_flow_px: float | None

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> "ManifestEntry":
        """From the line's JSON object; KeyError or TypeError where it is not one of a sample."""
        values = {name: record[name] for name in cls.__dataclass_fields__}
        rows = {name: tuple(map(tuple, record[name])) for name in ("force_n", "torque_nmm")}
        return cls(**{**values, **rows, "index": int(record["index"]), "frames": tuple(record["frames"])})

    def record(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self.__dataclass_fields__}


def manifest_key(record: dict[str, Any]) -> int:
    """Index of a line of the manifest; KeyError or TypeError where it is not one."""
    return ManifestEntry.from_record(record).index


def failure_key(record: dict[str, Any]) -> tuple[int, int]:
    """Index and draw of a line of the failures; KeyError or TypeError where it is not one."""
    return int(record["index"]), int(record["draw"])
