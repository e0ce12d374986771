"""What `inspect` finds at a path."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from synth.dataset.job import DATASET_FILE
from synth.dataset.jsontext import read_document
from synth.dataset.reader import read_dataset
from synth.dataset.sample import further_cameras
from synth.errors import InputError
from synth.inspect.numbers import numbers_of
from synth.inspect.view import META_FILE, View, view_flow, view_sample

Kind = Literal["dataset", "sample", "flow"]

_ALLOWED = "a dataset, a sample's folder or an .exr file with a flow"


@dataclass(frozen=True)
class Inspection:
    """Numbers, and where the pictures come from (they are read again when they are drawn).

    Attributes:
        kind: what `path` is.
        path: as given.
        about: facts of the whole: scene, seed, device ...; empty for a sample or flow file.
        places: folder or file of each view that was looked at; of a sample with further cameras first its own folder,
            then theirs.
        numbers: of each of them, see `synth.inspect.numbers.numbers_of`.
        cameras: how many of the places belong to one sample.
    """

    kind: Kind
    path: Path
    about: Mapping[str, Any]
    places: tuple[Path, ...]
    numbers: tuple[dict[str, Any], ...]
    cameras: int = 1

    def spread(self, count: int) -> list[int]:
        """Numbers of the places of at most about `count`, evenly spaced; all cameras of a sample or none."""
        samples = evenly_spaced(len(self.places) // self.cameras, max(1, count // self.cameras))
        return [sample * self.cameras + camera for sample in samples for camera in range(self.cameras)]

    def as_dict(self) -> dict[str, Any]:
        return {"kind": self.kind, "path": str(self.path), **self.about, "samples": list(self.numbers)}

    def view(self, number: int) -> View:
        """Reads a view again; InputError where a file has gone or is damaged."""
        return _look(self.kind, self.places[number])


def evenly_spaced(total: int, count: int) -> list[int]:
    """At most `count` of 0 ... total - 1, the first and the last among them."""
    return sorted({int(i) for i in np.linspace(0, total - 1, min(count, total)).round()})


def inspect(path: Path | str, limit: int = 100) -> Inspection:
    """Looks at a dataset, of it at no more than `limit` samples, evenly spaced, a sample's folder or one flow file.

    Raises:
        InputError: Nothing that can be inspected, or a file is missing or damaged.
    """
    place = Path(path)
    if not place.exists():
        raise InputError(f"{place}: there is no such file or directory")
    about: dict[str, Any] = {}
    places, kind = [place], _kind_of(place)
    if kind == "dataset":
        about, folders = _about(place)
        places = [folders[i] for i in evenly_spaced(len(folders), limit)]
        about["inspected"] = len(places)
    names = _further(places[0]) if places and kind != "flow" else []
    places = [folder / name for folder in places for name in ("", *names)]
    numbers = tuple(numbers_of(_look(kind, item)) for item in places)
    return Inspection(kind, place, about, tuple(places), numbers, 1 + len(names))


def _further(folder: Path) -> list[str]:
    """Names of the further cameras of a sample's folder."""
    path = folder / META_FILE
    return further_cameras(read_document(path).get("scene", {})) if path.exists() else []


def _kind_of(place: Path) -> Kind:
    if place.is_file():
        if place.suffix.lower() != ".exr":
            raise InputError(f"{place}: cannot be inspected; give {_ALLOWED}")
        return "flow"
    if (place / DATASET_FILE).exists():
        return "dataset"
    if (place / "flow.exr").exists() or (place / "meta.json").exists():
        return "sample"
    raise InputError(f"{place}: holds neither {DATASET_FILE} nor flow.exr; give {_ALLOWED}")


def _look(kind: Kind, place: Path) -> View:
    return view_flow(place) if kind == "flow" else view_sample(place)


def _about(place: Path) -> tuple[dict[str, Any], list[Path]]:
    """Facts of a dataset, and its samples' folders."""
    dataset = read_dataset(place)
    info, indices = dataset.info, dataset.samples
    seconds: Counter[str] = Counter()
    for index in indices:
        seconds.update(dataset.entry(index).seconds)
    about = {
        "scene": info.get("scene_name"),
        "scene_hash": info["scene_hash"],
        "seed": info["seed"],
        "n": info["n"],
        "finished": len(indices),
        "failed_draws": len(dataset.failures),
        "device": info.get("device", {}),
        "software": info.get("software", {}),
        "seconds": {stage: round(value, 2) for stage, value in seconds.items()},
    }
    return about, [dataset.folder(index) for index in indices]
