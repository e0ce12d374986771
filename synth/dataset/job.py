"""What a dataset was asked for: a scene with its distributions, a seed, a number of samples, and what computes them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from synth.dataset.exr import CONVENTIONS
from synth.dataset.jsontext import jsonable, read_document
from synth.errors import InputError

SCHEMA_VERSION = 1
DATASET_FILE = "dataset.json"

_CONVENTIONS = {
    "frame": "origin at the centre of the undeformed contact surface; +z through the gel toward the camera; "
    "+x right, +y down in the image",
    "units": "mm, N, MPa, degrees; flow in px",
    "images": "RGB or grey PNG, full scale 255 or 65535; image 1 is frames[0], image 2 is frames[1]",
    "force_n": "of the indenter on the gel, in each of the two frames; a press gives a positive z",
    "torque_nmm": "of the indenter on the gel about the frame's origin, N mm, in each of the two frames; a positive z "
    "turns +x toward +y",
    **CONVENTIONS,
}


@dataclass(frozen=True)
class Job:
    """A request for a dataset. Sample i depends on (scene_hash, seed, i) and on `device` alone.

    Attributes:
        scene: the resolved scene file, distributions included (JSON-able).
        scene_name: its name.
        scene_hash: digest of `scene`.
        seed: of the whole job.
        n: samples asked for.
        software: package -> version, for the record.
        device: what decides rounding and Monte Carlo noise: {"variant": "llvm_ad_rgb", "solver": "single"}.
    """

    scene: Mapping[str, Any]
    scene_name: str
    scene_hash: str
    seed: int
    n: int
    software: Mapping[str, str] = field(default_factory=dict)
    device: Mapping[str, str] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        return {
            "schema_version": SCHEMA_VERSION,
            "scene_name": self.scene_name,
            "scene_hash": self.scene_hash,
            "seed": self.seed,
            "n": self.n,
            "device": dict(self.device),
            "software": dict(self.software),
            "conventions": _CONVENTIONS,
            "scene": self.scene,
        }


def read_job_record(directory: Path) -> dict[str, Any]:
    """The content of DIR/dataset.json; InputError where it is missing, damaged, or of another version of the format."""
    path = directory / DATASET_FILE
    if not path.is_file():
        raise InputError(f"{directory}: not a dataset: it has no {DATASET_FILE}")
    return check_record(read_document(path), str(path))


def check_record(record: dict[str, Any], where: str) -> dict[str, Any]:
    """The content of a dataset.json, if it is complete and of this version; InputError if not, with `where` in it."""
    missing = [key for key in ("schema_version", "scene_hash", "seed", "n", "scene") if key not in record]
    if missing:
        raise InputError(f"{where}: lacks {', '.join(missing)}; the file is damaged or not of a dataset")
    kinds = {"seed": int, "n": int, "scene": dict, "device": dict, "software": dict}
    wrong = [key for key, kind in kinds.items() if not isinstance(record.get(key, kind()), kind)]
    if wrong:
        raise InputError(f"{where}: the value of {', '.join(wrong)} is of another kind; the file is damaged")
    if record["schema_version"] != SCHEMA_VERSION:
        raise InputError(
            f"{where}: written in version {record['schema_version']} of the format; "
            f"this program reads version {SCHEMA_VERSION}"
        )
    return record


def refuse_another_job(job: Job, record: Mapping[str, Any], where: str) -> None:
    """Compares a job with the dataset.json of a place; InputError says in what they differ.

    The scene (by its digest), the seed and the device make a job: each changes pixels, the device by its own rounding
    and sequence of random numbers. n does not, since a sample does not depend on it. Versions of software are recorded,
    not compared.
    """
    different = []
    if job.scene_hash != record["scene_hash"]:
        unhashed = {"description": "", "references": []}
        changed = _changed({**jsonable(record["scene"]), **unhashed}, {**jsonable(job.scene), **unhashed}, "scene")
        different += changed or _changed(record["scene_hash"], job.scene_hash, "scene_hash")
    different += _changed(record["seed"], job.seed, "seed")
    known = record.get("device", {})
    asked = {key: value for key, value in jsonable(job.device).items() if key in known}  # older ones lack some
    different += _changed(known, asked, "device")
    if different:
        listed = "".join(f"\n  {line}" for line in different[:20])
        more = f"\n  and {len(different) - 20} more" if len(different) > 20 else ""
        raise InputError(
            f"{where}: holds another job; it differs in{listed}{more}\n"
            "give another --out, or the options of that job to go on with it"
        )


def continued(job: Job, record: Mapping[str, Any]) -> dict[str, Any]:
    """dataset.json of a job that goes on: n grows, and software that has changed since is listed beside the first."""
    content = {**record, "n": max(job.n, int(record["n"]))}
    known = [record.get("software", {}), *record.get("continued_with", [])]
    if jsonable(job.software) not in known:
        content["continued_with"] = [*known[1:], dict(job.software)]
    return content


def _changed(before: Any, now: Any, path: str) -> list[str]:
    """Leaves that differ, by their full path."""
    if before == now:
        return []
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        keys = [*before, *(key for key in now if key not in before)]
        return [line for key in keys for line in _changed(before.get(key), now.get(key), f"{path}.{key}")]
    if isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        pairs = enumerate(zip(before, now, strict=True))
        return [line for i, (old, new) in pairs for line in _changed(old, new, f"{path}[{i}]")]
    return [f"{path}: {before} there, {now} now"]
