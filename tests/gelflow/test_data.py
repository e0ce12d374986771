"""Images, flow files and data sets of every kind, whole and broken; those of synth as synth writes them."""

import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from commands import refused
from PIL import ExifTags, Image, ImageOps
from samples import synth_sample, write_dataset
from textures import as_bytes, moved, save, write_folder, write_synthetic

from gelflow.arrays import FlowArray
from gelflow.data import PairDataset, open_all
from gelflow.files.exr import read_channels, read_flow, write_flo, write_flow
from gelflow.files.image import read_image, read_pair, write_png


def some_flow() -> FlowArray:
    flow = np.random.default_rng(0).normal(size=(17, 23, 2)).astype(np.float32)
    flow[2, 3] = np.nan
    return flow


def test_opencv_reads_our_flo_and_exr_keeps_every_bit(tmp_path: Path) -> None:
    write_flo(tmp_path / "a.flo", some_flow())
    found = cv2.readOpticalFlow(str(tmp_path / "a.flo"))
    np.testing.assert_array_equal(np.where(found > 1e9, np.nan, found), some_flow())
    visible = np.ones((17, 23), bool)
    visible[5] = False
    write_flow(tmp_path / "a.exr", some_flow(), visible)
    field = read_flow(tmp_path / "a.exr")
    np.testing.assert_array_equal(field.flow, some_flow())
    visible[2, 3] = False  # no gel there
    np.testing.assert_array_equal(field.visible, visible)
    assert sorted(read_channels(tmp_path / "a.exr")) == ["forward.U", "forward.V", "forward.visible"]
    refused(r"a\.exr.*backward\.U", read_flow, tmp_path / "a.exr", "backward")


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.exr"])
def test_truncated_missing_and_foreign_files_are_named(tmp_path: Path, capfd, name: str) -> None:
    path = tmp_path / name
    read = read_flow if path.suffix == ".exr" else read_image
    refused(name, read, path)
    if path.suffix == ".exr":
        write_flow(path, some_flow())
    else:
        save(path, moved(40, 50, 0, 0))
    read(path)
    data = path.read_bytes()
    cut = (data[: int(share * len(data))] for share in (0, 0.02, 0.3, 0.7, 0.99))
    for broken in (*cut, b"something else" * 20):
        path.write_bytes(broken)
        refused(name, read, path)
    assert capfd.readouterr() == ("", "")  # the libraries below keep quiet


