"""The pair set that `gelflow pairs` writes.

    DIR/pairs.json                    below
    DIR/images/NAME_1.png NAME_2.png  the frames as the video's decoder gave them

`pairs.json` is rewritten, as a whole, after each source, so that an interrupted job can go on:

    schema_version  1
    job             what determines the result: sources (name, bytes) and settings, the seed among them
    complete        whether every source has been looked at
    sources         by name: frames looked at, frames rejected by reason, pairs tried, pairs rejected by reason
    failures        by name: why nothing could be read
    pairs           name, image1, image2 (relative paths), source, frames [i, j], motion_px
"""

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError

from gelflow.data.record import PairRecord
from gelflow.errors import InputError
from gelflow.files.atomic import write_text
from gelflow.untrusted import inside, read_file

FILE = "pairs.json"
FileName = Annotated[str, AfterValidator(inside)]


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ChosenPair(_Record):
    """One pair of the set; `motion_px` is the 95th percentile of the length of a cheap flow, in px."""

    name: FileName
    image1: FileName
    image2: FileName
    source: str
    frames: tuple[int, int]
    motion_px: float


class SourceReport(_Record):
    """What became of one video or folder of frames."""

    frames: int
    frames_rejected: dict[str, int]
    tried: int
    rejected: dict[str, int]
    chosen: int


class PairSet(_Record):
    """The contents of pairs.json."""

    schema_version: Literal[1] = 1
    job: dict[str, Any]
    complete: bool = False
    sources: dict[str, SourceReport] = {}
    failures: dict[str, str] = {}
    pairs: tuple[ChosenPair, ...] = ()


def read_pair_set(folder: Path) -> PairSet:
    """Reads pairs.json, which is there; InputError where it is damaged or of a newer format."""
    path = folder / FILE
    try:
        return PairSet.model_validate_json(read_file(path))
    except (ValidationError, OSError) as error:
        detail = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
        raise InputError(f"{path}: not the description of a pair set ({detail})") from error


def write_pair_set(folder: Path, content: PairSet) -> None:
    """Writes the description of a pair set into its folder."""
    write_text(folder / FILE, json.dumps(content.model_dump(mode="json"), indent=1) + "\n")


def pair_set_records(folder: Path) -> list[PairRecord]:
    """The pairs of a finished pair set, in the order in which they were chosen; InputError where it is not finished."""
    content = read_pair_set(folder)
    if not content.complete:
        raise InputError(
            f"{folder / FILE}: `gelflow pairs` was interrupted; run the same command again, it goes on where it stopped"
        )
    return [PairRecord(pair.name, folder / pair.image1, folder / pair.image2) for pair in content.pairs]
