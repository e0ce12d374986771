"""Finished samples in the formats of other programs; equal datasets give equal bytes.

    flo         FlyingChairs' names: 000000_img1.png 000000_img2.png 000000_flow.flo (forward, Middlebury .flo),
                beside them backward/000000.flo and occlusions/000000.png (255 where the forward point is hidden)
    kitti       KITTI 2015's folders: training/image_2/000000_{10,11}.png, flow_occ/ and flow_noc/000000_10.png
                (forward; all pixels with gel, and those whose point is seen in image 2)
    npz         000000.npz with image1, image2, forward, forward_visible, backward, backward_visible, extras by name
    webdataset  shard-000000.tar of at most 512 samples: 000000.{image1.png, image2.png, forward.npy,
                forward_visible.npy, backward.npy, backward_visible.npy, json}

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
from synth.dataset.images import encode_png
from synth.dataset.jsontext import to_document
from synth.dataset.npz import encode_npz
from synth.dataset.reader import Dataset, SampleData, read_dataset
from synth.dataset.sample import SAMPLES_FOLDER, sample_name
from synth.dataset.storage import PARTIAL, storage_errors
from synth.errors import InputError
from synth.flow.field import FlowArray

ExportFormat = Literal["flo", "kitti", "npz", "webdataset"]
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
        InputError: Unknown camera, `out` is not empty, no finished sample, a damaged file, a flow beyond
            KITTI's range, or the storage refuses.
    """
    final = Path(out)
    dataset = read_dataset(path)
    if not dataset.samples:
        raise InputError(f"{dataset.path}: has no finished sample to export")
    if final.exists() and (not final.is_dir() or any(final.iterdir())):
        raise InputError(f"{final}: exists and is not empty; export never overwrites, give another --out")
    partial = final.with_name(f".{final.name}{PARTIAL}export")
    with storage_errors(final):
        try:
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
            _write_all(dataset, format, partial, progress, camera)
            if final.exists():
                final.rmdir()
            partial.rename(final)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
    return len(dataset.samples)


def _write_all(dataset: Dataset, format: ExportFormat, out: Path, progress: Progress | None, camera: str) -> None:
    """Writes sample after sample; OSError where the storage refuses."""
    write = {"flo": _write_flo, "kitti": _write_kitti, "npz": _write_npz, "webdataset": _append_to_shard}[format]
    total = len(dataset.samples)
    for done, index in enumerate(dataset.samples):
        source = dataset.path / SAMPLES_FOLDER / sample_name(index) / camera
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


def _write_flo(out: Path, name: str, source: Path, sample: SampleData) -> None:
    for number in (1, 2):
        shutil.copyfile(source / f"image{number}.png", out / f"{name}_img{number}.png")
    (out / f"{name}_flow.flo").write_bytes(flo_bytes(sample.flow.forward))
    hidden = np.where(sample.flow.forward_visible > 0.5, 0, 255).astype(np.uint8)
    _put(out / "occlusions" / f"{name}.png", encode_png(hidden))
    if sample.flow.backward is not None:
        _put(out / "backward" / f"{name}.flo", flo_bytes(sample.flow.backward))


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


def _write_npz(out: Path, name: str, source: Path, sample: SampleData) -> None:
    arrays = {"image1": sample.image1, "image2": sample.image2, **_flow_arrays(sample)}
    (out / f"{name}.npz").write_bytes(encode_npz({**arrays, **sample.flow.extras}))


def _append_to_shard(shard: Path, name: str, source: Path, sample: SampleData) -> None:
    members = {f"image{number}.png": (source / f"image{number}.png").read_bytes() for number in (1, 2)}
    for part, array in _flow_arrays(sample).items():
        buffer = io.BytesIO()
        np.lib.format.write_array(buffer, np.ascontiguousarray(array), allow_pickle=False)
        members[f"{part}.npy"] = buffer.getvalue()
    members["json"] = to_document(sample.meta).encode("utf-8")
    with tarfile.open(shard, "a", format=tarfile.USTAR_FORMAT) as archive:
        for suffix, content in members.items():
            info = tarfile.TarInfo(f"{name}.{suffix}")  # Date, owner and group 0: the same bytes every time.
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))


def _flow_arrays(sample: SampleData) -> dict[str, NDArray[Any]]:
    """Float32 flows and uint8 visibilities of the directions that there are."""
    flow = sample.flow
    arrays: dict[str, NDArray[Any]] = {"forward": flow.forward, "forward_visible": _as_byte(flow.forward_visible)}
    if flow.backward is not None and flow.backward_visible is not None:
        arrays |= {"backward": flow.backward, "backward_visible": _as_byte(flow.backward_visible)}
    return arrays


def _as_byte(visible: FlowArray) -> NDArray[np.uint8]:
    return (visible > 0.5).astype(np.uint8)


def _put(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