def test_grey_and_alpha_are_read_and_a_flipped_bit_two_sizes_and_one_pixel_refused(tmp_path: Path) -> None:
    rgb = as_bytes(moved(20, 30, 0, 0))
    assert cv2.imwrite(str(tmp_path / "grey.png"), rgb[..., 0])
    assert cv2.imwrite(str(tmp_path / "alpha.png"), np.dstack([rgb[..., ::-1], rgb[..., 0]]))
    write_png(tmp_path / "new" / "a.png", rgb)
    for name, expected in (("grey", np.dstack([rgb[..., 0]] * 3)), ("alpha", rgb), ("new/a", rgb)):
        np.testing.assert_array_equal(np.rint(read_image(tmp_path / f"{name}.png") * 255), expected)
    save(tmp_path / "a.png", moved(40, 50, 0, 0))
    data = bytearray((tmp_path / "a.png").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "a.png").write_bytes(data)
    refused(r"a\.png.*damaged", read_image, tmp_path / "a.png")
    for name, size in (("d", (20, 30)), ("b", (20, 31)), ("c", (1, 1))):
        save(tmp_path / f"{name}.png", moved(*size, 0, 0))
    refused(r"30 x 20 px.*31 x 20 px", read_pair, tmp_path / "d.png", tmp_path / "b.png")
    refused(r"c\.png: 1 x 1 px", read_pair, tmp_path / "c.png", tmp_path / "c.png")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_photograph_is_turned_as_its_exif_says(tmp_path: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    # Two decoders of one JPEG file differ in how they enlarge its colours.
    for name, tolerance in (("a.png", 1e-3), ("a.jpg", 8)):
        Image.fromarray(as_bytes(moved(24, 40, 0, 0))).save(tmp_path / name, exif=exif, quality=95)
        turned = np.asarray(ImageOps.exif_transpose(Image.open(tmp_path / name)))
        np.testing.assert_allclose(read_image(tmp_path / name) * 255, turned, rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_gelflow_reads_what_synth_writes(tmp_path: Path, dtype: type) -> None:
    samples = [synth_sample(index, dtype) for index in (0, 2)]
    pairs = PairDataset(folder := write_dataset(tmp_path / "d", samples))
    assert pairs.names == ["000000", "000002"]
    for item, sample in zip(pairs, samples, strict=True):
        for name, image in (("image1", sample.image1), ("image2", sample.image2)):
            # float32 in [0, 1]: rounded to at most 2^-24, by one division.
            found = np.moveaxis(item[name].numpy(), 0, -1)
            np.testing.assert_allclose(found, image / np.iinfo(dtype).max, atol=2.0**-23)
        np.testing.assert_array_equal(np.moveaxis(item["flow"].numpy(), 0, -1), sample.flow.forward)
        np.testing.assert_array_equal(item["visible"].numpy()[0], sample.flow.forward_visible)
        exr = folder / "samples" / str(item["name"]) / "flow.exr"
        np.testing.assert_array_equal(read_flow(exr, "backward").flow, sample.flow.backward)
        assert {item[key].dtype for key in ("image1", "image2", "flow", "visible")} == {torch.float32}


def test_unfinished_samples_do_not_count_and_both_kinds_fit_into_one_batch(tmp_path: Path) -> None:
    """A run that was killed: a folder without a line, a hidden partial folder, a torn line."""
    folder = write_dataset(tmp_path / "d", [synth_sample(1), synth_sample(3)])
    (folder / "samples" / "000000").mkdir()
    (folder / "samples" / ".000002.partial-1").mkdir()
    lines = (folder / "manifest.jsonl").read_text().splitlines(keepends=True)
    (folder / "manifest.jsonl").write_text(lines[1] + lines[0] + '{"index": 2, "traj')
    assert PairDataset(folder).names == ["000001", "000003"]
    synthetic = write_synthetic(tmp_path / "s", [(1, 0)])
    plain, same = (write_folder(tmp_path / parent / "p", {"a": (0, 1)}) for parent in "xy")
    assert "flow" not in PairDataset(plain)[0]
    both = open_all([synthetic, plain])
    assert both.names == ["s/000000", "p/a"]
    batch = next(iter(torch.utils.data.DataLoader(both, batch_size=2)))
    assert batch["flow"].shape == (2, 2, 64, 80)
    assert torch.isnan(batch["flow"][1]).all()
    assert not batch["visible"][1].any()
    assert open_all([plain, same]).names == ["p/a", "p-2/a"]


@pytest.mark.parametrize(("file", "content", "word"), [
    ("dataset.json", None, "dataset.json"),
    ("dataset.json", "{", "dataset.json"),
    ("dataset.json", '{"schema_version": 99}', "99"),
    ("dataset.json", "{}", "schema_version"),
    ("manifest.jsonl", None, "manifest.jsonl"),
    ("manifest.jsonl", "", "no finished sample"),
    ("manifest.jsonl", '{"index": 0}\nrubbish\n', "line 2"),
    ("manifest.jsonl", '{"index": 7}\n', "000007"),
    ("samples/000000/image2.png", None, "image2.png"),
    ("samples/000000/flow.exr", None, "flow.exr"),
])  # fmt: skip
def test_broken_synthetic_data_set_is_named(tmp_path: Path, file: str, content: str | None, word: str) -> None:
    folder = write_synthetic(tmp_path, [(1, 0)])
    if content is None:
        (folder / file).unlink()
    else:
        (folder / file).write_text(content)
    refused(word, PairDataset, folder)


def test_digest_tells_scene_and_seed_and_flow_of_another_size_is_named(tmp_path: Path) -> None:
    folder = write_synthetic(tmp_path, [(1, 0)])
    digests = [PairDataset(folder).digest]
    for origin in ({"scene_hash": "a", "seed": 1}, {"scene_hash": "a", "seed": 2}, {"scene_hash": "b", "seed": 2}):
        (folder / "dataset.json").write_text(json.dumps({"schema_version": 1} | origin))
        digests.append(PairDataset(folder).digest)
    assert len(set(digests)) == 4
    assert PairDataset(folder).digest == digests[-1]
    # Runs of training keep the digest and compare it when they are resumed: its text is a format.
    known = json.dumps([["000000", None, "b, 2"]])
    assert digests[-1] == hashlib.sha256(known.encode()).hexdigest()
    scene = {"name": "toy", "sensor": {"pattern": {"kind": "none"}}}
    (folder / "dataset.json").write_text(json.dumps({"schema_version": 1, "scene": scene}))
    assert PairDataset(folder)[0]["bare"] is True
    known = json.dumps([["000000", "toy, none", None]])
    assert PairDataset(folder).digest == hashlib.sha256(known.encode()).hexdigest()
    write_flow(folder / "samples" / "000000" / "flow.exr", np.zeros((10, 10, 2), np.float32))
    refused(r"flow\.exr.*10 x 10.*80 x 64", PairDataset(folder).__getitem__, 0)
    with pytest.raises(IndexError, match=r"there is no pair 9: .* has 1"):
        PairDataset(folder)[9]


def test_plain_folders_may_have_markers_and_what_is_no_data_set_is_named(tmp_path: Path) -> None:
    folder = write_folder(tmp_path, {"b": (1, 0), "a": (0, 1)})
    # Files of some programs begin with a byte-order mark.
    (folder / "a_markers.csv").write_text("x1,y1,x2,y2\n1,2,3,4\n5,6,7,8.5\n", encoding="utf-8-sig")
    dataset = PairDataset(folder)
    assert (dataset.names, dataset.markers(0).tolist()) == (["a", "b"], [[1, 2, 3, 4], [5, 6, 7, 8.5]])
    assert dataset.markers(1) is dataset.truth(0) is None
    (folder / "a_1.png").unlink()
    refused(r"a_1\.png", PairDataset, folder)
    notes, empty, unfinished, broken = (tmp_path / name for name in ("notes/a.txt", "empty", "cut", "broken"))
    for folder in (notes.parent, empty, unfinished, broken):
        folder.mkdir()
    notes.write_text("x")
    (unfinished / "pairs.json").write_text(json.dumps({"job": {}, "complete": False}))
    (broken / "pairs.json").write_text("{")
    for path, word in ((tmp_path / "nothing", "no such folder"), (empty, "empty"), (notes.parent, "no image pairs"),
                       (notes, "is a file"), (unfinished, "interrupted"), (broken, r"pairs\.json")):  # fmt: skip
        refused(word, PairDataset, path)


@pytest.mark.parametrize("text", [
    "x1,y1,x2\n1,2,3\n",
    "x1,y1,x2,y2\n1,2,3,dot\n",
    "x1,y1,x2,y2\n",
    "x1,y1,x2,y2\n1,2,3\n",
    "x1,y1,x2,y2,müde\n1,2,3,4,5\n",  # in Latin-1, see below
    f"x1,y1,x2,y2\n1,2,3,{'4' * 200_000}\n",  # the csv module's limit is 131,072
])  # fmt: skip
def test_broken_markers_are_named(tmp_path: Path, text: str) -> None:
    folder = write_folder(tmp_path, {"a": (1, 0)})
    (folder / "a_markers.csv").write_text(text, encoding="latin-1")
    refused(r"a_markers\.csv", PairDataset(folder).markers, 0)
