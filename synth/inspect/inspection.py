"""What `inspect` finds at a path."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from synth.arrays import BoolArray, FloatArray
from synth.dataset.job import DATASET_FILE
from synth.dataset.reader import read_dataset
from synth.dataset.sample import further_cameras
from synth.dataset.sample_reader import META_FILE, ClipData, read_meta
from synth.dataset.tracks import states_columns
from synth.errors import InputError
from synth.flow.field import FlowArray
from synth.inspect.view import View, view_flow, view_sample

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
        numbers: of each of them, see `synth.inspect.inspection.numbers_of`.
        cameras: how many of the places belong to one sample.
    """

    kind: Kind
    path: Path
    about: Mapping[str, Any]
    places: tuple[Path, ...]
    numbers: tuple[dict[str, Any], ...]
    cameras: int

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
    """Numbers, at most `count` of 0 ... total - 1, the first and the last among them."""
    return sorted({int(i) for i in np.linspace(0, total - 1, min(count, total)).round()})


def inspect(path: Path | str, limit: int = 100) -> Inspection:
    """Looks at a dataset, of it at no more than `limit` samples, evenly spaced, a sample's folder or one flow file.

    InputError for nothing that can be inspected, or a file that is missing or damaged.
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
    names: list[str] = []
    if places and (places[0] / META_FILE).exists():
        names = further_cameras(read_meta(places[0])["scene"])
    places = [folder / name for folder in places for name in ("", *names)]
    numbers = tuple(numbers_of(_look(kind, item)) for item in places)
    return Inspection(kind, place, about, tuple(places), numbers, 1 + len(names))


def _kind_of(place: Path) -> Kind:
    if place.is_file():
        if place.suffix.lower() != ".exr":
            raise InputError(f"{place}: cannot be inspected; give {_ALLOWED}")
        return "flow"
    if (place / DATASET_FILE).exists():
        return "dataset"
    if any((place / name).exists() for name in ("flow.exr", "flow", META_FILE)):
        return "sample"
    raise InputError(f"{place}: holds neither {DATASET_FILE} nor flow.exr; give {_ALLOWED}")


def _look(kind: Kind, place: Path) -> View:
    return view_flow(place) if kind == "flow" else view_sample(place)


def _about(place: Path) -> tuple[dict[str, Any], list[Path]]:
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


def numbers_of(view: View) -> dict[str, Any]:
    """What a view says in numbers; None where there is nothing to say it from.

    Name, width, height, bits, forward and backward (min_px, median_px, p95_px, max_px over the pixels that see gel;
    nan_share of all pixels; visible_share of those with gel), closure, sigma (median_px, p95_px, max_px, pixels),
    difference (before_rmse, after_rmse as shares of full scale over visible pixels), and from a sample's meta.json
    index, trajectory, frames, force_n, torque_nmm, solver; and of the forces the part along the inward normal of the
    press (+z but on round gels), and the length of the rest: normal_force_n, side_force_n. Of a clip these are of its
    first and its last frame, and states has the columns of states.csv.
    """
    height, width = view.size
    flow, meta = view.flow, view.meta
    backward = None
    if flow.backward is not None and flow.backward_visible is not None:
        backward = _motion(flow.backward, flow.backward_visible > 0.5, view.visible_known)
    difference = None
    if view.differences is not None:
        difference = dict(zip(("before_rmse", "after_rmse"), map(_rms, view.differences), strict=True))
    diagnostics = meta["diagnostics"] if isinstance(meta.get("diagnostics"), dict) else {}
    normal, side = None, None
    if (forces := meta.get("force_n")) is not None:
        inward = np.array(diagnostics.get("inward_normal", (0.0, 0.0, 1.0)))
        normal = [float(np.dot(force, inward)) for force in forces]
        side = [float(np.linalg.norm(force - n * inward)) for force, n in zip(forces, normal, strict=True)]
    return {
        "name": view.name,
        **{key: meta.get(key) for key in ("index", "trajectory", "frames", "force_n", "torque_nmm")},
        "normal_force_n": normal,
        "side_force_n": side,
        "width": width,
        "height": height,
        "bits": None if view.image1 is None else 8 * view.image1.itemsize,
        "forward": _motion(flow.forward, view.visible, view.visible_known),
        "backward": backward,
        "closure": None if view.closure is None else _spread(view.closure),
        "sigma": None if view.sigma is None else _spread(view.sigma),
        "difference": difference,
        "solver": diagnostics.get("solver"),
        "channels": sorted(flow.extras),
        "states": None if view.clip is None else _columns(view.clip),
    }


def _columns(clip: ClipData) -> dict[str, list[float]]:
    return {name: clip.states[name].tolist() for name in states_columns(clip.meta["scene"])}


def _motion(flow: FlowArray, visible: BoolArray, visible_known: bool) -> dict[str, float | None]:
    length = np.hypot(flow[..., 0].astype(np.float64), flow[..., 1].astype(np.float64))
    gel = np.isfinite(length)
    share = float(visible[gel].mean()) if visible_known and gel.any() else None
    found = _percentiles(length[gel], min_px=0, median_px=50, p95_px=95, max_px=100)
    return {**found, "nan_share": float(1 - gel.mean()), "visible_share": share}


def _spread(values: FloatArray) -> dict[str, float | int | None]:
    found = values[np.isfinite(values)]
    return {**_percentiles(found, median_px=50, p95_px=95, max_px=100), "pixels": int(found.size)}


def _percentiles(values: FloatArray, **percents: int) -> dict[str, float | None]:
    """Percentiles of values by the names of the percents; None where there are no values."""
    if not values.size:
        return dict.fromkeys(percents)
    return {
        name: float(value) for name, value in zip(percents, np.percentile(values, [*percents.values()]), strict=True)
    }


def _rms(values: FloatArray) -> float | None:
    found = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(found**2))) if found.size else None
