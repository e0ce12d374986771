"""Clips as recordings for Rerun's viewer: a file for each, `rerun 000000.rrd`, on the time lines "frame" and "time".

    tactile            the picture; further cameras by their names
    tactile/markers    its dots; those that are hidden have no colour
    tactile/motion     arrows from rest, one for each of some 24 x 24 pixels
    tactile/flow ...   flow from frame 0 and optional channels, as tensors
    force_n, torque_nmm, contact_area_mm2, slip_ratio, meta

Reference: https://rerun.io/docs/reference/types.
"""

from pathlib import Path

import numpy as np

from synth.dataset.hdf5 import columns_of, frame_channels
from synth.dataset.jsontext import to_document
from synth.dataset.sample_reader import ClipData
from synth.dataset.tracks import WRENCH
from synth.errors import InputError

MAIN, ARROWS = "tactile", 24


def add_clip(out: Path, clips: dict[str, ClipData]) -> None:
    """Writes a clip, as each camera by name saw it, to a folder; OSError where the storage refuses."""
    try:
        import rerun as rr
    except ImportError as error:
        raise InputError("--format rrd needs rerun-sdk: pip install 'gelflow-synth[rerun]'") from error
    clip = clips[""]
    name = clip.folder.name
    recording = rr.RecordingStream(clip.meta["scene"]["name"], recording_id=name)
    recording.save(out / f"{name}.rrd")
    recording.log("meta", rr.TextDocument(to_document(clip.meta)), static=True)
    wrench = columns_of(clip, WRENCH)
    channels = {camera or MAIN: frame_channels(seen) for camera, seen in clips.items()}
    for frame, time in enumerate(clip.states["time_s"]):
        recording.set_time("frame", sequence=frame)
        recording.set_time("time", duration=float(time))
        for camera, one in ((camera, next(frames)) for camera, frames in channels.items()):
            if "rgb" in one:
                recording.log(camera, rr.Image(one["rgb"]))
            at = one["marker"][1]
            shade = np.where(one["marker_visible"][:, None] > 0, [255, 200, 0, 255], [0, 0, 0, 0])
            recording.log(f"{camera}/markers", rr.Points2D(at, colors=shade, radii=1.5))
            every = max(1, max(one["flow"].shape) // ARROWS)
            rows, columns = (np.arange(every // 2, size, every) for size in one["flow"].shape[:2])
            grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
            moved = one["flow"][grid[:, 1], grid[:, 0]]
            gel = np.isfinite(moved).all(axis=1)
            recording.log(f"{camera}/motion", rr.Arrows2D(origins=grid[gel] + 0.5, vectors=moved[gel]))
            for channel in one.keys() - {"rgb", "marker", "marker_visible"}:
                recording.log(f"{camera}/{channel}", rr.Tensor(one[channel]))
        recording.log("force_n", rr.Scalars(wrench[frame, :3]))
        recording.log("torque_nmm", rr.Scalars(wrench[frame, 3:]))
        for column in ("contact_area_mm2", "slip_ratio"):
            recording.log(column, rr.Scalars(clip.states[column][frame]))
    recording.flush()
