"""Light by area against closed forms, path tracing and, for what the window throws back, Mitsuba's own interface."""

from functools import cache

import numpy as np
import pytest
from commands import refused
from render_scenes import FAST, SCALAR, flat_surface, needs_llvm, plain, rendered, small_sensor
from round_gels import RADIUS, SPHERE, capsule, sensor

from synth.arrays import FloatArray
from synth.render.camera_rays import pinhole
from synth.render.gel_mesh import MIRROR
from synth.render.light_words import bits
from synth.render.lights import emitters, light_axes
from synth.render.polygon_light import LightTable
from synth.render.renderer import Renderer
from synth.scene import CapsuleGel, Coating, Light, Render, Sensor

LIGHTS = tuple(Light(position_mm=(x, 1.0, 3.0), size_mm=(3, 1), color=(1, 1, 1), power=400) for x in (-7.0, 7.0))
BLOCK = 10
SENSOR = small_sensor(1.45, None, LIGHTS, width=40, height=30, fx=70.0, fy=70.0, cx=21.25, cy=14.25)
INDEX, REFLECTANCE = 1.45, 0.6
SEEDS = range(4)


def _summed(light: Light, point: FloatArray, normal: FloatArray) -> float:
    """Irradiance per radiance by the midpoint rule over 400 x 400 patches of the light, in the scene's frame."""
    across, along, direction = light_axes(light)
    steps = (np.arange(400) + 0.5) / 400 - 0.5
    u, v = (axis.ravel() for axis in np.meshgrid(steps * light.size_mm[0], steps * light.size_mm[1]))
    way = np.array(light.position_mm) + np.outer(u, across) + np.outer(v, along) - point
    square = (way**2).sum(axis=1)
    leaving = np.maximum(-(way @ direction), 0) / np.sqrt(square)
    cosines = np.maximum(way @ normal, 0) * np.sqrt(square) * leaving ** (1 + light.narrowness)
    return float((cosines / square**2).mean() * light.size_mm[0] * light.size_mm[1])


@needs_llvm
@pytest.mark.parametrize(("angle", "width"), [(120.0, 2.0), (50.0, 0.6)])
def test_whole_light_is_the_sum_over_it(angle: float, width: float) -> None:
    """Lights whole, cut by the horizon, and seen from behind; with a closed form, and narrower without one."""
    mi = FAST.load()
    light = Light(position_mm=(4.0, 1.0, 2.0), aim_mm=(0.0, 0.0, 1.0), size_mm=(5, width), color=(1, 1, 1), power=1)
    light = light.model_copy(update={"viewing_angle_deg": angle})
    rng = np.random.default_rng(0)
    points = rng.uniform([-4, -4, -1], [6, 4, 1.0], (60, 3))
    normals = rng.standard_normal((60, 3)) + np.array([0, 0, 1.5])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    expected = np.array([_summed(light, p, n) for p, n in zip(points, normals, strict=True)])
    assert (expected == 0).any()
    assert (expected > 0.03).any()
    place, normal = (mi.Vector3f(*(values * MIRROR).astype(np.float32).T) for values in (points, normals))
    table = LightTable([light], 1, mi, sampled=angle < 120)
    vector = np.array(table.light(mi.UInt32(0)).whole(mi.Point3f(place), normal, 14))
    found = (vector * np.array(normal)).sum(axis=0)
    # The midpoint rule errs by the second order of a patch's size over the distance, 5/400 and at least some 0.5 mm,
    # and where the horizon cuts patches by a part of one in 400 rows of the light, at grazing angle. The horizon cuts a
    # part of one of 14 nodes: a fiftieth of the most light that one gives.
    tolerance = {"rtol": 2e-4, "atol": 2e-5} if angle == 120 else {"rtol": 0.02, "atol": 0.02 * expected.max()}
    np.testing.assert_allclose(found, expected, **tolerance)


@cache
def _pictures(light: str, samples: int, depth: int = 4) -> FloatArray:
    """(6, H, W) radiances by as many seeds of a bright gel with a steep bump, which shades the plain and lights it."""
    surface = flat_surface(SENSOR, 24)
    pressed = surface.material.copy()
    pressed[:, 2] += 1.5 * np.exp(-(pressed[:, 0] ** 2 + pressed[:, 1] ** 2) / 1.2**2)
    render = Render.model_validate({"samples_per_pixel": samples, "max_depth": depth, "light": light})
    renderer = Renderer(SENSOR, render, surface, plain(0.8), FAST)
    return np.stack([renderer.radiance(pressed, seed)[..., 0] for seed in range(100, 106)]).astype(np.float64)


