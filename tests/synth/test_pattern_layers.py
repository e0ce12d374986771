"""Matt marks above a shining coating: each layer reflects as itself, and no pattern changes the flow."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from render_scenes import FAST, VARIANTS, needs_llvm, rendered, small_sensor

from synth.arrays import Image
from synth.dataset.reader import read_dataset
from synth.flow.field import FlowField
from synth.pipeline.generate import generate
from synth.render.pattern import albedo
from synth.render.variant import Variant
from synth.scene import Coating, Dots, Light, NoPattern, Sensor, Speckle
from synth.scene.template import load_scene

SHINING = Coating(reflectance=(0.6, 0.55, 0.5), roughness=0.3, metallic=0.9)
LAMP = Light(position_mm=(5.0, 0.0, 5.5), aim_mm=(2.0, 0.0, 0.0), size_mm=(1.0, 1.0), color=(1, 0.9, 0.8), power=100)
"""The mirror image of it in the flat face is seen about 4 mm right of the middle."""
INK = (0.05, 0.06, 0.08)


def _sensor(layer: str, coating: Coating = SHINING) -> Sensor:
    dots = Dots(kind="dots", spacing_mm=(2.0, 2.0), radius_mm=0.6, reflectance=INK, layer=layer, softness_mm=0.05)
    return small_sensor(pattern=dots, lights=(LAMP,)).model_copy(update={"coating": coating})


def _render(sensor: Sensor, texture: Image | None = None, variant: Variant = FAST) -> Image:
    texture = albedo(sensor, np.random.default_rng(0)) if texture is None else texture
    return rendered(sensor, texture, variant=variant, seed=1)


def _bare(coating: Coating, variant: Variant) -> Image:
    sensor = _sensor("in_coating", coating).model_copy(update={"pattern": NoPattern(kind="none")})
    return _render(sensor, variant=variant)


def _inside_and_outside(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (H, W) that show nothing but a dot, or nothing but coating, by the geometry of the pinhole alone."""
    camera = sensor.camera
    scale = camera.fx / camera.position_mm[2]
    x = (np.arange(camera.width) + 0.5 - camera.cx) / scale + camera.position_mm[0]
    y = (np.arange(camera.height) + 0.5 - camera.cy) / scale + camera.position_mm[1]
    distance = np.hypot((x[None] + 1) % 2 - 1, (y[:, None] + 1) % 2 - 1)
    margin = 0.05 / 2 + 0.8 / scale  # the soft edge, and more than half a pixel's diagonal
    return distance < 0.6 - margin, distance > 0.6 + margin


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_each_layer_reflects_as_itself(variant: Variant) -> None:
    image = _render(_sensor("above_coating"), variant=variant)
    inside, outside = _inside_and_outside(_sensor("above_coating"))
    assert inside.sum() > 200
    assert outside.sum() > 1000
    ink, coating = _bare(Coating(reflectance=INK), variant), _bare(SHINING, variant)
    # Equal seeds give equal samples: where one layer is alone, only rounding in float32 may differ.
    assert image[inside] == pytest.approx(ink[inside], rel=1e-5)
    assert image[outside] == pytest.approx(coating[outside], rel=1e-5)
    # Half covered it is their mean. A small lamp's light is found by choosing points on it; now and then by the lobe,
    # whose samples differ in the blend: of 4800 pixels with 36 samples less than 1 % of the mean is left.
    half = np.broadcast_to(np.array([*INK, 0.5], dtype=np.float32), (4, 4, 4))
    mixed = _render(_sensor("above_coating"), half, variant)
    assert mixed.mean() == pytest.approx((ink.mean() + coating.mean()) / 2, rel=0.01)


