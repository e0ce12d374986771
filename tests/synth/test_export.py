"""Exports against the readers of other programs, and all that they must keep."""

import io
import json
import re
import subprocess
import sys
import tarfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import refused, said
from PIL import Image
from samples import HEIGHT, WIDTH, translation_sample, tree, write_dataset

from synth.cli import main
from synth.dataset.export import export, kitti_png
from synth.dataset.exr import OPTIONAL
from synth.dataset.images import read_png

SHIFTS = {0: (1.25, -0.5), 1: (-3.0, 0.3), 3: (0.01, 0.02)}


@pytest.fixture(scope="module")
def shifted(tmp_path_factory):
    samples = (translation_sample(index, shift) for index, shift in SHIFTS.items())
    return write_dataset(tmp_path_factory.mktemp("export") / "d", samples, n=4)


def flying_chairs(root: Path) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Images and flow as torchvision's FlyingChairs (0.29) lists and opens them; so does RAFT, but for the split."""
    images, flows = sorted((root / "data").glob("*.ppm")), sorted((root / "data").glob("*.flo"))
    split = np.loadtxt(root / "FlyingChairs_train_val.txt", dtype=np.int32)
    kept = [k for k in range(len(flows)) if split[k] == 1]
    opened = [[np.array(Image.open(image).convert("RGB")) for image in images[2 * k : 2 * k + 2]] for k in kept]
    return [(*pair, cv2.readOpticalFlow(str(flows[k]))) for k, pair in zip(kept, opened, strict=True)]


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize(
    ("dtype", "grey"), [(np.uint8, False), (np.uint8, True), (np.uint16, False), (np.uint16, True)]
)
def test_flo_opens_as_flying_chairs(tmp_path, dtype, grey, count) -> None:
    samples = [translation_sample(index, SHIFTS[index], dtype=dtype, grey=grey) for index in list(SHIFTS)[:count]]
    export(write_dataset(tmp_path / "d", samples, n=4), "flo", tmp_path / "o")
    for sample, (image1, image2, found) in zip(samples, flying_chairs(tmp_path / "o"), strict=True):
        for image, stored in ((image1, sample.image1), (image2, sample.image2)):
            colours = np.broadcast_to(stored.reshape(HEIGHT, WIDTH, -1), image.shape)
            # Rounded from 16 bits to 8: half a step.
            np.testing.assert_allclose(image, colours / (np.iinfo(dtype).max / 255), rtol=0, atol=0.5)
        known = np.isfinite(sample.flow.forward[..., 0])
        np.testing.assert_array_equal(found[known], sample.flow.forward[known])
        assert (found[~known] > 1e9).all()  # Middlebury: unknown.
        name = f"{sample.index:06d}"
        back = cv2.readOpticalFlow(str(tmp_path / "o" / "backward" / f"{name}.flo"))
        np.testing.assert_array_equal(back[known], sample.flow.backward[known])
        hidden = read_png(tmp_path / "o" / "occlusions" / f"{name}.png")
        np.testing.assert_array_equal(hidden == 0, sample.flow.forward_visible == 1)
        whole = cv2.imread(str(tmp_path / "o" / "data" / f"{name}_img1.ppm"), cv2.IMREAD_UNCHANGED)[..., ::-1]
        np.testing.assert_array_equal(whole, np.broadcast_to(sample.image1.reshape(HEIGHT, WIDTH, -1), whole.shape))


def arrays_in(out: Path, format: str, name: str) -> dict[str, np.ndarray]:
    if format == "webdataset":
        with tarfile.open(out / "shard-000000.tar") as archive:
            members = [member for member in archive if member.name.startswith(name)]
            parts = {m.name.removeprefix(f"{name}."): archive.extractfile(m).read() for m in members}
        found = {part[:-4]: np.load(io.BytesIO(data)) for part, data in parts.items() if part.endswith(".npy")}
        return {**found, "meta": np.array(parts["json"].decode())}
    with np.load(out / ("" if format == "npz" else "extra") / f"{name}.npz") as archive:
        return dict(archive)


