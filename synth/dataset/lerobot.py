"""Clips as a LeRobot dataset (version 3.0 of its format): a clip is an episode.

    data/chunk-000/file-000.parquet           a file for each clip, a row for each frame
        observation.images.tactile            PNG, 8 bits, always RGB; further cameras by their names
        observation.state, action             pose in this frame and in the next, as in states.csv
        observation.wrench                    force and torque of the object on the gel, N and N mm
        contact_area_mm2, slip_ratio, gross_slip
        tactile.flow, tactile.visible ...     float32 arrays, of the flow from frame 0 and the optional channels
    meta/episodes/...                         and the text of meta.json; info.json, stats.json, tasks.parquet

Flow, depth and other channels are arrays in the table, since pictures and films of the format have 8 bits. Its frames
are evenly spaced: those of uneven poses get their mean rate. Tracks of markers, whose number differs, are left out.

Reference: https://huggingface.co/docs/lerobot/lerobot-dataset-v3.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.dataset.hdf5 import columns_of, frame_channels
from synth.dataset.images import encode_png
from synth.dataset.jsontext import to_document
from synth.dataset.sample_reader import ClipData
from synth.dataset.tracks import WRENCH, pose_columns
from synth.errors import InputError

MAIN, CHUNK = "tactile", 1000
NUMBERED = ("timestamp", "frame_index", "episode_index", "index", "task_index")
PATH = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"


def add_clip(out: Path, clips: dict[str, ClipData]) -> None:
    """Adds a clip, as each camera by name saw it, to a dataset in a folder; OSError where the storage refuses."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise InputError("--format lerobot needs pyarrow: pip install 'gelflow-synth[lerobot]'") from error
    clip, meta = clips[""], out / "meta"
    frames, time = len(clip), clip.states["time_s"]
    known = json.loads((meta / "info.json").read_text()) if meta.exists() else {}
    number, first = known.get("total_episodes", 0), known.get("total_frames", 0)
    rate = known.get("fps", round(float((frames - 1) / (time[-1] - time[0])), 6))
    place = {"chunk_index": number // CHUNK, "file_index": number % CHUNK}
    poses, columns = columns_of(clip, pose_columns(clip.meta["scene"])), _columns(clips)
    columns |= {"observation.state": poses, "action": poses[np.minimum(np.arange(frames) + 1, frames - 1)]}
    columns["observation.wrench"] = columns_of(clip, WRENCH)
    columns |= {name: clip.states[name] for name in ("contact_area_mm2", "slip_ratio", "gross_slip")}
    counted = np.arange(frames), np.full(frames, number), first + np.arange(frames), np.zeros(frames, np.int64)
    columns |= dict(zip(NUMBERED, ((np.arange(frames) / rate).astype(np.float32), *counted), strict=True))
    features, arrays = {}, {}
    for name, values in columns.items():
        kind = "image" if name.startswith("observation.images.") else str(values.dtype)
        axes = ["height", "width", "channels"] if kind == "image" else None
        features[name] = {"dtype": kind, "shape": list(values.shape[1:]) or [1], "names": axes}
        arrays[name] = _array(pa, values, kind)
    episode = {
        "episode_index": number, "tasks": [clip.meta["scene"]["name"]], "length": frames, "dataset_from_index": first,
        "meta": to_document(clip.meta),
        "dataset_to_index": first + frames, **{f"{part}/{key}": value for part in ("data", "meta/episodes")
                                               for key, value in place.items()},
    }  # fmt: skip
    for folder, table in (("data", pa.table(arrays)), ("meta/episodes", pa.Table.from_pylist([episode]))):
        path = out / folder / PATH.format(**place)
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, path)
    kinds = {"task_index": "int64", "task": "object"}
    described = [{"name": name, "field_name": name, "pandas_type": kind, "numpy_type": kind, "metadata": None}
                 for name, kind in kinds.items()]  # fmt: skip
    index = {"pandas": json.dumps({"index_columns": ["task"], "columns": described, "column_indexes": []})}
    task = pa.table({"task_index": pa.array([0]), "task": pa.array(episode["tasks"])})
    pq.write_table(task.replace_schema_metadata(index), meta / "tasks.parquet")
    stats = json.loads((meta / "stats.json").read_text()) if known else {}
    measured = [name for name in columns if name.startswith("observation.") or name == "action"]
    stats = {name: _merged(stats.get(name), columns[name]) for name in measured}
    info = {
        "codebase_version": "v3.0", "robot_type": None, "total_episodes": number + 1, "total_frames": first + frames,
        "total_tasks": 1, "chunks_size": CHUNK, "fps": int(rate) if rate == int(rate) else rate,
        "splits": {"train": f"0:{number + 1}"}, "data_path": f"data/{PATH}", "video_path": None, "features": features,
        "data_files_size_in_mb": 100, "video_files_size_in_mb": 200,
    }  # fmt: skip
    for name, content in (("info", info), ("stats", stats)):
        (meta / f"{name}.json").write_text(json.dumps(content, indent=1))


def _columns(clips: dict[str, ClipData]) -> dict[str, NDArray[Any]]:
    """Pictures (frames, H, W, 3) uint8, and channels (frames, H, W[, 2]) float32, NaN where a frame has none."""
    found: dict[str, NDArray[Any]] = {}
    for camera, clip in clips.items():
        each = list(frame_channels(clip))
        for name, last in each[-1].items():
            if name == "rgb":
                scale = 1 if last.dtype == np.uint8 else 257
                found[f"observation.images.{camera or MAIN}"] = np.array([one[name] // scale for one in each], np.uint8)
            elif not name.startswith("marker"):
                none = np.full(last.shape, np.nan)
                found[f"{camera or MAIN}.{name}"] = np.array([one.get(name, none) for one in each], np.float32)
    return found


def _array(pa: Any, values: NDArray[Any], kind: str) -> Any:
    """Pictures as files, other arrays (frames, ...) as lists of lists."""
    if kind == "image":
        files = [{"bytes": encode_png(picture), "path": f"{k:06d}.png"} for k, picture in enumerate(values)]
        return pa.array(files, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))
    found = pa.array(np.ascontiguousarray(values).ravel())
    for step in values.shape[:0:-1]:
        found = pa.ListArray.from_arrays(pa.array(np.arange(0, len(found) + 1, step, dtype=np.int32)), found)
    return found


def _merged(before: dict[str, Any] | None, values: NDArray[Any]) -> dict[str, Any]:
    """Statistics of all frames so far: of pictures those of their channels, from 0 to 1, (3, 1, 1)."""
    frames, shape = len(values), (3, 1, 1) if values.ndim == 4 else (-1,)
    values = values.reshape(-1, values.shape[-1]) / (255 if values.ndim == 4 else 1)
    old = before or {"min": np.inf, "max": -np.inf, "mean": 0.0, "std": 0.0, "count": [0]}
    low, high, mean, deviation = (np.ravel(old[name]) for name in ("min", "max", "mean", "std"))
    count = old["count"][0] + frames
    new = frames / count
    average = (1 - new) * mean + new * values.mean(axis=0)
    spread = (1 - new) * (deviation**2 + (mean - average) ** 2)
    spread += new * (values.var(axis=0) + (values.mean(axis=0) - average) ** 2)
    found = np.minimum(low, values.min(axis=0)), np.maximum(high, values.max(axis=0)), average, np.sqrt(spread)
    named = zip(("min", "max", "mean", "std"), found, strict=True)
    return {**{name: value.reshape(shape).tolist() for name, value in named}, "count": [count]}
