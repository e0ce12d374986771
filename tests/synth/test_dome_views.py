"""A domed gel from start to end: the scene `densetact`, small, coarse and noisy, but all of the chain."""

from pathlib import Path

import numpy as np
import pytest
from render_scenes import needs_llvm

from synth.dataset.reader import read_dataset
from synth.pipeline.generate import generate
from synth.scene.template import load_scene
from synth.verify import verify_dataset


@needs_llvm
@pytest.mark.usefixtures("one_cache")
def test_densetact_generates_and_verifies(tmp_path: Path) -> None:
    small = ["width=120", "height=120", "fx=75.0", "fy=75.0", "cx=60.0", "cy=60.0"]
    overrides = [f"sensor.camera.{setting}" for setting in small]
    overrides += ["render.samples_per_pixel=16", "numerics.target_error_px=2.0", "motion.steps=2"]
    overrides += ["contact.indenter={shape='sphere', radius_mm=5.0}", "motion.depth_mm=1.2", "motion.twist_deg=0.0"]
    overrides += ["motion.position_mm=[2.0, -1.5]", "sampling.pairs_per_trajectory=1", "sensor.pattern.grain_mm=1.2"]
    generate(load_scene("densetact", overrides), 1, tmp_path / "out")
    report = verify_dataset(tmp_path / "out")
    checks = {check.name: check for check in report.samples[0].checks}
    assert report.ok, [check for check in checks.values() if not check.passed]
    assert checks["undeformed dome against the sphere"].figure < 0.05
    assert max(checks[f"{way} flow"].figure for way in ("forward", "backward")) < 1e-3
    assert checks["image 2 warped to image 1"].figure is not None
    data = read_dataset(tmp_path / "out").read(0)
    assert np.nanmax(np.abs(data.flow.forward)) > 1
    off = np.linalg.norm(data.surface.material - (0.0, 0.0, 23.0), axis=1) - 23.0
    # Corners inside quadratic faces as wide as 6 mm: t h³ / (72 √3) with a third derivative t of 0.02 / mm².
    assert np.abs(off).max() < 0.04
