"""Image pairs as a map-style data set for torch."""

import csv
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from gelflow.arrays import ImageArray, MarkerArray
from gelflow.data.member import FlowMembers
from gelflow.data.record import PairRecord
from gelflow.errors import InputError
from gelflow.files.exr import FlowField, read_flow
from gelflow.files.image import read_pair


class PairDataset(Dataset[dict[str, Tensor | str | bool]]):
    """Image pairs that are read from disk when they are asked for; a map-style data set for a torch DataLoader.

    `dataset[i]` is a dictionary:

        image1, image2  (3, H, W) float32, RGB in [0, 1]
        name            str, unique within the data set
        bare            bool, whether the pair is synthetic and its gel has no pattern
        flow            (2, H, W) float32, U right and V down in px, I1(x) = I2(x + flow(x)); NaN where no gel is seen
        visible         (1, H, W) float32, 1 where the point of the pixel is seen in image 2, else 0

    `flow` and `visible` are there if any pair of the data set has an exact flow; a pair without one then has NaN and 0
    throughout, so that samples of both kinds fit into one batch.

    Args:
        source: A data set of synth, a pair set of `gelflow pairs`, a folder of NAME_1.png and NAME_2.png, or
            WebDataset shards (*.tar): one of them or a folder.
        records: The pairs, where they are known; `source` then only says in messages where they come from.
        frames_apart: Of clips of synth, take pairs of frames that many apart, whose exact flow is known for neighbours
            in clips with `outputs.previous`, else from the frame at rest alone. Default: each frame with that at rest.

    Raises:
        InputError: There is no such folder, it is none of these, holds no pair, or is damaged.
    """

    def __init__(
        self, source: str | Path, records: Sequence[PairRecord] | None = None, frames_apart: int | None = None
    ) -> None:
        if frames_apart is not None and frames_apart < 1:
            raise InputError(f"frames_apart = {frames_apart}: at least 1")
        if records is None:
            from gelflow.data.open import pair_records

            records = pair_records(Path(source), frames_apart)
        if not records:
            raise InputError(f"{source}: holds no image pair")
        self.source = str(source)
        self.records = tuple(records)
        self.has_flow = any(record.flow is not None for record in self.records)

    def __len__(self) -> int:
        return len(self.records)

    @property
    def names(self) -> list[str]:
        """Names of the pairs, in order."""
        return [record.name for record in self.records]

    @property
    def digest(self) -> str:
        """SHA-256 of what tells data sets apart without reading an image: names, scenes and origins of the pairs."""
        known = [(record.name, record.scene and str(record.scene), record.origin) for record in self.records]
        return hashlib.sha256(json.dumps(known).encode()).hexdigest()

    def images(self, index: int) -> tuple[ImageArray, ImageArray]:
        """Both images of a pair, (H, W, 3) float32 in [0, 1].

        Raises:
            InputError: An image is missing, damaged or too small, or the two differ in size.
            IndexError: There is no pair of this number.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"there is no pair {index}: {self.source} has {len(self)}, the first is 0")
        record = self.records[index]
        # Of a path, read_pair asks for is_file, read_bytes and its text: all that a member of a shard has, too.
        return read_pair(cast(Path, record.image1), cast(Path, record.image2))

    def truth(self, index: int) -> FlowField | None:
        """Exact flow (H, W, 2) in px and its visibility (H, W) bool; None where the pair has none.

        InputError where the file is missing or damaged.
        """
        flow = self.records[index].flow
        if isinstance(flow, FlowMembers):
            return flow.read()
        return None if flow is None else read_flow(flow, self.records[index].direction)

    def markers(self, index: int) -> MarkerArray | None:
        """Tracked dots of a pair, None where it has none; exceptions as for `read_markers`."""
        path = self.records[index].markers
        return None if path is None else read_markers(path)

    def __getitem__(self, index: int) -> dict[str, Tensor | str | bool]:
        """The sample that the class describes; InputError where a file is missing or damaged, or the sizes differ."""
        images, record = self.images(index), self.records[index]
        size = images[0].shape[:2]
        image1, image2 = (_channels_first(image) for image in images)
        bare = record.scene is not None and record.scene.bare
        sample: dict[str, Tensor | str | bool] = {"image1": image1, "image2": image2, "name": record.name, "bare": bare}
        if not self.has_flow:
            return sample
        truth = self.truth(index)
        if truth is None:
            return sample | {"flow": torch.full((2, *size), torch.nan), "visible": torch.zeros((1, *size))}
        if truth.flow.shape[:2] != size:
            raise InputError(f"{record.flow}: the flow has {truth.flow.shape[1]} x {truth.flow.shape[0]} px, "
                             f"the images have {size[1]} x {size[0]} px")  # fmt: skip
        visible = torch.from_numpy(truth.visible[None].astype(np.float32))
        return sample | {"flow": _channels_first(truth.flow), "visible": visible}


def _channels_first(array: NDArray[np.float32]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(array, -1, 0)))


def read_markers(path: Path) -> MarkerArray:
    """Reads tracked dots from a CSV file with the columns x1, y1, x2, y2 (px).

    InputError where it is missing, lacks a column or a row, or holds something other than finite numbers.
    """
    columns = ("x1", "y1", "x2", "y2")
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:  # with or without a byte order mark
            rows = [[float(row[name]) for name in columns] for row in csv.DictReader(file)]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise InputError(
            f"{path}: not a CSV file in UTF-8 with the columns {','.join(columns)} and a number in each ({error!r})"
        ) from error
    markers = np.array(rows, np.float64).reshape(-1, 4)
    if not len(markers) or not np.isfinite(markers).all():
        raise InputError(f"{path}: holds no marker, or one that is not finite")
    return markers
