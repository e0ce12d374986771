"""Light that the window throws back, against Mitsuba's own dielectric interface, whose paths find it by chance."""

import numpy as np
import pytest
from render_scenes import FAST, needs_llvm, rendered, small_sensor

from synth.arrays import FloatArray
from synth.render.camera_rays import pinhole
from synth.render.lights import emitters
from synth.scene import Light, Render, Sensor

INDEX, REFLECTANCE = 1.45, 0.6
SEEDS = range(4)


def _sensor() -> Sensor:
    """Two wide lights, that chance may find them; the second shines mostly up."""
    places = [((7.0, 1.0, 3.5), (0.0, 0.0, 2.5)), ((-1.0, -7.2, 2.0), (0.0, 3.0, 5.0))]
    common = {"size_mm": (3.0, 1.5), "color": (1, 1, 1), "power": 300}
    lights = tuple(Light(position_mm=at, aim_mm=aim, **common) for at, aim in places)
    view = {"width": 16, "height": 16, "fx": 28.0, "fy": 28.0, "cx": 8.0, "cy": 8.0}
    return small_sensor(INDEX, None, lights, **view, position_mm=(0.0, 0.0, 20.0), look_at_mm=(0.0, 0.0, 0.0))


def _by_chance(sensor: Sensor, seed: int, reflected: float) -> FloatArray:
    """Mitsuba's path tracer, pinhole and interface around a flat Lambertian face."""
    mi, camera = FAST.load(), sensor.camera
    transform = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
    view = pinhole(sensor) | {"film": film}
    color = {"type": "rgb", "value": REFLECTANCE}
    interface = {"type": "dielectric", "int_ior": INDEX, "ext_ior": 1.0}
    interface["specular_reflectance"] = {"type": "rgb", "value": reflected}
    face = {"type": "rectangle", "to_world": transform().scale([6.0, 4.5, 1.0])}
    window = {"type": "rectangle", "to_world": transform().translate([0, 0, 6.0]) @ transform().scale([500, 500, 1])}
    scene = {
        "type": "scene",
        "gel": face | {"bsdf": {"type": "diffuse", "reflectance": color}},
        "window": window | {"bsdf": interface},
        **emitters(sensor.lights, mi),
    }
    view["to_world"] = transform(view["to_world"])
    integrator = mi.load_dict({"type": "path", "max_depth": 24, "rr_depth": 50, "hide_emitters": True})
    image = mi.render(mi.load_dict(scene), sensor=mi.load_dict(view), integrator=integrator, spp=2**13, seed=seed)
    return _blocks(np.array(image))


def _blocks(image: FloatArray) -> FloatArray:
    """Means (3, 4) over 4 x 4 px of the rows that see the face."""
    return image[2:14, :, 0].reshape(3, 4, 4, 4).mean(axis=(1, 3))


@needs_llvm
def test_images_behind_the_window_give_what_a_dielectric_interface_gives_by_chance() -> None:
    sensor = _sensor()
    found = np.stack([_by_chance(sensor, seed, 1.0) for seed in SEEDS])
    expected, error = found.mean(axis=0), found.std(axis=0, ddof=1).max() / np.sqrt(len(SEEDS))
    for light in ("path_traced", "separated"):
        image = _blocks(rendered(sensor, render=Render(samples_per_pixel=256, max_depth=8, light=light), cells=1))
        assert image == pytest.approx(expected, abs=4 * error)
        assert image.mean() == pytest.approx(expected.mean(), rel=3e-3)
    # Fails without the images: they are a sixth of the light here.
    assert _by_chance(sensor, 0, 0.0).mean() < 0.9 * expected.mean()