def test_matt_dots_lack_the_highlight() -> None:
    inside, _ = _inside_and_outside(_sensor("above_coating"))
    highlight = _bare(SHINING, FAST)[:, :, 1] / _bare(Coating(reflectance=SHINING.reflectance), FAST)[:, :, 1]
    shines = inside & (highlight > 0.8 * highlight.max())
    assert shines.sum() >= 5
    matt, glossy = (_render(_sensor(layer))[:, :, 1] for layer in ("above_coating", "in_coating"))
    lambertian = _bare(Coating(reflectance=INK), FAST)[:, :, 1]
    assert matt[shines] == pytest.approx(lambertian[shines], rel=1e-5)
    # In the coating a dot keeps a share of the shine; seen: 21 times as bright as matt ink.
    assert glossy[shines].mean() > 10 * lambertian[shines].mean()


def test_on_a_matt_coating_both_layers_are_one() -> None:
    """The saving of one layer's sampling: what is blended is equal in kind."""
    matt = Coating(reflectance=(0.6, 0.55, 0.5))
    layers = ("in_coating", "above_coating")
    first, second = (albedo(_sensor(layer, matt), np.random.default_rng(0)) for layer in layers)
    assert np.array_equal(first, second)
    shining = albedo(_sensor("above_coating"), np.random.default_rng(0))
    assert shining.shape == (*first.shape[:2], 4)
    # The same marks in the same places: blending by hand gives the one texture from the other.
    by_hand = np.array(matt.reflectance) * (1 - shining[:, :, 3:]) + shining[:, :, :3] * shining[:, :, 3:]
    assert by_hand == pytest.approx(first, abs=1e-6)


@needs_llvm
def test_grey_layers_look_the_same_in_one_channel() -> None:
    grey = Coating(reflectance=(0.5, 0.5, 0.5), roughness=0.4, metallic=0.8)
    pattern = Speckle(kind="speckle", grain_mm=0.8, reflectance=(0.1, 0.1, 0.1), layer="above_coating")
    sensor = small_sensor(pattern=pattern).model_copy(update={"coating": grey})
    color = _render(sensor)
    mono = _render(sensor, variant=Variant("llvm_ad_mono", "test", llvm=FAST.llvm))
    # The same samples; only the luminance weights round differently.
    assert mono == pytest.approx(color, rel=1e-5)


FIXED = [
    "sensor.gel.youngs_modulus_kpa=200", "sensor.camera.cx=16", "contact.friction=0.5", "motion.depth_mm=0.3",
    "contact.indenter.radius_mm=2", "motion.position_mm=[0.3, -0.2]", "motion.shear_mm=[0.1, 0]",
    "sampling.pairs_per_trajectory=1", "outputs.depth=true", "outputs.normal=true",
]  # fmt: skip
PATTERNS = [
    ["sensor.coating={ roughness = 0.3, metallic = 0.9 }", 'sensor.pattern={ kind = "dots", spacing_mm = [1, 1], '
     'radius_mm = 0.3, shape = "diamond", layer = "above_coating" }'],
    ['sensor.pattern={ kind = "bitmap", file = "FILE", width_mm = 5 }'],
]  # fmt: skip


@pytest.mark.usefixtures("one_cache")
def test_flow_does_not_depend_on_the_pattern(tiny: Path, tmp_path: Path) -> None:
    """Every channel of flow.exr has the same bits under a bitmap on matt and dots on shining coating."""
    picture = tmp_path / "mine.png"
    cv2.imwrite(str(picture), np.random.default_rng(0).integers(0, 256, (20, 20, 3), np.uint8))
    samples = []
    for k, pattern in enumerate(PATTERNS):
        overrides = [*FIXED, *(text.replace("FILE", picture.as_posix()) for text in pattern)]
        generate(load_scene(tiny, overrides), 1, tmp_path / str(k), seed=3)
        samples.append(read_dataset(tmp_path / str(k)).read(0))
    channels = [_channels(sample.flow) for sample in samples]
    assert np.nanmax(np.abs(channels[0]["forward"])) > 0.1
    assert len(channels[0]) > 6
    assert not np.array_equal(samples[0].image2, samples[1].image2)
    np.testing.assert_equal(channels[1], channels[0])


def _channels(flow: FlowField) -> dict[str, np.ndarray]:
    own = {"forward": flow.forward, "visible": flow.forward_visible, "backward": flow.backward}
    return {**own, "backward_visible": flow.backward_visible, **flow.extras}