@pytest.mark.parametrize("format", ["flo", "kitti", "npz", "webdataset"])
def test_every_format_has_channels_forces_and_meta_and_what_it_leaves_out_is_said(tmp_path, capsys, format) -> None:
    samples, rng = [translation_sample(index, shift) for index, shift in SHIFTS.items()], np.random.default_rng(1)
    for sample in samples:
        for name in (name for names, _ in OPTIONAL.values() for name in names):
            sample.flow.extras[name] = rng.normal(size=(HEIGHT, WIDTH)).astype(np.float32)
    data = write_dataset(tmp_path / "d", samples, n=4)
    assert "left out: surface.npz" in said(capsys, main, "export", data, "--format", format, "--out", tmp_path / "o")
    for sample in samples:
        found = arrays_in(tmp_path / "o", format, f"{sample.index:06d}")
        expected = {**sample.flow.extras, "force_n": sample.force_n, "torque_nmm": sample.torque_nmm}
        expected |= {"forward": sample.flow.forward, "backward_visible": sample.flow.backward_visible}
        for name, values in expected.items():
            np.testing.assert_array_equal(found[name], values)
        meta = json.loads((data / "samples" / f"{sample.index:06d}" / "meta.json").read_text())
        assert json.loads(str(found["meta"])) == meta


def test_webdataset_and_kitti_within_its_range(shifted, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("synth.dataset.export.SAMPLES_PER_SHARD", 2)
    seen: list[tuple[int, int]] = []
    export(shifted, "webdataset", tmp_path / "o", lambda done, total: seen.append((done, total)))
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert sorted(file.name for file in (tmp_path / "o").iterdir()) == ["shard-000000.tar", "shard-000001.tar"]
    with tarfile.open(tmp_path / "o" / "shard-000000.tar") as archive:
        names = archive.getnames()
        keys = [name.split(".")[0] for name in names]  # WebDataset: the key ends at the first dot.
        assert keys == ["000000"] * 10 + ["000001"] * 10  # A sample's members are neighbours.
        forward = np.load(io.BytesIO(archive.extractfile("000001.forward.npy").read()))
        np.testing.assert_array_equal(forward, translation_sample(1, SHIFTS[1]).flow.forward)
        image = cv2.imdecode(np.frombuffer(archive.extractfile("000000.image1.png").read(), np.uint8), cv2.IMREAD_COLOR)
        assert image.shape == (HEIGHT, WIDTH, 3)
        assert json.loads(archive.extractfile("000001.json").read())["index"] == 1
    export(shifted, "kitti", tmp_path / "kitti")
    for index, shift in SHIFTS.items():
        flow = translation_sample(index, shift).flow
        for folder, valid in (("flow_occ", np.isfinite(flow.forward[..., 0])), ("flow_noc", flow.forward_visible == 1)):
            path = tmp_path / "kitti" / "training" / folder / f"{index:06d}_10.png"
            stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert stored.dtype == np.uint16
            flag, v, u = np.moveaxis(stored.astype(np.float64), -1, 0)  # OpenCV: blue first.
            np.testing.assert_array_equal(flag == 1, valid)
            assert set(np.unique(flag)) <= {0, 1}
            # Rounded to 1/64 px: off by half of that at most.
            found = (np.column_stack([u[valid], v[valid]]) - 2**15) / 64
            np.testing.assert_allclose(found, np.broadcast_to(shift, found.shape), rtol=0, atol=1 / 128)
        assert (tmp_path / "kitti" / "training" / "image_2" / f"{index:06d}_11.png").exists()
    flow = np.full((2, 2, 2), 600.0, np.float32)
    refused(r"600\.0 px is beyond the 512 px", kitti_png, flow, np.ones((2, 2), np.bool_))
    kitti_png(flow, np.zeros((2, 2), np.bool_))


@pytest.mark.parametrize("format", ["flo", "kitti", "npz", "webdataset"])
def test_same_bytes_every_time(shifted, tmp_path, format):
    for name in "ab":
        export(shifted, format, tmp_path / name)
    assert tree(tmp_path / "a") == tree(tmp_path / "b")


def test_nothing_is_overwritten_and_nothing_half_done(shifted, tmp_path, monkeypatch):
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "mine").write_text("x")
    refused("never overwrites", export, shifted, "flo", tmp_path / "o")

    def fail(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(shifted, "npz", tmp_path / "p", fail)
    assert [entry.name for entry in tmp_path.iterdir()] == ["o"]
    refused("no finished sample", export, write_dataset(tmp_path / "empty", []), "flo", tmp_path / "p")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert export(shifted, "npz", ".") == 3


@pytest.mark.parametrize("format", ["flo", "kitti", "npz", "webdataset"])
def test_a_full_disk_is_one_line_and_leaves_nothing(shifted, tmp_path, format) -> None:
    """No file beyond 1 KiB: the kernel's own refusal."""
    command = f"exec {sys.executable} -m synth export {shifted} --format {format} --out {tmp_path / 'o'}"
    done = subprocess.run(["bash", "-c", f"ulimit -f 1; {command}"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert re.fullmatch(
        rf"synth: {tmp_path / 'o'}: cannot be written: File too large; nothing is kept .*\n", done.stderr
    )
    assert list(tmp_path.iterdir()) == []
