"""The job behind `gelflow pairs`: recordings in, a pair set on disk out.

A recording is a video file or a folder of images, which are its frames in the natural order of their names. Each is
looked at on its own, with a generator seeded from the job's seed and the recording's name, so that the result depends
neither on the other recordings nor on interruptions.
"""

import glob
import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from gelflow.arrays import Frame
from gelflow.data.choose import ChoiceConfig, Choices, choose_pairs
from gelflow.data.open import holds_pairs
from gelflow.data.pairset import FILE, ChosenPair, PairSet, SourceReport, read_pair_set, write_pair_set
from gelflow.errors import InputError
from gelflow.files.image import MINIMUM_SIDE, in_unit_range, range_factor, to_bytes, write_png
from gelflow.files.video import SUFFIXES, describe, frames, image_files

Progress = Callable[[int, int, str, SourceReport | str], None]
"""Called after each recording: done, total, its name, and its report or why it failed."""


def find_recordings(inputs: Sequence[str]) -> dict[str, Path]:
    """Recordings among files, folders and glob patterns, by name, sorted by path.

    A folder stands for all videos in it and below; if there is none, for its images as one recording, or if it has none
    either, for each folder of images below. InputError where a path does not exist, a pattern matches nothing, or a
    folder holds nothing to read.
    """
    paths: set[Path] = set()
    for given in inputs:
        matches = [Path(given)] if Path(given).exists() else [Path(match) for match in glob.glob(given, recursive=True)]
        if not matches:
            raise InputError(f"{given}: no file or folder of this name, and nothing that matches it as a pattern")
        for match in matches:
            paths.update(_recordings_at(match))
    ordered = sorted(paths)
    parts = [(path.with_suffix("") if path.is_file() else path).parts for path in ordered]
    for depth in range(1, max(map(len, parts)) + 1):
        names = ["__".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            return dict(zip(names, ordered, strict=True))
    one, other = next((ordered[i], ordered[j]) for i, j in combinations(range(len(parts)), 2) if parts[i] == parts[j])
    raise InputError(f"{one} and {other}: two recordings of one name; rename one, or make two pair sets")


def _recordings_at(path: Path) -> list[Path]:
    if path.is_file():
        if path.suffix.lower() not in SUFFIXES:
            describe(path)  # what it holds decides, not its name
        return [path]
    below = sorted(p for p in path.rglob("*") if not any(part.startswith(".") for part in p.relative_to(path).parts))
    found = [p for p in below if p.suffix.lower() in SUFFIXES and p.is_file()]
    found = found or [path for _ in image_files(path)[:1]]
    found = found or [p for p in below if p.is_dir() and image_files(p)]
    if ready := [p for p in found if p.is_dir() and holds_pairs(p)]:
        raise InputError(f"{ready[0]}: holds image pairs already; finetune, compare and predict take it as it is")
    if not found:
        raise InputError(f"{path}: the folder holds neither videos ({', '.join(sorted(SUFFIXES))}) nor images")
    return found


def extract_pairs(inputs: Sequence[str], out: Path, config: ChoiceConfig, progress: Progress | None = None) -> PairSet:
    """Chooses pairs from recordings and writes them as a pair set; goes on where the same job was interrupted.

    InputError for nothing to read, a value out of range, or an `out` that holds something else than this job; OSError
    where the disk is full or not writable: what is there stays and the same command goes on from it.
    """
    _check(config)
    recordings = find_recordings(inputs)
    job = {"sources": {name: _size(path) for name, path in recordings.items()}, "settings": asdict(config)}
    content = _opened(out, job)
    for done, (name, path) in enumerate(recordings.items(), start=1):
        if name in content.sources or name in content.failures:
            continue
        outcome: SourceReport | str
        try:
            outcome, pairs = _extract_one(name, path, out, config)
            changes = {"sources": content.sources | {name: outcome}, "pairs": content.pairs + tuple(pairs)}
        except InputError as error:
            outcome = str(error)
            changes = {"failures": content.failures | {name: outcome}}
        content = content.model_copy(update=changes)
        write_pair_set(out, content)
        if progress:
            progress(done, len(recordings), name, outcome)
    if not content.complete:
        content = content.model_copy(update={"complete": True})
        write_pair_set(out, content)
    return content


def _check(config: ChoiceConfig) -> None:
    for name in ("per_source", "tries"):
        if getattr(config, name) < 1:
            raise InputError(f"{name} = {getattr(config, name)}: at least 1 is needed")
    if config.frames < 2:
        raise InputError(f"frames = {config.frames}: at least 2 frames of a recording are needed for a pair")
    if not 0 <= config.minimum_motion_px <= config.maximum_motion_px < math.inf:
        raise InputError(f"motion from {config.minimum_motion_px:g} to {config.maximum_motion_px:g} px: the limits "
                         "must be finite and at least 0, the lower one first")  # fmt: skip


def _size(path: Path) -> int:
    return sum(file.stat().st_size for file in image_files(path)) if path.is_dir() else path.stat().st_size


def _opened(out: Path, job: dict[str, Any]) -> PairSet:
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        content = PairSet(job=job)
        write_pair_set(out, content)
        return content
    if not (out / FILE).is_file():
        raise InputError(f"{out}: exists and holds other things; give an empty or a new folder as --out")
    content = read_pair_set(out)
    if content.job != job:
        raise InputError(f"{out}: holds the pairs of another job: {'; '.join(_differences(content.job, job))}; give "
                         "another --out, or remove this folder")  # fmt: skip
    return content


def _differences(there: dict[str, Any], here: dict[str, Any]) -> list[str]:
    """What differs between two jobs, in words: settings, and the sizes of recordings."""
    old, new = ({**job.get("settings", {}), **job.get("sources", {})} for job in (there, here))
    names = sorted(name for name in old.keys() | new.keys() if old.get(name) != new.get(name))
    shown = [f"{name} is {old.get(name, 'missing')} there and {new.get(name, 'missing')} here" for name in names[:5]]
    return [*shown, f"and {len(names) - 5} more"] if len(names) > 5 else shown


def _extract_one(name: str, path: Path, out: Path, config: ChoiceConfig) -> tuple[SourceReport, list[ChosenPair]]:
    info = describe(path)
    count = info.frames + info.lost
    every = max(1, -(-count // config.frames))
    indices: list[int] = []
    pictures: list[Frame] = []
    for index, _, frame in frames(path, every):
        if frame is None:
            continue
        if pictures and frame.shape != pictures[0].shape:
            raise InputError(f"{path}: frame {index} has another size than the first")
        indices.append(index)
        pictures.append(frame)
    if len(pictures) < 2:
        raise InputError(f"{path}: {len(pictures)} of its {count} frames decode; two are needed for a pair")
    height, width = pictures[0].shape[:2]
    if min(height, width) < MINIMUM_SIDE:
        raise InputError(f"{path}: frames of {width} x {height} px; each side needs {MINIMUM_SIDE}")
    digest = hashlib.sha256(f"{config.seed}:{name}".encode()).digest()
    factor = range_factor(max(picture.max() / np.iinfo(picture.dtype).max for picture in pictures))
    shown = [to_bytes(factor * in_unit_range(picture)) for picture in pictures]
    choices = choose_pairs(shown, config, np.random.default_rng(int.from_bytes(digest[:16], "big")))
    lost = -(-count // every) - len(pictures)
    pairs = _write(name, choices, indices, pictures, out)
    report = SourceReport(
        frames=len(pictures),
        frames_rejected=choices.frames_rejected | ({"undecodable": lost} if lost > 0 else {}),
        tried=choices.tried,
        rejected=choices.rejected,
        chosen=len(pairs),
    )
    return report, pairs


def _write(
    source: str, choices: Choices, indices: Sequence[int], pictures: Sequence[Frame], out: Path
) -> list[ChosenPair]:
    pairs = []
    for choice in sorted(choices.pairs, key=lambda c: (c.first, c.second)):
        i, j = indices[choice.first], indices[choice.second]
        name = f"{source}__{i:05d}_{j:05d}"
        files = [f"images/{name}_{k}.png" for k in (1, 2)]
        for file, picture in zip(files, (pictures[choice.first], pictures[choice.second]), strict=True):
            write_png(out / file, picture)
        pairs.append(ChosenPair(name=name, image1=files[0], image2=files[1], source=source, frames=(i, j),
                                motion_px=round(choice.motion_px, 2)))  # fmt: skip
    return pairs
