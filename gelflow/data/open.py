"""Opening whatever holds pairs: a data set of synth or its shards, a pair set of `gelflow pairs`, a plain folder."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from gelflow.data.pairs import PairDataset, PairRecord
from gelflow.data.pairset import FILE as PAIR_SET_FILE
from gelflow.data.pairset import pair_set_records
from gelflow.data.shards import shard_files, shard_records
from gelflow.data.synthetic import is_synthetic, synthetic_records
from gelflow.errors import InputError
from gelflow.files.video import image_files

FIRST, SECOND = ("_1.png", "_img1.png"), ("_2.png", "_img2.png")
"""Ends of the names of a pair's images; the second ones are those of `synth export --format flo`."""


def pair_records(folder: Path) -> list[PairRecord]:
    """The pairs of a folder, recognised by what lies in it, or of one shard; see `PairDataset`."""
    if not folder.is_dir() and not shard_files(folder):
        if folder.exists():
            raise InputError(
                f"{folder}: is a file, not a folder; a folder with image pairs or a shard (.tar) is needed"
            )
        raise InputError(f"{folder}: there is no such folder; a folder with image pairs is needed")
    if (folder / PAIR_SET_FILE).is_file():
        return pair_set_records(folder)
    if is_synthetic(folder):
        return synthetic_records(folder)
    if records := _folder_records(folder):
        return records
    if shards := shard_files(folder):
        return shard_records(shards)
    content = "is empty" if not any(folder.iterdir()) else "holds no image pairs"
    raise InputError(
        f"{folder}: the folder {content}; allowed: a data set of synth (dataset.json), a pair set of "
        "`python -m gelflow pairs` (pairs.json), shards (*.tar), or files NAME_1.png and NAME_2.png (or _img1, _img2)"
    )


def holds_pairs(path: Path) -> bool:
    """Whether a file or folder holds pairs rather than a recording, whose frames go on after NAME_1 and NAME_2."""
    if shard_files(path) or (path / PAIR_SET_FILE).is_file() or is_synthetic(path):
        return True
    images = {image.name for image in image_files(path)} if path.is_dir() else set()
    names = {name.removesuffix("1.png") for name in images if name.endswith(FIRST)}
    return any(f"{name}2.png" in images for name in names) and not any(
        f"{name}{number}.png" in images for name in names for number in (0, 3)
    )


def open_all(paths: Sequence[Path]) -> PairDataset:
    """Folders of pairs or shards as one data set, in order; with more than one, names begin with the folder's name."""
    datasets = [PairDataset(path) for path in paths]
    if len(datasets) == 1:
        return datasets[0]
    records: list[PairRecord] = []
    taken: set[str] = set()
    for dataset in datasets:
        label = stem = Path(dataset.source).resolve().name
        number = 2
        while label in taken:
            label, number = f"{stem}-{number}", number + 1
        taken.add(label)
        records += [replace(record, name=f"{label}/{record.name}") for record in dataset.records]
    return PairDataset(", ".join(dataset.source for dataset in datasets), records)


def _folder_records(folder: Path) -> list[PairRecord]:
    """The pairs NAME_1.png and NAME_2.png of a folder, by name, with NAME_markers.csv where dots were tracked."""
    images = {path.name for path in folder.glob("*.png") if not path.name.startswith(".")}
    names = {name[: -len("1.png")] for name in images if name.endswith((*FIRST, *SECOND))}
    records = []
    for name in sorted(names):
        image1, image2 = folder / f"{name}1.png", folder / f"{name}2.png"
        for path, other in ((image1, image2), (image2, image1)):
            if not path.is_file():
                raise InputError(f"{path}: the file is missing; {other.name} needs it to be a pair")
        stem = name.removesuffix("img").removesuffix("_")
        markers = folder / f"{stem}_markers.csv"
        records.append(PairRecord(stem, image1, image2, markers=markers if markers.is_file() else None))
    return records
