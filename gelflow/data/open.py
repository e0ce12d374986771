"""Opening whatever holds pairs: a data set of synth or its shards, a pair set of `gelflow pairs`, a plain folder."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from gelflow.data.pairs import PairDataset
from gelflow.data.pairset import FILE as PAIR_SET_FILE
from gelflow.data.pairset import pair_set_records
from gelflow.data.record import PairRecord
from gelflow.data.shards import shard_files, shard_records
from gelflow.data.synthetic import is_synthetic, synthetic_records
from gelflow.errors import InputError
from gelflow.files.video import image_files

ENDS = (("_1.png", "_2.png"), ("_img1.png", "_img2.png"), ("_img1.ppm", "_img2.ppm"))
"""Ends of the names of a pair's images; the last ones are FlyingChairs', as `synth export --format flo` writes them."""
FLYING_CHAIRS = "FlyingChairs_train_val.txt"
"""File beside a folder `data` that holds the pairs."""


def pair_records(folder: Path, frames_apart: int | None = None) -> list[PairRecord]:
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
        return synthetic_records(folder, frames_apart)
    if records := _folder_records(_folder_of_images(folder)):
        return records
    if shards := shard_files(folder):
        return shard_records(shards)
    content = "is empty" if not any(folder.iterdir()) else "holds no image pairs"
    raise InputError(
        f"{folder}: the folder {content}; allowed: a data set of synth (dataset.json), a pair set of "
        "`python -m gelflow pairs` (pairs.json), shards (*.tar), or files NAME_1.png and NAME_2.png "
        "(or NAME_img1 and NAME_img2, .png or .ppm)"
    )


def holds_pairs(path: Path) -> bool:
    """Whether a file or folder holds pairs rather than a recording, whose frames go on after NAME_1 and NAME_2."""
    if shard_files(path) or (path / PAIR_SET_FILE).is_file() or is_synthetic(path):
        return True
    folder = _folder_of_images(path)
    images = {image.name for image in image_files(folder)} if folder.is_dir() else set()
    pairs = [(name.removesuffix(first), first) for name in images for first, _ in ENDS if name.endswith(first)]
    return any(f"{name}{first.replace('1', '2')}" in images for name, first in pairs) and not any(
        f"{name}{first.replace('1', number)}" in images for name, first in pairs for number in "03"
    )


def open_all(paths: str | Path | Sequence[str | Path], frames_apart: int | None = None) -> PairDataset:
    """Folders of pairs or shards as one data set, in order; with more than one, names begin with the folder's name."""
    datasets = [PairDataset(path, None, frames_apart) for path in ([paths] if isinstance(paths, str | Path) else paths)]
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


def _folder_of_images(folder: Path) -> Path:
    return folder / "data" if (folder / FLYING_CHAIRS).is_file() else folder


def _folder_records(folder: Path) -> list[PairRecord]:
    """The pairs of a folder by name, their images named by `ENDS`, with NAME_markers.csv where dots were tracked."""
    images = {path.name for path in folder.iterdir() if not path.name.startswith(".")} if folder.is_dir() else set()
    found = {(name.removesuffix(end), ends) for name in images for ends in ENDS for end in ends if name.endswith(end)}
    records = []
    for stem, ends in sorted(found):
        image1, image2 = (folder / f"{stem}{end}" for end in ends)
        for path, other in ((image1, image2), (image2, image1)):
            if not path.is_file():
                raise InputError(f"{path}: the file is missing; {other.name} needs it to be a pair")
        markers = folder / f"{stem}_markers.csv"
        records.append(PairRecord(stem, image1, image2, markers=markers if markers.is_file() else None))
    return records
