"""Finished samples in the formats of other programs; equal datasets give equal bytes.

    flo         FlyingChairs' files: data/000000_img1.ppm data/000000_img2.ppm data/000000_flow.flo (forward, Middlebury
                .flo) and FlyingChairs_train_val.txt (all for training); beside them backward/000000.flo and
                occlusions/000000.png (255 where the forward point is hidden)
    kitti       KITTI 2015's folders: training/image_2/000000_{10,11}.png, flow_occ/ and flow_noc/000000_10.png
                (forward; all pixels with gel, and those whose point is seen in image 2)
    npz         000000.npz with image1, image2, and the arrays below
    webdataset  shard-000000.tar of at most 512 samples: 000000.{image1.png, image2.png, json}, the latter meta.json,
                and an .npy of each array below but meta
    hdf5        of clips, as are lerobot and rrd: see `synth.dataset.hdf5`, `lerobot` and `rrd`; the others are of pairs

The arrays are forward, forward_visible, backward, backward_visible, the optional channels by their EXR names, force_n
and torque_nmm (2, 3), per image, and meta, the text of meta.json. In flo and kitti they are in extra/000000.npz. No
format holds surface.npz.

Forward is `I1(x) = I2(x + forward(x))` in every format. A pixel that sees no gel is NaN in npz and webdataset,
Middlebury's "unknown" (above 1e9) in flo and invalid in kitti. KITTI's PNG rounds to 1/64 px (at most 0.0078 px off)
and ends at 512 px.

References: Baker et al., IJCV 2011 (.flo); Menze & Geiger, CVPR 2015 (KITTI flow PNG).
"""

import io
import shutil
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from synth.arrays import BoolArray
from synth.dataset import hdf5, lerobot, rrd
from synth.dataset.atomic_files import PARTIAL
from synth.dataset.images import Raster, encode_png
from synth.dataset.jsontext import to_document
from synth.dataset.npz import encode_npz
from synth.dataset.reader import Dataset, read_dataset
from synth.dataset.sample import further_cameras, sample_name
from synth.dataset.sample_reader import SampleData
from synth.errors import InputError
from synth.flow.field import FlowArray

ExportFormat = Literal["flo", "kitti", "npz", "webdataset", "hdf5", "lerobot", "rrd"]
OF_CLIPS = {"hdf5": hdf5.add_clip, "lerobot": lerobot.add_clip, "rrd": rrd.add_clip}
SAMPLES_PER_SHARD = 512
_UNKNOWN_FLOW = np.float32(1e10)
_KITTI_SCALE, _KITTI_ZERO = 64.0, 32768.0

Progress = Callable[[int, int], None]
"""Called with (samples done, samples in all)."""


