"""A plain folder of pairs: NAME_1.png and NAME_2.png, with NAME_markers.csv where dots were tracked."""

from pathlib import Path

from gelflow.data.pairs import PairRecord
from gelflow.errors import InputError


def is_pair_folder(folder: Path) -> bool:
    """Whether any file in a folder is called NAME_1.png or NAME_2.png."""
    return any(folder.glob("*_1.png")) or any(folder.glob("*_2.png"))


def folder_records(folder: Path) -> list[PairRecord]:
    """The pairs of a folder, sorted by name.

    Raises:
        InputError: One of the two images of a pair is missing.
    """
    stems = {path.name[: -len("_1.png")] for path in (*folder.glob("*_1.png"), *folder.glob("*_2.png"))}
    records = []
    for name in sorted(stems):
        image1, image2 = folder / f"{name}_1.png", folder / f"{name}_2.png"
        for path, other in ((image1, image2), (image2, image1)):
            if not path.is_file():
                raise InputError(f"{path}: the file is missing; {other.name} needs it to be a pair")
        markers = folder / f"{name}_markers.csv"
        records.append(PairRecord(name, image1, image2, markers=markers if markers.is_file() else None))
    return records
