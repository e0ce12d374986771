"""A sample's files, written as a whole. Any process may do it; nothing else of the dataset is touched."""

import hashlib
import shutil
from pathlib import Path

import numpy as np

from synth.dataset.atomic_files import install_folder, partial_name, storage_errors
from synth.dataset.exr import CONVENTIONS, write_flow
from synth.dataset.images import encode_png
from synth.dataset.job import Job
from synth.dataset.jsontext import jsonable, to_document
from synth.dataset.manifest import ManifestEntry
from synth.dataset.npz import encode_npz
from synth.dataset.sample import Layout, Sample, largest_motion, sample_name
from synth.dataset.store import Output, open_store
from synth.dataset.tracks import MARKERS, MARKERS_FILE, STATES_FILE, encode_table, states_columns, states_of

SOLVER_MEANINGS = {
    "solver.slip_ratio": "of the area in contact, the part that slid over the indenter in the last load step, 0 to 1",
    "solver.contact_area_mm2": "of the deformed contact face, where its gap to the indenter is closed",
}


def write_sample_files(out: Output, sample: Sample, job: Job) -> ManifestEntry:
    """Writes samples/NNNNNN or clips/NNNNNN, in a directory whole or not at all; equal samples give equal bytes.

    An older folder of that number is replaced: without a line in the manifest it counts as unfinished. The dataset was
    opened by a `DatasetWriter` of some process. The job is for the header of flow files. Returns what
    `DatasetWriter.record` appends to the manifest, but for the times. InputError where the storage refuses (disk full,
    no permission).
    """
    layout = Layout.of(job.scene)
    with open_store(out).placing(f"{layout.folder}/{sample_name(sample.index)}") as folder:
        return _write_folder(folder, sample, job, layout)


def _write_folder(final: Path, sample: Sample, job: Job, layout: Layout) -> ManifestEntry:
    """The sample's folder, written aside, flushed and renamed into place."""
    partial = partial_name(final)
    motions = []
    with storage_errors(final):
        try:
            for name in layout.files(len(sample.frames)):
                (partial / name).parent.mkdir(parents=True, exist_ok=True)
            for camera, seen in sample.cameras.items():
                for frame, image in enumerate(seen.images):
                    (partial / camera / layout.image(frame)).write_bytes(encode_png(image))
                for frame, flow in enumerate(seen.flows, 1):
                    shown = (sample.frames[0], sample.frames[frame])
                    path = partial / camera / layout.flow(frame)
                    write_flow(path, flow, _attributes(sample, job, camera, shown))
                    motions += [largest_motion(flow)] if not camera else []
                if layout.is_of_clips:
                    (partial / camera / MARKERS_FILE).write_bytes(encode_table(MARKERS, seen.markers))
            if layout.is_of_clips:
                rows = states_of(sample.scene, sample.diagnostics["solver"], sample.force_n, sample.torque_nmm)
                columns = states_columns(sample.scene.model_dump())
                (partial / STATES_FILE).write_bytes(encode_table(columns, rows))
            longest = max((motion for motion in motions if motion is not None), default=None)
            (partial / "meta.json").write_bytes(to_document(_meta(sample, job, longest)).encode("utf-8"))
            (partial / "surface.npz").write_bytes(_surface(sample, layout))
            written = sorted(file for file in partial.rglob("*") if file.is_file())
            sha256 = {
                file.relative_to(partial).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest() for file in written
            }
            install_folder(partial, final)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
    return ManifestEntry(
        index=sample.index,
        trajectory=sample.trajectory,
        frames=sample.frames,
        seed=sample.seed,
        sha256=sha256,
        seconds={},
        diagnostics=jsonable(sample.diagnostics),
        force_n=tuple(tuple(row) for row in np.asarray(sample.force_n, np.float64).tolist()),
        torque_nmm=tuple(tuple(row) for row in np.asarray(sample.torque_nmm, np.float64).tolist()),
        max_flow_px=longest,
    )


def _attributes(sample: Sample, job: Job, camera: str, shown: tuple[int, int]) -> dict[str, str | int]:
    """Header attributes of a flow file between two frames. The seed is text: OpenEXR's integers have 32 bits."""
    named = {"camera": camera} if camera else {}
    return {
        **named,
        "scene.name": job.scene_name,
        "scene.hash": job.scene_hash,
        "seed": str(sample.seed),
        "index": sample.index,
        "trajectory": sample.trajectory,
        "frames": f"{shown[0]} {shown[1]}",
        "software": ", ".join(f"{name} {version}" for name, version in job.software.items()),
    }


def _meta(sample: Sample, job: Job, longest: float | None) -> dict[str, object]:
    """meta.json: everything but the times; `longest` is the largest motion, px."""
    main = sample.cameras[""]
    image = main.images[0] if main.images else None
    return {
        "index": sample.index,
        "trajectory": sample.trajectory,
        "frames": sample.frames,
        "seed": sample.seed,
        "scene_hash": job.scene_hash,
        "image": {
            "width": main.size[1],
            "height": main.size[0],
            "channels": None if image is None else 1 if image.ndim == 2 else 3,
            "bits": None if image is None else 8 * image.itemsize,
        },
        "max_flow_px": longest,
        "force_n": sample.force_n,
        "torque_nmm": sample.torque_nmm,
        "diagnostics": sample.diagnostics,
        "conventions": {**CONVENTIONS, **SOLVER_MEANINGS},
        "scene": sample.scene,
    }


def _surface(sample: Sample, layout: Layout) -> bytes:
    """surface.npz: what the flow was traced on, so that it can be derived again without the solver."""
    moved = [np.asarray(displacement, np.float64) for displacement in sample.displacements]
    displacements = {"displacements": np.array(moved)}
    if not layout.is_of_clips:
        displacements = {f"displacement{number}": one for number, one in enumerate(moved, 1)}
    coarse = sample.surface.coarse
    parts = np.array(sample.surface.subdivisions)
    return encode_npz({"nodes": coarse.nodes, "faces": coarse.faces, "subdivisions": parts, **displacements})