def _blocks(pictures: FloatArray) -> tuple[FloatArray, FloatArray]:
    count, height, width = pictures.shape
    cut = pictures.reshape(count, height // BLOCK, BLOCK, width // BLOCK, BLOCK).mean(axis=(2, 4))
    return cut.mean(axis=0), cut.std(axis=0, ddof=1) / count**0.5


@needs_llvm
@pytest.mark.parametrize("depth", [2, 3])
def test_expectation_is_path_tracings(depth: int) -> None:
    """Block by block: the bump's flanks, its shadows, its rim and the plain."""
    separated, path_traced = _pictures("separated", 16, depth), _pictures("path_traced", 576, depth)
    (found, error), (truth, own) = _blocks(separated), _blocks(path_traced)
    # Five standard errors of some 10 degrees of freedom: one block in 2000. Projections keep each face's mean, so that
    # nothing systematic is left in a block but for faces across its edges: less than 0.1 %.
    limit = 5 * np.hypot(error, own) + 1e-3 * truth
    assert (np.abs(found - truth) < limit).all(), np.abs(found - truth) / limit
    # A limit that is worth something: bounced light is 1.2 % of the picture.
    assert limit.mean() < 4e-3 * truth.mean()


@needs_llvm
def test_a_small_shadow_falls_on_two_triangles_as_on_many() -> None:
    """A panel that hides a light from less than 1 % of the gel: 16 rays from each of two triangles would miss that."""
    light = Light(position_mm=(8.0, 2.0, 2.0), size_mm=(0.05, 0.05), color=(1, 1, 1), power=100)
    panel = Light(position_mm=(5.8, 0.5, 0.7), aim_mm=(0.0, 0.0, 0.0), size_mm=(0.3, 0.3), color=(1, 1, 1), power=1e-9)
    shaded, render = small_sensor(lights=(light, panel)), Render(samples_per_pixel=16, light="separated")
    surfaces = (flat_surface(shaded, 1), flat_surface(shaded))
    few, many = (Renderer(shaded, render, each, plain(), FAST).radiance(each.material, 0)[..., 0] for each in surfaces)
    assert 0.001 < np.mean(many < 0.01 * np.median(many)) < 0.01
    # The same samples, at places that differ by rounding: at its edge one of 16 may be lit that was not.
    assert np.abs(few - many).max() < 0.07 * many.max()


@needs_llvm
def test_a_shadow_of_more_lights_than_a_word_has_bits() -> None:
    """Two kinds of light, and each in forty parts at its place: what a panel hides of them is the same."""
    wide = Light(position_mm=(8.0, 2.0, 2.0), size_mm=(0.05, 0.05), color=(1, 1, 1), power=100)
    kinds = (wide, wide.model_copy(update={"position_mm": (8.0, -2.0, 2.0), "viewing_angle_deg": 60.0}))
    panel = Light(position_mm=(5.8, 0.0, 0.7), aim_mm=(0.0, 0.0, 0.0), size_mm=(2.0, 1.0), color=(1, 1, 1), power=1e-9)
    parts = tuple(light.model_copy(update={"power": light.power / 40}) for light in kinds for _ in range(40))
    render = Render(samples_per_pixel=16, light="separated")
    two, eighty = (rendered(small_sensor(lights=(*of, panel)), render=render)[..., 0] for of in (kinds, parts))
    assert 0.02 < np.mean(two < 0.6 * np.median(two)) < 0.4
    assert np.abs(two - eighty).max() < 0.07 * two.max()  # at a shadow's edge, as above


@needs_llvm
def test_bits_of_a_word() -> None:
    mi = FAST.load()
    for low, high in ((0, 3), (5, 32), (-40, 2), (31, 70), (0, 64), (-32, 0), (32, 40), (4, 4)):
        expected = sum(1 << k for k in range(32) if low <= k < high)
        assert int(bits(mi.Int32(low), mi.Int32(high), mi)[0]) == expected


@needs_llvm
def test_gel_that_no_light_reaches_lights_no_other() -> None:
    """A light with a panel before it, over a bump that would bounce its light."""
    light = Light(position_mm=(8.0, 2.0, 3.0), size_mm=(0.05, 0.05), color=(1, 1, 1), power=100)
    panel = Light(position_mm=(7.9, 1.975, 2.9625), aim_mm=(0, 0, 0), size_mm=(3.0, 3.0), color=(1, 1, 1), power=1e-9)
    bump = flat_surface(small_sensor()).material.copy()
    bump[:, 2] += np.exp(-(bump[:, 0] ** 2 + bump[:, 1] ** 2) / 1.2**2)
    lit, dark = small_sensor(lights=(light,)), small_sensor(lights=(light, panel))

    def bounced(of: Sensor) -> float:
        """The most that a reflection adds anywhere."""
        renders = (Render(samples_per_pixel=16, light="separated", max_depth=depth) for depth in (3, 2))
        more, less = (rendered(of, render=render, positions=bump) for render in renders)
        return float((more - less).max())

    assert bounced(dark) < 1e-3 * bounced(lit)


@needs_llvm
def test_second_bounce_is_path_tracings_with_less_noise_and_none_on_flat_gel() -> None:
    """What one bounce more adds, 0.05 % of the picture; the same seeds make it known to some per cent."""
    added = []
    for setting in (("separated", 16), ("path_traced", 576)):
        more = (_pictures(*setting, 4) - _pictures(*setting, 3)).mean(axis=(1, 2))
        added.append((more.mean(), more.std(ddof=1) / len(more) ** 0.5))
    (found, error), (truth, own) = added
    assert truth > 10 * own
    assert abs(found - truth) < 5 * np.hypot(error, own)
    # At 16 samples less than half of what path tracing leaves at 36, edge of contact and shadows included.
    noise = [_pictures(*one).std(axis=0, ddof=1) for one in (("separated", 16), ("path_traced", 36))]
    assert np.sqrt((noise[0] ** 2).mean()) < 0.5 * np.sqrt((noise[1] ** 2).mean())
    # What remains is the pixel filter, where light varies by 5 % in a pixel; a window's images are 64 samples of it.
    render = Render(samples_per_pixel=16, light="separated")
    window = small_sensor(1.45, None, LIGHTS)
    first, second, same = (rendered(window, render=render, seed=seed) for seed in (1, 2, 1))
    np.testing.assert_array_equal(first, same)
    assert np.sqrt(np.mean((first / second - 1) ** 2)) < 2**0.5 * 2e-3
    first, second = (rendered(small_sensor(1.0, None, LIGHTS), render=render, seed=seed) for seed in (1, 2))
    # Jittered in 4 x 4 cells: 0.05 / sqrt(12) / 4 / sqrt(16) = 0.1 % at most; the largest of 4800 is at 4 sigma.
    assert np.abs(first / second - 1).max() < 4 * 2**0.5 * 1e-3


@needs_llvm
def test_light_bounced_in_a_hemisphere_is_that_of_an_integrating_sphere() -> None:
    """A part of a sphere of radius R lights each other alike: of the flux Φ that it gets, by ρ Φ / 4 π R²."""
    power, albedo, surface = 100.0, 0.6, capsule(2.4, length=0.0)
    place = {"position_mm": (3.0, 2.0, 11.9), "aim_mm": (3.0, 2.0, 0.0), "size_mm": (0.5, 0.5)}
    light = Light(**place, color=(1, 1, 1), power=power)
    gel = CapsuleGel(shape="capsule", radius_mm=RADIUS, thickness_mm=2.0, youngs_modulus_kpa=200)
    within = sensor(SPHERE, index=1.0, lights=(light,), fx=30.0, fy=30.0, position_mm=(-3.0, 0.0, 11.0))
    within = within.model_copy(update={"gel": gel})
    renders = (Render(samples_per_pixel=64, light="separated", max_depth=depth) for depth in (2, 3))
    renderers = (Renderer(within, render, surface, plain(albedo), FAST) for render in renders)
    direct, both = (renderer.radiance(surface.material, 1)[..., 0] for renderer in renderers)
    bounced = (both - direct)[direct > 0]
    expected = albedo**2 * power / (4 * np.pi * RADIUS**2) / np.pi
    # 2^18 paths that scatter by twice their mean: 0.4 % of it, for up to 75 terms sqrt(75) times that at a place.
    assert np.mean(bounced) == pytest.approx(expected, rel=0.02)
    assert np.sqrt(np.mean((bounced / expected - 1) ** 2)) < 0.05


def test_what_shines_is_refused_and_scalar_variants_path_trace() -> None:
    sensor = small_sensor(1.0, None, LIGHTS)
    shining = sensor.model_copy(update={"coating": Coating(roughness=0.5)})
    words = r'render.light = "separated" needs a matt coating .* roughness = 0.5'
    refused(words, rendered, shining, render=Render(light="separated"))
    images = [rendered(sensor, render=Render(light=one), variant=SCALAR) for one in ("separated", "path_traced")]
    np.testing.assert_array_equal(*images)


@needs_llvm
@pytest.mark.parametrize("index", [1.0, 1.45])
@pytest.mark.parametrize("wide", [0.0, 30.0], ids=["alone", "beside a Lambertian one"])
def test_a_narrow_light_is_the_same_separated_and_path_traced(index: float, wide: float) -> None:
    """A part of the gel is behind the mirror image of the Lambertian light."""
    light = Light(position_mm=(6.5, 1, 3), size_mm=(2, 1), color=(1, 0.5, 0.2), power=300, viewing_angle_deg=40)
    beside = Light(position_mm=(-6.5, 0, 4), aim_mm=(-3.5, 0, 0), size_mm=(2, 1), color=(1, 1, 1), power=wide)
    sensor = small_sensor(index, None, (light, beside))
    kinds = (("separated", 64), ("path_traced", 256))
    renders = (Render(samples_per_pixel=count, max_depth=2, light=kind) for kind, count in kinds)
    separated, traced = (rendered(sensor, render=render).mean(axis=0) for render in renders)
    assert separated.max() > 3 * separated.min()
    # A pixel's error is below 5 % of it; the mean of a column of 60 is known within 0.7 %.
    np.testing.assert_allclose(traced, separated, rtol=0.02)


def test_a_lights_power_is_what_its_radiance_sums_to() -> None:
    """Midpoint rule over the hemisphere of cos^(k + 1) θ, which is half of its value at half the viewing angle."""
    for angle in (120.0, 60.0, 15.0):
        light = Light(position_mm=(0, 0, 3), size_mm=(2, 0.5), color=(1, 1, 1), power=7, viewing_angle_deg=angle)
        theta = (np.arange(20000) + 0.5) / 20000 * np.pi / 2
        intensity = np.cos(theta) ** (light.narrowness + 1)
        assert np.cos(np.radians(angle / 2)) ** (light.narrowness + 1) == pytest.approx(0.5)
        solid = 2 * np.pi * np.sin(theta) * np.pi / 2 / 20000
        assert light.radiance[0] * 2 * 0.5 * (intensity * solid).sum() == pytest.approx(7, rel=1e-6)


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
    return _means(np.array(image))


def _means(image: FloatArray) -> FloatArray:
    return image[2:14, :, 0].reshape(3, 4, 4, 4).mean(axis=(1, 3))


@needs_llvm
def test_images_behind_the_window_give_what_a_dielectric_interface_gives_by_chance() -> None:
    """Two wide lights, that chance may find them; the second shines mostly up."""
    places = [((7.0, 1.0, 3.5), (0.0, 0.0, 2.5)), ((-1.0, -7.2, 2.0), (0.0, 3.0, 5.0))]
    common = {"size_mm": (3.0, 1.5), "color": (1, 1, 1), "power": 300}
    lights = tuple(Light(position_mm=at, aim_mm=aim, **common) for at, aim in places)
    view = {"width": 16, "height": 16, "fx": 28.0, "fy": 28.0, "cx": 8.0, "cy": 8.0}
    sensor = small_sensor(INDEX, None, lights, **view, position_mm=(0.0, 0.0, 20.0), look_at_mm=(0.0, 0.0, 0.0))
    found = np.stack([_by_chance(sensor, seed, 1.0) for seed in SEEDS])
    expected, error = found.mean(axis=0), found.std(axis=0, ddof=1).max() / np.sqrt(len(SEEDS))
    for light in ("path_traced", "separated"):
        image = _means(rendered(sensor, render=Render(samples_per_pixel=256, max_depth=8, light=light), cells=1))
        assert image == pytest.approx(expected, abs=4 * error)
        assert image.mean() == pytest.approx(expected.mean(), rel=3e-3)
    # Fails without the images: they are a sixth of the light here.
    assert _by_chance(sensor, 0, 0.0).mean() < 0.9 * expected.mean()
