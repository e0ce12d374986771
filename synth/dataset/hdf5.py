"""Clips as HDF5: a file for each in the layout of UniVTAC's episodes, and one over all in robomimic's.

    hdf5/0.hdf5    tactile/left_tactile/rgb             (frames, H, W, 3), grey images three times
                                       /marker          (frames, 2, n, 2) px, at rest and in this frame
                                       /marker_visible  (frames, n), 1 where the marker is seen in this frame
                                       /flow            (frames, H, W, 2) float32 px from frame 0, NaN without gel
                                       /visible         (frames, H, W), of the flow
                                       /contact.Y ...   optional channels by their EXR names; NaN in frame 0
                   tactile/NAME/...                     the same of a further camera
                   states/fx_n ...                      the columns of states.csv, (frames,)
                   attributes                           meta, the text of meta.json
    dataset.hdf5   data/demo_0/obs/...                  links to left_tactile's of hdf5/0.hdf5, and wrench (frames, 6)
                              /actions                  (frames, 4 or 7) pose in the next frame, as in states
                              /dones, rewards           1 and 0 in the last frame, else 0

References: https://robomimic.github.io/docs/datasets/overview.html; UniVTAC, docs/Collection.md.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.dataset.jsontext import to_document
from synth.dataset.sample_reader import ClipData
from synth.dataset.tracks import WRENCH, pose_columns, states_columns
from synth.errors import InputError

MAIN = "left_tactile"


def hdf5_library() -> Any:
    """The package h5py; InputError where it is not installed."""
    try:
        import h5py
    except ImportError as error:
        raise InputError("--format hdf5 needs h5py: pip install 'gelflow-synth[hdf5]'") from error
    return h5py


def add_clip(out: Path, clips: dict[str, ClipData]) -> None:
    """Writes a clip, as each camera by name saw it, to a folder, and adds it to the file over all.

    OSError where the storage refuses.
    """
    h5py, clip = hdf5_library(), clips[""]
    with h5py.File(out / "dataset.hdf5", "a") as whole:
        data = whole.require_group("data")
        number, frames = len(data), len(clip)
        own = Path("hdf5") / f"{number}.hdf5"
        (out / own).parent.mkdir(exist_ok=True)
        with h5py.File(out / own, "w") as episode:
            episode.attrs["meta"] = to_document(clip.meta)
            for camera, seen in clips.items():
                for frame, channels in enumerate(frame_channels(seen)):
                    for name, values in channels.items():
                        place = f"tactile/{camera or MAIN}/{name}"
                        if place not in episode:
                            shape = (frames, *values.shape)
                            packed = {"chunks": (1, *values.shape), "compression": "gzip"} if values.ndim > 1 else {}
                            missing = np.nan if values.dtype.kind == "f" else 0
                            episode.create_dataset(place, shape, values.dtype, fillvalue=missing, **packed)
                        episode[place][frame] = values
            for name in states_columns(clip.meta["scene"]):
                episode[f"states/{name}"] = clip.states[name]
            names = list(episode[f"tactile/{MAIN}"])
        demo = data.create_group(f"demo_{number}")
        demo.attrs["num_samples"] = frames
        for name in names:
            demo[f"obs/{name}"] = h5py.ExternalLink(own.as_posix(), f"tactile/{MAIN}/{name}")
        demo["obs/wrench"] = columns_of(clip, WRENCH)
        demo["actions"] = columns_of(clip, pose_columns(clip.meta["scene"]))[
            np.minimum(np.arange(frames) + 1, frames - 1)
        ]
        demo["rewards"], demo["dones"] = np.zeros(frames), np.eye(1, frames, frames - 1, dtype=np.int64)[0]
        data.attrs["total"] = int(data.attrs.get("total", 0)) + frames
        data.attrs["env_args"] = json.dumps({"env_name": clip.meta["scene"]["name"], "env_type": 0, "env_kwargs": {}})


def columns_of(clip: ClipData, names: tuple[str, ...]) -> NDArray[np.float64]:
    return np.column_stack([clip.states[name] for name in names])


def frame_channels(clip: ClipData) -> Iterator[dict[str, NDArray[Any]]]:
    """What is kept of each frame, by name."""
    markers = clip.markers.reshape(-1, len(clip))
    at = np.stack([markers["x"], markers["y"]], axis=-1).swapaxes(0, 1)
    for frame in range(len(clip)):
        found: dict[str, NDArray[Any]] = {}
        if clip.images:
            image = clip.images[frame]
            found["rgb"] = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=-1)
        found |= {"marker": at[[0, frame]], "marker_visible": markers["visible"][:, frame].astype(np.uint8)}
        flow = clip.flows[max(frame - 1, 0)]
        if frame:
            found |= {"flow": flow.forward, "visible": flow.forward_visible.astype(np.uint8), **flow.extras}
        else:
            rest = np.where(np.isfinite(flow.forward), 0, np.nan).astype(np.float32)
            found |= {"flow": rest, "visible": np.isfinite(rest[..., 0]).astype(np.uint8)}
        yield found
