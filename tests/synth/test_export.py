"""Exports against independent readers: OpenCV's .flo, KITTI's formula, NumPy and tarfile."""

import io
import json
import tarfile

import cv2
import numpy as np
import pytest
from commands import refused
from samples import HEIGHT, WIDTH, translation_sample, tree, write_dataset

from synth.dataset.export import export, kitti_png
from synth.dataset.images import read_png

SHIFTS = {0: (1.25, -0.5), 1: (-3.0, 0.3), 3: (0.01, 0.02)}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    samples = (translation_sample(index, shift) for index, shift in SHIFTS.items())
    return write_dataset(tmp_path_factory.mktemp("export") / "d", samples, n=4)


def test_flo_and_npz(dataset, tmp_path) -> None:
    assert export(dataset, "flo", tmp_path / "o") == 3
    for index, shift in SHIFTS.items():
        flow = translation_sample(index, shift).flow
        found = cv2.readOpticalFlow(str(tmp_path / "o" / f"{index:06d}_flow.flo"))
        known = np.isfinite(flow.forward[..., 0])
        np.testing.assert_array_equal(found[known], flow.forward[known])
        assert (found[~known] > 1e9).all()  # Middlebury: unknown.
        back = cv2.readOpticalFlow(str(tmp_path / "o" / "backward" / f"{index:06d}.flo"))
        np.testing.assert_array_equal(back[known], flow.backward[known])
        hidden = read_png(tmp_path / "o" / "occlusions" / f"{index:06d}.png")
        np.testing.assert_array_equal(hidden == 0, flow.forward_visible == 1)
        image = read_png(tmp_path / "o" / f"{index:06d}_img2.png")
        np.testing.assert_array_equal(image, translation_sample(index, shift).image2)
    export(dataset, "npz", tmp_path / "npz")
    sample = translation_sample(1, SHIFTS[1])
    expected = {"forward": sample.flow.forward, "backward_visible": sample.flow.backward_visible}
    expected |= {"image1": sample.image1, **sample.flow.extras}
    with np.load(tmp_path / "npz" / "000001.npz") as found:
        for name, values in expected.items():
            np.testing.assert_array_equal(found[name], values)


def test_webdataset_and_kitti_within_its_range(dataset, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("synth.dataset.export.SAMPLES_PER_SHARD", 2)
    seen: list[tuple[int, int]] = []
    export(dataset, "webdataset", tmp_path / "o", lambda done, total: seen.append((done, total)))
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert sorted(file.name for file in (tmp_path / "o").iterdir()) == ["shard-000000.tar", "shard-000001.tar"]
    with tarfile.open(tmp_path / "o" / "shard-000000.tar") as archive:
        names = archive.getnames()
        keys = [name.split(".")[0] for name in names]  # WebDataset: the key ends at the first dot.
        assert keys == ["000000"] * 7 + ["000001"] * 7  # A sample's members are neighbours.
        forward = np.load(io.BytesIO(archive.extractfile("000001.forward.npy").read()))
        np.testing.assert_array_equal(forward, translation_sample(1, SHIFTS[1]).flow.forward)
        image = cv2.imdecode(np.frombuffer(archive.extractfile("000000.image1.png").read(), np.uint8), cv2.IMREAD_COLOR)
        assert image.shape == (HEIGHT, WIDTH, 3)
        assert json.loads(archive.extractfile("000001.json").read())["index"] == 1
    export(dataset, "kitti", tmp_path / "kitti")
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
def test_same_bytes_every_time(dataset, tmp_path, format):
    for name in "ab":
        export(dataset, format, tmp_path / name)
    assert tree(tmp_path / "a") == tree(tmp_path / "b")


def test_nothing_is_overwritten_and_nothing_half_done(dataset, tmp_path, monkeypatch):
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "mine").write_text("x")
    refused("never overwrites", export, dataset, "flo", tmp_path / "o")

    def fail(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(dataset, "npz", tmp_path / "p", fail)
    assert [entry.name for entry in tmp_path.iterdir()] == ["o"]
    refused("no finished sample", export, write_dataset(tmp_path / "empty", []), "flo", tmp_path / "p")
