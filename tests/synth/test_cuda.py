"""What runs on a GPU must give what the CPU gives. Skipped where there is no NVIDIA GPU with OptiX."""

from pathlib import Path

import numpy as np
import pytest

from synth.dataset.reader import read_dataset
from synth.errors import InputError
from synth.pipeline.generate import Scheduling, generate
from synth.render.variant import Variant, choose_variant
from synth.scene.template import load_scene
from synth.verify import verify_dataset

CAMERA = {"width": 64, "height": 48, "fx": 90.0, "fy": 90.0, "cx": 32.0, "cy": 24.0}
TINY = [f"sensor.camera.{name}={value}" for name, value in CAMERA.items()]
TINY += ["render.samples_per_pixel=144", "motion.steps=2", "motion.depth_mm=0.25", "motion.shear_mm=[0.2, 0.1]"]
TINY += ['contact.indenter={shape="sphere", radius_mm=4.0}']


@pytest.fixture(scope="module")
def cuda() -> Variant:
    try:
        return choose_variant("cuda")
    except InputError as error:
        pytest.skip(str(error))


@pytest.mark.cuda
def test_generated_on_a_gpu_verifies_and_agrees_with_the_cpu(cuda: Variant, tmp_path: Path) -> None:
    template = load_scene("gelsight_mini", [*TINY, "numerics.target_error_px=5.0", "numerics.solver=single"])
    generate(template, 2, tmp_path / "cuda", variant=cuda)
    generate(template, 2, tmp_path / "cpu", variant=choose_variant("cpu"))
    assert verify_dataset(tmp_path / "cuda").ok
    on_gpu, on_cpu = (read_dataset(tmp_path / name).read(0) for name in ("cuda", "cpu"))
    # Same solver and tracer on the CPU: the same flow. Images differ by rendering and its noise: 144 samples leave less
    # than 2 % of the signal, and the camera's own noise is the same draw: the mean of 3072 pixels agrees to 1 level.
    np.testing.assert_allclose(on_gpu.flow.forward, on_cpu.flow.forward, atol=1e-3)
    difference = on_gpu.image2.astype(float) - on_cpu.image2
    assert abs(difference.mean()) < 1
    assert np.abs(difference).mean() < 4


@pytest.mark.cuda
def test_batched_on_a_gpu_with_workers_verifies_and_agrees_with_the_cpu(cuda: Variant, tmp_path: Path) -> None:
    """The whole way: solver's thread, renderer, worker processes; on the CPU one thing after another."""
    template = load_scene("gelsight_mini", [*TINY, 'numerics.solver="batched"', "numerics.cells=[6, 4, 2]"])
    generate(template, 6, tmp_path / "cuda", variant=cuda, scheduling=Scheduling(workers=2))
    generate(template, 6, tmp_path / "cpu", variant=choose_variant("cpu"), scheduling=Scheduling(workers=1))
    assert verify_dataset(tmp_path / "cuda").ok
    on_gpu, on_cpu = (read_dataset(tmp_path / name) for name in ("cuda", "cpu"))
    for index in range(6):
        # Displacements of 0.25 mm agree to 3e-5 (docs/reports/batched_fem.md), at some 3 px per mm: 5e-5 px.
        forward = on_gpu.read(index).flow.forward
        np.testing.assert_allclose(forward, on_cpu.read(index).flow.forward, atol=1e-3)
        assert np.isfinite(forward).any()
