"""A sample's files, written as a whole. Any process may do it; nothing else of the dataset is touched."""

import hashlib
import shutil
import tempfile
from pathlib import Path

import numpy as np

from synth.dataset.exr import CONVENTIONS, write_flow
from synth.dataset.images import encode_png
from synth.dataset.job import Job
from synth.dataset.jsontext import jsonable, to_document
from synth.dataset.manifest import ManifestEntry
from synth.dataset.npz import encode_npz
from synth.dataset.sample import SAMPLES_FOLDER, Sample, largest_motion, sample_name
from synth.dataset.storage import install_folder, partial_name, storage_errors
from synth.dataset.store import Output, Store

SOLVER_MEANINGS = {
    "solver.slip_ratio": "of the area in contact, the part that slid over the indenter in the last load step, 0 to 1",
    "solver.contact_area_mm2": "of the deformed contact face, where its gap to the indenter is closed",
}


def write_sample_files(out: Output, sample: Sample, job: Job) -> ManifestEntry:
    """Writes samples/NNNNNN, in a directory whole or not at all; equal samples give equal bytes (without times).

    An older folder of that number is replaced: without a line in the manifest it counts as unfinished. The dataset was
    opened by a `DatasetWriter` of some process; under a URL the files are made in a folder of this machine's temporary
    space and copied. The job is for the header of flow.exr. Returns what `DatasetWriter.record` appends to the
    manifest, but for the times. InputError where the storage refuses (disk full, no permission).
    """
    store, name = Store(out), f"{SAMPLES_FOLDER}/{sample_name(sample.index)}"
    if store.directory is not None:
        return _write_folder(store.directory / name, sample, job)
    with tempfile.TemporaryDirectory(prefix="synth-") as temporary:
        entry = _write_folder(Path(temporary) / name, sample, job)
        store.put(Path(temporary) / name, name)
    return entry


def _write_folder(final: Path, sample: Sample, job: Job) -> ManifestEntry:
    """The sample's folder, written aside, flushed and renamed into place."""
    partial = partial_name(final)
    files = {"meta.json": to_document(_meta(sample, job)).encode("utf-8"), "surface.npz": _surface(sample)}
    views = {"": sample, **sample.further}
    with storage_errors(final):
        try:
            partial.mkdir(parents=True)
            for name, content in files.items():
                (partial / name).write_bytes(content)
            for camera, pair in views.items():
                (partial / camera).mkdir(exist_ok=True)
                for name, image in (("image1.png", pair.image1), ("image2.png", pair.image2)):
                    (partial / camera / name).write_bytes(encode_png(image))
                write_flow(partial / camera / "flow.exr", pair.flow, _attributes(sample, job, camera))
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
        max_flow_px=largest_motion(sample.flow),
    )


def _attributes(sample: Sample, job: Job, camera: str) -> dict[str, str | int]:
    """Header attributes of flow.exr. The seed is text: OpenEXR's integers have 32 bits."""
    named = {"camera": camera} if camera else {}
    return {
        **named,
        "scene.name": job.scene_name,
        "scene.hash": job.scene_hash,
        "seed": str(sample.seed),
        "index": sample.index,
        "trajectory": sample.trajectory,
        "frames": f"{sample.frames[0]} {sample.frames[1]}",
        "software": ", ".join(f"{name} {version}" for name, version in job.software.items()),
    }


def _meta(sample: Sample, job: Job) -> dict[str, object]:
    """meta.json: everything but the times."""
    height, width = sample.image1.shape[:2]
    return {
        "index": sample.index,
        "trajectory": sample.trajectory,
        "frames": sample.frames,
        "seed": sample.seed,
        "scene_hash": job.scene_hash,
        "image": {
            "width": width,
            "height": height,
            "channels": 1 if sample.image1.ndim == 2 else 3,
            "bits": 8 * sample.image1.itemsize,
        },
        "max_flow_px": largest_motion(sample.flow),
        "force_n": sample.force_n,
        "torque_nmm": sample.torque_nmm,
        "diagnostics": sample.diagnostics,
        "conventions": {**CONVENTIONS, **SOLVER_MEANINGS},
        "scene": sample.scene,
    }


def _surface(sample: Sample) -> bytes:
    """surface.npz: what the flow was traced on, so that it can be derived again without the solver."""
    return encode_npz(
        {
            "nodes": sample.surface.coarse.nodes,
            "faces": sample.surface.coarse.faces,
            "subdivisions": np.array(sample.surface.subdivisions),
            "displacement1": np.asarray(sample.displacement1, np.float64),
            "displacement2": np.asarray(sample.displacement2, np.float64),
        }
    )
