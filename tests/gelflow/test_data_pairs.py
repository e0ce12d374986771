"""Opening data sets of every kind, whole and broken."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from textures import as_bytes, moved, write_folder, write_synthetic

from gelflow.data import join, open_pairs
from gelflow.data.pairs import read_markers
from gelflow.errors import InputError
from gelflow.files.exr import read_channels, write_flow


def test_synthetic_sample_has_images_flow_and_visibility(tmp_path: Path) -> None:
    dataset = open_pairs(write_synthetic(tmp_path, [(1.5, -0.5), (0.0, 2.0)]))
    assert dataset.names == ["000000", "000001"]
    sample = dataset[0]
    image1, flow, visible = sample["image1"], sample["flow"], sample["visible"]
    expected = np.moveaxis(as_bytes(moved(64, 80, 0, 0)), -1, 0) / np.float32(255)
    np.testing.assert_array_equal(image1.numpy(), expected.astype(np.float32))
    assert flow.shape == (2, 64, 80)
    assert flow.dtype == torch.float32
    assert visible.shape == (1, 64, 80)
    assert torch.isnan(flow[:, :, :8]).all()
    assert (flow[0, :, 8:] == 1.5).all()
    assert (flow[1, :, 8:] == -0.5).all()
    assert (visible[0, :, 8:-8] == 1).all()
    assert visible.sum() == 64 * 64


def test_samples_of_both_kinds_fit_into_one_batch(tmp_path: Path) -> None:
    synthetic = open_pairs(write_synthetic(tmp_path / "s", [(1, 0)]))
    plain = open_pairs(write_folder(tmp_path / "p", {"a": (0, 1)}))
    assert "flow" not in plain[0]
    both = join([synthetic, plain])
    assert both.names == ["s/000000", "p/a"]
    batch = next(iter(torch.utils.data.DataLoader(both, batch_size=2)))
    assert batch["flow"].shape == (2, 2, 64, 80)
    assert torch.isnan(batch["flow"][1]).all()
    assert not batch["visible"][1].any()


def test_two_folders_of_one_name_keep_their_pairs_apart(tmp_path: Path) -> None:
    folders = [write_folder(tmp_path / parent / "same", {"a": (0, 1)}) for parent in "xy"]
    assert join([open_pairs(folder) for folder in folders]).names == ["same/a", "same-2/a"]


def test_both_directions_exchanges_images_and_takes_the_backward_flow(tmp_path: Path) -> None:
    import OpenEXR

    folder = write_synthetic(tmp_path, [(1, 0)])
    path = folder / "samples" / "000000" / "flow.exr"
    planes = read_channels(path)
    planes |= {f"backward.{c}": -planes[f"forward.{c}"] for c in "UV"}
    planes["backward.visible"] = planes["forward.visible"]
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, planes).write(str(path))
    forward, backward = (open_pairs(folder).both_directions()[k] for k in (0, 1))
    assert torch.equal(forward["image1"], backward["image2"])
    assert torch.equal(forward["image2"], backward["image1"])
    assert torch.equal(forward["flow"][:, :, 8:], -backward["flow"][:, :, 8:])
    assert forward["name"] != backward["name"]


def test_unlisted_sample_and_cut_last_line_do_not_count(tmp_path: Path) -> None:
    folder = write_synthetic(tmp_path, [(1, 0), (2, 0), (3, 0)])
    lines = (folder / "manifest.jsonl").read_text().splitlines(keepends=True)
    (folder / "manifest.jsonl").write_text(lines[2] + lines[0] + lines[1][:9])
    assert open_pairs(folder).names == ["000000", "000002"]


@pytest.mark.parametrize(
    ("file", "content", "word"),
    [
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
    ],
)
def test_broken_synthetic_data_set_is_named(tmp_path: Path, file: str, content: str | None, word: str) -> None:
    folder = write_synthetic(tmp_path, [(1, 0)])
    if content is None:
        (folder / file).unlink()
    else:
        (folder / file).write_text(content)
    with pytest.raises(InputError, match=word):
        open_pairs(folder)


def test_digest_tells_synthetic_data_sets_apart_by_scene_and_seed(tmp_path: Path) -> None:
    folder = write_synthetic(tmp_path, [(1, 0)])
    digests = [open_pairs(folder).digest]
    for origin in ({"scene_hash": "a", "seed": 1}, {"scene_hash": "a", "seed": 2}, {"scene_hash": "b", "seed": 2}):
        (folder / "dataset.json").write_text(json.dumps({"schema_version": 1} | origin))
        digests.append(open_pairs(folder).digest)
    assert len(set(digests)) == 4
    assert open_pairs(folder).digest == digests[-1]


def test_flow_of_another_size_is_named(tmp_path: Path) -> None:
    folder = write_synthetic(tmp_path, [(1, 0)])
    write_flow(folder / "samples" / "000000" / "flow.exr", np.zeros((10, 10, 2), np.float32))
    with pytest.raises(InputError, match=r"flow\.exr.*10 x 10.*80 x 64"):
        open_pairs(folder)[0]


def test_plain_folder_with_markers(tmp_path: Path) -> None:
    folder = write_folder(tmp_path, {"b": (1, 0), "a": (0, 1)})
    (folder / "a_markers.csv").write_text("x1,y1,x2,y2\n1,2,3,4\n5,6,7,8.5\n")
    dataset = open_pairs(folder)
    assert dataset.names == ["a", "b"]
    markers = dataset.markers(0)
    assert markers.tolist() == [[1, 2, 3, 4], [5, 6, 7, 8.5]]
    assert dataset.markers(1) is None
    assert dataset.truth(0) is None


def test_markers_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "markers.csv").write_text("x1,y1,x2,y2\n1,2,3,4\n", encoding="utf-8-sig")
    assert read_markers(tmp_path / "markers.csv").tolist() == [[1, 2, 3, 4]]


@pytest.mark.parametrize(
    "text",
    [
        "x1,y1,x2\n1,2,3\n",
        "x1,y1,x2,y2\n1,2,3,dot\n",
        "x1,y1,x2,y2\n",
        "x1,y1,x2,y2\n1,2,3\n",
        "x1,y1,x2,y2,müde\n1,2,3,4,5\n",  # in Latin-1, see below
        f"x1,y1,x2,y2\n1,2,3,{'4' * 200_000}\n",  # the csv module's limit is 131,072
    ],
)
def test_broken_markers_are_named(tmp_path: Path, text: str) -> None:
    folder = write_folder(tmp_path, {"a": (1, 0)})
    (folder / "a_markers.csv").write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=r"a_markers\.csv"):
        open_pairs(folder).markers(0)


def test_half_a_pair_is_named(tmp_path: Path) -> None:
    folder = write_folder(tmp_path, {"a": (1, 0)})
    (folder / "a_1.png").unlink()
    with pytest.raises(InputError, match=r"a_1\.png"):
        open_pairs(folder)


def test_what_is_no_data_set_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        open_pairs(tmp_path / "nothing")
    with pytest.raises(InputError, match="empty"):
        open_pairs(tmp_path)
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(InputError, match="no image pairs"):
        open_pairs(tmp_path)
    with pytest.raises(InputError, match="is a file"):
        open_pairs(tmp_path / "notes.txt")


def test_unfinished_pair_set_is_refused(tmp_path: Path) -> None:
    (tmp_path / "pairs.json").write_text(json.dumps({"job": {}, "complete": False}))
    with pytest.raises(InputError, match="interrupted"):
        open_pairs(tmp_path)
    (tmp_path / "pairs.json").write_text("{")
    with pytest.raises(InputError, match=r"pairs\.json"):
        open_pairs(tmp_path)
