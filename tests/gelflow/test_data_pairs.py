"""Opening data sets of every kind, whole and broken; those of synth as synth writes them."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from synth_samples import synth_sample, write_dataset
from textures import write_folder, write_synthetic

from gelflow.data import join, open_pairs
from gelflow.errors import InputError
from gelflow.files.exr import write_flow


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_gelflow_reads_what_synth_writes(tmp_path: Path, dtype: type) -> None:
    samples = [synth_sample(index, dtype) for index in (0, 2)]
    pairs = open_pairs(write_dataset(tmp_path / "d", samples)).both_directions()
    assert pairs.names[::2] == ["000000", "000002"]
    assert len(set(pairs.names)) == len(pairs) == 4
    for item, sample, back in zip(pairs, (s for s in samples for _ in range(2)), 2 * [False, True], strict=True):
        images = [sample.image1, sample.image2][:: -1 if back else 1]
        for name, image in zip(("image1", "image2"), images, strict=True):
            # float32 in [0, 1]: rounded to at most 2^-24, by one division.
            found = np.moveaxis(item[name].numpy(), 0, -1)
            np.testing.assert_allclose(found, image / np.iinfo(dtype).max, atol=2.0**-23)
        field = sample.flow
        flow, visible = (field.backward, field.backward_visible) if back else (field.forward, field.forward_visible)
        np.testing.assert_array_equal(np.moveaxis(item["flow"].numpy(), 0, -1), flow)
        np.testing.assert_array_equal(item["visible"].numpy()[0], visible)
        assert {item[key].dtype for key in ("image1", "image2", "flow", "visible")} == {torch.float32}


def test_unfinished_samples_do_not_count_and_both_kinds_fit_into_one_batch(tmp_path: Path) -> None:
    """A run that was killed: a folder without a line, a hidden partial folder, a torn line."""
    folder = write_dataset(tmp_path / "d", [synth_sample(1), synth_sample(3)])
    (folder / "samples" / "000000").mkdir()
    (folder / "samples" / ".000002.partial-1").mkdir()
    lines = (folder / "manifest.jsonl").read_text().splitlines(keepends=True)
    (folder / "manifest.jsonl").write_text(lines[1] + lines[0] + '{"index": 2, "traj')
    assert open_pairs(folder).names == ["000001", "000003"]
    synthetic = open_pairs(write_synthetic(tmp_path / "s", [(1, 0)]))
    plain, same = (open_pairs(write_folder(tmp_path / parent / "p", {"a": (0, 1)})) for parent in "xy")
    assert "flow" not in plain[0]
    both = join([synthetic, plain])
    assert both.names == ["s/000000", "p/a"]
    batch = next(iter(torch.utils.data.DataLoader(both, batch_size=2)))
    assert batch["flow"].shape == (2, 2, 64, 80)
    assert torch.isnan(batch["flow"][1]).all()
    assert not batch["visible"][1].any()
    assert join([plain, same]).names == ["p/a", "p-2/a"]


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


def test_digest_tells_scene_and_seed_and_flow_of_another_size_is_named(tmp_path: Path) -> None:
    folder = write_synthetic(tmp_path, [(1, 0)])
    digests = [open_pairs(folder).digest]
    for origin in ({"scene_hash": "a", "seed": 1}, {"scene_hash": "a", "seed": 2}, {"scene_hash": "b", "seed": 2}):
        (folder / "dataset.json").write_text(json.dumps({"schema_version": 1} | origin))
        digests.append(open_pairs(folder).digest)
    assert len(set(digests)) == 4
    assert open_pairs(folder).digest == digests[-1]
    write_flow(folder / "samples" / "000000" / "flow.exr", np.zeros((10, 10, 2), np.float32))
    with pytest.raises(InputError, match=r"flow\.exr.*10 x 10.*80 x 64"):
        open_pairs(folder)[0]


def test_plain_folders_may_have_markers_and_what_is_no_data_set_is_named(tmp_path: Path) -> None:
    folder = write_folder(tmp_path, {"b": (1, 0), "a": (0, 1)})
    # Files of some programs begin with a byte-order mark.
    (folder / "a_markers.csv").write_text("x1,y1,x2,y2\n1,2,3,4\n5,6,7,8.5\n", encoding="utf-8-sig")
    dataset = open_pairs(folder)
    assert dataset.names == ["a", "b"]
    assert dataset.markers(0).tolist() == [[1, 2, 3, 4], [5, 6, 7, 8.5]]
    assert dataset.markers(1) is dataset.truth(0) is None
    (folder / "a_1.png").unlink()
    with pytest.raises(InputError, match=r"a_1\.png"):
        open_pairs(folder)
    notes, empty, unfinished, broken = (tmp_path / name for name in ("notes/a.txt", "empty", "cut", "broken"))
    for folder in (notes.parent, empty, unfinished, broken):
        folder.mkdir()
    notes.write_text("x")
    (unfinished / "pairs.json").write_text(json.dumps({"job": {}, "complete": False}))
    (broken / "pairs.json").write_text("{")
    for path, word in ((tmp_path / "nothing", "no such folder"), (empty, "empty"), (notes.parent, "no image pairs"),
                       (notes, "is a file"), (unfinished, "interrupted"), (broken, r"pairs\.json")):  # fmt: skip
        with pytest.raises(InputError, match=word):
            open_pairs(path)


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
