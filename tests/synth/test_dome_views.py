"""Domed gels in the picture: flow, visibility and renderings of a curved face; the scene `densetact`, start to end."""

from pathlib import Path

import numpy as np
import pytest
from kinematic_double import FISHEYE, LENS, OBLIQUE, SIDES, dented
from kinematic_double import sensor as flat_sensor
from render_scenes import needs_llvm
from tiny_scene import own_cache
from verified_sample import motion_checks

from synth.arrays import FloatArray
from synth.dataset.reader import read_dataset
from synth.mesh import rest_surface
from synth.pipeline.generate import generate
from synth.scene import Gel, Sensor, Window
from synth.scene.template import load_scene
from synth.verify import verify_dataset

DOME = Gel(shape="dome", size_mm=(20, 15, 8), youngs_modulus_kpa=200, dome_radius_mm=17.0)
"""Slopes up to 47 degrees; 2.5 mm are left at its corners."""
VIEWS = {
    "window": {"index": 1.45, "distortion": LENS, **OBLIQUE},
    "fisheye": {"index": 1.45, **OBLIQUE, **FISHEYE},
    "close fisheye": {"index": 1.41, **FISHEYE, "fx": 34.0, "fy": 34.0, "position_mm": (0.3, -0.2, 12.0)},
    "fisheye and mirrors": {"index": 1.45, "mirrors": SIDES, **FISHEYE, "fx": 35.0, "fy": 35.0},
}


def _sensor(view: dict) -> Sensor:
    """The pad of the flat tests, its window's outer face where it was, with a dome."""
    return flat_sensor(**view).model_copy(
        update={"gel": DOME, "window": Window(refractive_index=view["index"], thickness_mm=1.0)}
    )


@pytest.mark.parametrize("view", VIEWS)
def test_flow_is_the_independent_projections(view: str) -> None:
    sensor, surface = _sensor(VIEWS[view]), rest_surface(DOME)
    for first in (surface.material, dented(surface.material, 0.3)):
        flow, checks = motion_checks(sensor, surface, first, dented(surface.material, 1.1, (0.8, -0.5)))
        assert np.nanmax(np.linalg.norm(flow.forward, axis=2)) > 1.5
        assert np.isfinite(flow.forward[..., 0]).mean() > 0.45  # by mirrors some pixels look beside the pad
        for name, check in checks.items():
            assert check.passed, check
            if name.endswith(("flow", "closure")):
                assert check.figure < 2e-6  # float32 of motions below 16 px; the promise is 1e-3


NAME = "densetact"


@needs_llvm
def test_densetact_generates_and_verifies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Small, coarse and noisy, but all of the chain."""
    own_cache(monkeypatch)
    small = ["width=120", "height=120", "fx=75.0", "fy=75.0", "cx=60.0", "cy=60.0"]
    overrides = [f"sensor.camera.{setting}" for setting in small]
    overrides += ["render.samples_per_pixel=16", "numerics.target_error_px=2.0", "motion.steps=2"]
    overrides += ["contact.indenter={shape='sphere', radius_mm=5.0}", "motion.depth_mm=1.2", "motion.twist_deg=0.0"]
    overrides += ["motion.position_mm=[2.0, -1.5]", "sampling.pairs_per_trajectory=1", "sensor.pattern.grain_mm=1.2"]
    generate(load_scene(NAME, overrides), 1, tmp_path / "out")
    report = verify_dataset(tmp_path / "out")
    checks = {check.name: check for check in report.samples[0].checks}
    assert report.ok, [check for check in checks.values() if not check.passed]
    assert checks["undeformed dome against the sphere"].figure < 0.05
    assert max(checks[f"{way} flow"].figure for way in ("forward", "backward")) < 1e-3
    assert checks["image 2 warped to image 1"].figure is not None
    data = read_dataset(tmp_path / "out").read(0)
    assert np.nanmax(np.abs(data.flow.forward)) > 1
    material: FloatArray = data.surface.material
    off = np.linalg.norm(material - (0.0, 0.0, 23.0), axis=1) - 23.0
    # Corners inside quadratic faces as wide as 6 mm: t h³ / (72 √3) with a third derivative t of 0.02 / mm².
    assert np.abs(off).max() < 0.04
