"""What synth writes, gelflow reads: the two programs share nothing but these files."""

from pathlib import Path

import numpy as np
import pytest
from synth_samples import synth_sample, write_dataset

from gelflow.data.open import open_pairs


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_gelflow_reads_what_synth_writes(tmp_path: Path, dtype: type) -> None:
    samples = [synth_sample(index, dtype) for index in (0, 2)]
    pairs = open_pairs(write_dataset(tmp_path / "d", samples))
    assert len(pairs) == 2
    for number, sample in enumerate(samples):
        item = pairs[number]
        assert item["name"] == f"{sample.index:06d}"
        for name in ("image1", "image2"):
            expected = getattr(sample, name).astype(np.float64) / np.iinfo(dtype).max
            found = np.moveaxis(item[name].numpy(), 0, -1)
            # float32 in [0, 1]: rounded to at most 2^-24, by one division.
            np.testing.assert_allclose(found, expected, atol=2.0**-23)
        np.testing.assert_array_equal(np.moveaxis(item["flow"].numpy(), 0, -1), sample.flow.forward)
        np.testing.assert_array_equal(item["visible"].numpy()[0], sample.flow.forward_visible)


def test_both_directions(tmp_path: Path) -> None:
    sample = synth_sample(0)
    back = open_pairs(write_dataset(tmp_path / "d", [sample])).both_directions()[1]
    np.testing.assert_array_equal(np.moveaxis(back["flow"].numpy(), 0, -1), sample.flow.backward)
    np.testing.assert_array_equal(back["visible"].numpy()[0], sample.flow.backward_visible)
    np.testing.assert_allclose(np.moveaxis(back["image1"].numpy(), 0, -1), sample.image2 / 255, atol=2.0**-23)


def test_unfinished_samples_do_not_count(tmp_path: Path) -> None:
    """A run that was killed: a folder without a line, a hidden partial folder, a torn line."""
    folder = write_dataset(tmp_path / "d", [synth_sample(1)])
    (folder / "samples" / "000000").mkdir()
    (folder / "samples" / ".000002.partial-1").mkdir()
    with (folder / "manifest.jsonl").open("a") as file:
        file.write('{"index": 2, "traj')
    assert open_pairs(folder).names == ["000001"]
