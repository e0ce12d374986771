"""The shipped weights on pairs that synth simulates and renders, with a pattern and without."""

from pathlib import Path

import pytest

from gelflow.baselines.learned import Learned
from gelflow.data.open import open_pairs
from gelflow.evaluate import evaluate
from gelflow.shipped import weights_file
from synth.pipeline.generate import generate
from synth.scene.template import load_scene

QUICK = ["sampling.pairs_per_trajectory=3", "numerics.target_error_px=2.0", "outputs.backward=false"]


@pytest.mark.parametrize(("scene", "share"), [("digit", 0.5), ("gelsight_mini", 0.2)])
def test_they_find_what_moved(scene: str, share: float, tmp_path: Path) -> None:
    """Endpoint error as a share of the motion: 0.28 and 0.05. Fails with weights that saw little of `digit`: 1.25."""
    generate(load_scene(scene, QUICK), 6, tmp_path / "pairs", seed=4)
    pairs = open_pairs(tmp_path / "pairs")
    scores = evaluate(Learned(weights_file(None), device="cpu"), pairs)
    assert sum(score.endpoint_error_px for score in scores) < share * sum(score.motion_px for score in scores)
