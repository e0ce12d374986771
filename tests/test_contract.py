"""What synth writes, gelflow reads: the two programs share nothing but these files."""

import numpy as np
import pytest

from gelflow.data.open import open_pairs
from synth.dataset.job import Job
from synth.dataset.sample import Sample
from synth.dataset.writer import DatasetWriter
from synth.flow.field import FlowField
from synth.scene import Scene
from synth.surface import ContactFaces, GelSurface

HEIGHT, WIDTH = 40, 48
SCENE = {
    "name": "contract",
    "sensor": {
        "gel": {"size_mm": [4.0, 3.0, 1.0], "youngs_modulus_kpa": 100.0},
        "pattern": {"kind": "none"},
        "lights": [{"position_mm": [0.0, 0.0, 0.5], "size_mm": [1.0, 1.0], "color": [1.0, 1.0, 1.0], "power": 1.0}],
        "camera": {"width": WIDTH, "height": HEIGHT, "fx": 80, "fy": 80, "cx": 24, "cy": 20, "position_mm": [0, 0, 20]},
    },
    "contact": {"indenter": {"shape": "sphere", "radius_mm": 1.0}},
    "motion": {"depth_mm": 0.1},
}
JOB = Job(scene=SCENE, scene_name="contract", scene_hash="0", seed=1, n=3)


def _sample(index: int, dtype: type) -> Sample:
    """Random images and fields: any exchange of channels, directions, rows or columns shows."""
    rng = np.random.default_rng(index)
    full = np.iinfo(dtype).max
    image1, image2 = rng.integers(0, full, (2, HEIGHT, WIDTH, 3), endpoint=True).astype(dtype)
    forward, backward = rng.normal(0, 5, (2, HEIGHT, WIDTH, 2)).astype(np.float32)
    seen, seen_back = (rng.random((2, HEIGHT, WIDTH)) < 0.7).astype(np.float32)
    gap = np.zeros((HEIGHT, WIDTH), np.bool_)
    gap[3:6, 7:9] = True
    forward[gap] = np.nan
    seen[gap] = 0
    nodes = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float64)
    return Sample(
        index=index,
        trajectory=0,
        frames=(0, 1),
        seed=1,
        image1=image1,
        image2=image2,
        flow=FlowField(forward, seen, backward, seen_back),
        scene=Scene.model_validate(SCENE),
        surface=GelSurface(ContactFaces(nodes, np.array([[0, 2, 1]], np.int32))),
        displacement1=np.zeros((3, 3)),
        displacement2=np.zeros((3, 3)),
    )


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_gelflow_reads_what_synth_writes(tmp_path, dtype):
    samples = [_sample(index, dtype) for index in (0, 2)]
    with DatasetWriter(tmp_path / "d", JOB) as writer:
        for sample in samples:
            writer.write(sample)
    pairs = open_pairs(tmp_path / "d")
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


def test_both_directions(tmp_path):
    sample = _sample(0, np.uint8)
    with DatasetWriter(tmp_path / "d", JOB) as writer:
        writer.write(sample)
    back = open_pairs(tmp_path / "d").both_directions()[1]
    np.testing.assert_array_equal(np.moveaxis(back["flow"].numpy(), 0, -1), sample.flow.backward)
    np.testing.assert_array_equal(back["visible"].numpy()[0], sample.flow.backward_visible)
    np.testing.assert_allclose(np.moveaxis(back["image1"].numpy(), 0, -1), sample.image2 / 255, atol=2.0**-23)


def test_unfinished_samples_do_not_count(tmp_path):
    """A run that was killed: a folder without a line, a hidden partial folder, a torn line."""
    with DatasetWriter(tmp_path / "d", JOB) as writer:
        writer.write(_sample(1, np.uint8))
    (tmp_path / "d" / "samples" / "000000").mkdir()
    (tmp_path / "d" / "samples" / ".000002.partial-1").mkdir()
    with (tmp_path / "d" / "manifest.jsonl").open("a") as file:
        file.write('{"index": 2, "traj')
    assert open_pairs(tmp_path / "d").names == ["000001"]