def export(
    path: Path | str, format: ExportFormat, out: Path | str, progress: Progress | None = None, camera: str = ""
) -> int:
    """Writes all finished samples of a dataset in another format.

    Args:
        path: the dataset.
        format: see the module's docstring.
        out: a directory that is missing or empty; it appears when everything is written.
        progress: told after each sample.
        camera: the name of a further camera, whose images and flow to write instead of the main camera's.

    Returns:
        How many samples were written.

    Raises:
        InputError: Unknown camera, a format that the samples cannot have, `out` is not empty, no finished sample, a
            damaged file, a flow beyond KITTI's range, or the storage refuses.
    """
    final = Path(out).absolute()
    dataset = read_dataset(path)
    if not dataset.samples:
        raise InputError(f"{dataset.path}: has no finished sample to export")
    if dataset.layout.is_of_clips != (format in OF_CLIPS) or not (dataset.layout.has_images or format in OF_CLIPS):
        held = "clips" if dataset.layout.is_of_clips else "pairs" if dataset.layout.has_images else "no images"
        fitting = {"clips": ", ".join(OF_CLIPS), "pairs": "flo, kitti, npz, webdataset"}
        allowed = fitting.get(held, "none; read it in Python")
        raise InputError(f"{dataset.path}: holds {held}, which --format {format} is not for; allowed: {allowed}")
    if final.exists() and (not final.is_dir() or any(final.iterdir())):
        raise InputError(f"{final}: exists and is not empty; export never overwrites, give another --out")
    partial = final.with_name(f".{final.name}{PARTIAL}export")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        _write_all(dataset, format, partial, progress, camera)
        if final.exists():
            final.rmdir()
        partial.rename(final)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(
            f"{final}: cannot be written: {reason}; nothing is kept of an export that ends early"
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return len(dataset.samples)


def left_out(path: Path | str, camera: str, format: ExportFormat) -> str:
    """What an export of one camera leaves out of a dataset, in words."""
    dataset = read_dataset(path)
    if dataset.layout.is_of_clips:
        return "surface.npz (the gel's surface, for verify), backward flow" + ", markers.csv" * (format == "lerobot")
    cameras = ["the main camera", *further_cameras(dataset.info["scene"])]
    others = [name for name in cameras if name != (camera or cameras[0])]
    return ", ".join(["surface.npz (the gel's surface, for verify)", *(f"pairs of {name}" for name in others)])


def _write_all(dataset: Dataset, format: ExportFormat, out: Path, progress: Progress | None, camera: str) -> None:
    """Writes sample after sample; OSError where the storage refuses."""
    if format == "flo":  # torchvision wants two lines at least
        (out / "FlyingChairs_train_val.txt").write_text("1\n" * max(2, len(dataset.samples)))
    total = len(dataset.samples)
    if format in OF_CLIPS:
        for done, index in enumerate(dataset.samples, 1):
            OF_CLIPS[format](out, {name: dataset.read_clip(index, name) for name in dataset.layout.cameras})
            if progress is not None:
                progress(done, total)
        return
    write = {"flo": _write_flo, "kitti": _write_kitti, "npz": _write_npz, "webdataset": _append_to_shard}[format]
    for done, index in enumerate(dataset.samples):
        source = dataset.folder(index) / camera
        target = out / f"shard-{done // SAMPLES_PER_SHARD:06d}.tar" if format == "webdataset" else out
        write(target, sample_name(index), source, dataset.read(index, camera))
        if progress is not None:
            progress(done + 1, total)


def flo_bytes(flow: FlowArray) -> bytes:
    """Middlebury .flo of a flow (H, W, 2); NaN becomes "unknown"."""
    height, width = flow.shape[:2]
    known = np.where(np.isfinite(flow), flow, _UNKNOWN_FLOW)
    return b"PIEH" + np.array([width, height], "<i4").tobytes() + known.astype("<f4").tobytes()


def kitti_png(flow: FlowArray, valid: BoolArray) -> bytes:
    """KITTI's 16-bit flow PNG, (64 u + 2^15, 64 v + 2^15, valid) as RGB; InputError for a valid flow beyond 512 px."""
    known = valid & np.isfinite(flow).all(axis=-1)
    coded = np.rint(np.where(known[..., None], flow, 0.0).astype(np.float64) * _KITTI_SCALE + _KITTI_ZERO)
    if coded.min() < 0 or coded.max() > 65535:
        raise InputError(
            f"a flow of {np.abs(flow[known]).max():.1f} px is beyond the 512 px of KITTI's format; use another"
        )
    coded = np.where(known[..., None], coded, 0.0)
    return encode_png(np.dstack([coded, known]).astype(np.uint16))


def ppm(image: Raster) -> bytes:
    """Binary PPM of an image, always RGB; 8 or 16 bits, which readers of 8 bits scale."""
    import cv2

    colours = image[..., None].repeat(3, axis=-1) if image.ndim == 2 else image[..., ::-1]
    return bytes(cv2.imencode(".ppm", np.ascontiguousarray(colours))[1])


def _write_flo(out: Path, name: str, source: Path, sample: SampleData) -> None:
    for number, image in enumerate(sample.images, start=1):
        _put(out / "data" / f"{name}_img{number}.ppm", ppm(image))
    _put(out / "data" / f"{name}_flow.flo", flo_bytes(sample.flow.forward))
    hidden = np.where(sample.flow.forward_visible > 0.5, 0, 255).astype(np.uint8)
    _put(out / "occlusions" / f"{name}.png", encode_png(hidden))
    if sample.flow.backward is not None:
        _put(out / "backward" / f"{name}.flo", flo_bytes(sample.flow.backward))
    _put(out / "extra" / f"{name}.npz", encode_npz(_arrays(sample)))


def _write_kitti(out: Path, name: str, source: Path, sample: SampleData) -> None:
    training = out / "training"
    try:
        everywhere = kitti_png(sample.flow.forward, np.ones(sample.flow.forward.shape[:2], np.bool_))
        seen = kitti_png(sample.flow.forward, sample.flow.forward_visible > 0.5)
    except InputError as error:
        raise InputError(f"{source / 'flow.exr'}: {error}") from error
    for number in (1, 2):
        _put(training / "image_2" / f"{name}_{9 + number}.png", (source / f"image{number}.png").read_bytes())
    _put(training / "flow_occ" / f"{name}_10.png", everywhere)
    _put(training / "flow_noc" / f"{name}_10.png", seen)
    _put(out / "extra" / f"{name}.npz", encode_npz(_arrays(sample)))


def _write_npz(out: Path, name: str, source: Path, sample: SampleData) -> None:
    _put(
        out / f"{name}.npz",
        encode_npz({**dict(zip(("image1", "image2"), sample.images, strict=True)), **_arrays(sample)}),
    )


def _append_to_shard(shard: Path, name: str, source: Path, sample: SampleData) -> None:
    members = {f"image{number}.png": (source / f"image{number}.png").read_bytes() for number in (1, 2)}
    arrays = _arrays(sample)
    members["json"] = str(arrays.pop("meta")).encode("utf-8")
    for part, array in arrays.items():
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, np.ascontiguousarray(array), allow_pickle=False)
        members[f"{part}.npy"] = buffer.getvalue()
    with tarfile.open(shard, "a", format=tarfile.USTAR_FORMAT) as archive:
        for suffix, content in members.items():
            info = tarfile.TarInfo(f"{name}.{suffix}")  # Date, owner and group 0: the same bytes every time.
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))


def _arrays(sample: SampleData) -> dict[str, NDArray[Any]]:
    """All but images and surface: float32 flows and channels, uint8 visibilities, float64 forces, meta as text."""
    flow = sample.flow
    arrays: dict[str, NDArray[Any]] = {"forward": flow.forward, "forward_visible": _as_byte(flow.forward_visible)}
    if flow.backward is not None and flow.backward_visible is not None:
        arrays |= {"backward": flow.backward, "backward_visible": _as_byte(flow.backward_visible)}
    known = (name for name in ("force_n", "torque_nmm") if name in sample.meta)
    forces = {name: np.array(sample.meta[name], np.float64) for name in known}
    return {**arrays, **flow.extras, **forces, "meta": np.array(to_document(sample.meta))}


def _as_byte(visible: FlowArray) -> NDArray[np.uint8]:
    return (visible > 0.5).astype(np.uint8)


def _put(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
