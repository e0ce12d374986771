"""Depth of field: blur circles against the thin lens's closed form, and a ground truth that does not know of them."""

import functools
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import refused
from kinematic_double import rigid, rotation
from render_scenes import FAST, SCALAR, flat_surface, needs_llvm, plain, refracted_angle, rendered, small_sensor

from synth.arrays import FloatArray, Image, Points
from synth.optics import Optics
from synth.pipeline.generate import generate
from synth.render.pattern import albedo
from synth.render.renderer import Renderer
from synth.render.thin_lens import ThinLens
from synth.scene import Camera, Dots, FurtherCamera, Mirror, Render, Sensor
from synth.scene.template import load_scene
from synth.verify import verify_dataset

SEEDS = range(8)
ROWS, COLUMNS = np.mgrid[0:60, 0:80] + 0.5
SINGLE = Dots(kind="dots", spacing_mm=(30, 30), radius_mm=0.4, softness_mm=0.1, offset_mm=(0.3, 0.1))
MANY = Dots(kind="dots", spacing_mm=(2.5, 2.0), radius_mm=0.4, softness_mm=0.1, offset_mm=(0.3, 0.1))
FACE, EYE = 6.0, 20.0  # Heights in mm of the window's outer face and of the camera in `small_sensor`
APERTURE = 1.6
OBLIQUE: dict[str, Any] = {"pattern": SINGLE, "position_mm": (8.0, 9.0, 17.0), "look_at_mm": (1.8, 2.0, 2.0)}


def _removed(sensor: Sensor, state: Points | None = None) -> FloatArray:
    """The radiance (seeds, H, W) that the dots take away: linear in albedo, so that blur convolves it."""
    bare, dotted = (_renderer(sensor, texture, 64) for texture in (plain(), None))
    state = flat_surface(sensor).material if state is None else state
    return np.stack([(bare.radiance(state, s) - dotted.radiance(state, s))[..., 0].astype(np.float64) for s in SEEDS])


def _renderer(sensor: Sensor, texture: Image | None = None, samples: int = 16) -> Renderer:
    painted = albedo(sensor, np.random.default_rng(0)) if texture is None else texture
    return Renderer(sensor, Render(samples_per_pixel=samples, max_depth=2), flat_surface(sensor), painted, FAST)


@functools.cache
def _variances(sensor: Sensor) -> FloatArray:
    """Second central moments (seeds, 2) px² along x and y of the one dot in a sensor's frames."""
    weights = _removed(sensor)
    weights /= weights.sum((1, 2), keepdims=True)
    means = [(weights * places).sum((1, 2), keepdims=True) for places in (COLUMNS, ROWS)]
    spread = zip((COLUMNS, ROWS), means, strict=True)
    return np.column_stack([(weights * (places - mean) ** 2).sum((1, 2)) for places, mean in spread])


def _added_variance(sensor: Sensor) -> tuple[FloatArray, FloatArray]:
    """What the aperture adds to the dot's second moments, (2,) px², and the standard error of that."""
    camera = sensor.camera.model_copy(update={"aperture_mm": 0.0, "focus_mm": None})
    sharp, blurred = _variances(sensor.model_copy(update={"camera": camera})), _variances(sensor)
    error = np.sqrt((sharp.var(0, ddof=1) + blurred.var(0, ddof=1)) / len(SEEDS))
    return blurred.mean(0) - sharp.mean(0), error


@needs_llvm
@pytest.mark.parametrize(("index", "focus"), [(1.0, 14.5), (1.0, 26.0), (1.45, 12.0), (1.45, 17.0), (1.45, 26.0)])
def test_blur_circle_is_that_of_the_thin_lens(index: float, focus: float) -> None:
    """The diameter c = A f |z - s| / (z s), z and s as seen in air; a uniform disc has the moments c² / 16."""
    sensor = small_sensor(index, SINGLE, aperture_mm=APERTURE, focus_mm=focus)
    # By hand: 14 mm of air above the face; what lies behind it appears at 1 / n of its depth.
    above = EYE - FACE
    z, s = above + FACE / index, above + (focus - above) / index if focus > above else focus
    expected = (APERTURE * 140 * (z - s) / (z * s)) ** 2 / 16
    found, error = _added_variance(sensor)
    # Monte Carlo: four standard errors of 8 seeds. Rays at the pupil's rim, u = 0.8 / 18, leave the paraxial depth by
    # u² (n² - 1) / 2 n² = 5e-4 of 4 mm, against defocus of at least 2 mm: 2e-3 in its square.
    assert np.all(np.abs(found - expected) < 4 * error + 2e-3 * expected), (found, expected, error)
    assert np.all(error < 0.12 * expected)


@needs_llvm
@pytest.mark.parametrize("focus", [28.0, 24.0])
def test_focus_is_measured_by_the_mirror(focus: float) -> None:
    """12 mm to the mirror, 10 mm down to the face, 6 mm in the body."""
    mirror = Mirror(position_mm=(0.0, 0.0, 16.0), normal=(0.0, 1.0, -1.0), size_mm=(16.0, 16.0))
    straight = small_sensor(1.45, SINGLE, fx=190.0, fy=190.0, aperture_mm=APERTURE, focus_mm=focus)
    place = {"position_mm": (0.0, 12.0, 16.0), "look_at_mm": (0.0, 0.0, 16.0)}
    sensor = straight.model_copy(update={"mirrors": (mirror,), "camera": straight.camera.model_copy(update=place)})
    assert ThinLens.of(sensor).distance_mm == pytest.approx(22 + (focus - 22) / 1.45, rel=1e-12)
    z, s = 22 + 6 / 1.45, 22 + (focus - 22) / 1.45
    expected = (APERTURE * 190 * (z - s) / (z * s)) ** 2 / 16
    found, error = _added_variance(sensor)
    # As above. In focus what is left is spherical aberration: 5e-4 · 4 mm · u · f / z = 5e-4 px.
    assert np.all(np.abs(found - expected) < 4 * error + 2e-3 * expected + 1e-3), (found, expected, error)


def _axis(camera: Camera) -> tuple[FloatArray, FloatArray]:
    eye = np.array(camera.position_mm)
    along = np.array(camera.look_at_mm) - eye
    return eye, along / np.linalg.norm(along)


def _slopes(camera: Camera, index: float, target: FloatArray, radius: float) -> tuple[FloatArray, FloatArray]:
    """How a point below the face is seen from points of the pupil: these (n, 2) mm and the tangents (n, 2)."""
    eye, forward = _axis(camera)
    right = np.array([1.0, 0, 0]) - forward[0] * forward
    right /= np.linalg.norm(right)
    down = np.cross(right, forward)
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    # The rim of half the square: a uniform disc has the second moments of the ring of radius a / √2.
    pupil = radius / np.sqrt(2) * np.column_stack([np.cos(angles), np.sin(angles)])
    seen = []
    for u, v in pupil:
        start = eye + u * right + v * down
        across = target[:2] - start[:2]
        distance = np.hypot(*across)
        angle = refracted_angle(start[2] - FACE, FACE - target[2], distance, index)
        ray = np.array([*(across / distance * np.sin(angle)), -np.cos(angle)])
        seen.append([ray @ right / (ray @ forward), ray @ down / (ray @ forward)])
    return pupil, np.array(seen)


@pytest.mark.parametrize("index", [1.0, 1.45])
def test_an_oblique_axis_is_in_focus_where_its_rays_spread_least(index: float) -> None:
    """Least squares of t = t0 - p / s over the pupil p, from where the axis, bent by Snell's law, is in focus."""
    sensor = small_sensor(index, aperture_mm=0.2, focus_mm=22.0, **OBLIQUE)
    eye, ray = _axis(sensor.camera)
    before, (x, y) = (eye[2] - FACE) / -ray[2], ray[:2] / index
    target = eye + before * ray + (22.0 - before) * np.array([x, y, -np.sqrt(1 - x**2 - y**2)])
    pupil, slopes = _slopes(sensor.camera, index, target, 0.1)
    best = -(pupil**2).sum() / (pupil * (slopes - slopes.mean(0))).sum()
    assert ThinLens.of(sensor).distance_mm == pytest.approx(best, rel=1e-4)  # paraxial: (0.1 / 20)² = 3e-5


@needs_llvm
def test_an_oblique_camera_blurs_as_its_rays_say() -> None:
    """Second moments of where rays traced by Snell's law through the pupil put the dot's centre in the image."""
    sensor = small_sensor(1.45, aperture_mm=APERTURE, focus_mm=17.0, **OBLIQUE)
    pupil, slopes = _slopes(sensor.camera, 1.45, np.array([*SINGLE.offset_mm, 0.0]), APERTURE / 2)
    expected = (140 * (slopes + pupil / ThinLens.of(sensor).distance_mm)).var(0)
    found, error = _added_variance(sensor)
    # The dot's own extent, 0.2 mm (rms) on a face tilted by 32 degrees against defocus of 5 mm: (0.1 / 5)² < 1e-3.
    # Aberrations of the rim beyond those of the ring: u² = 2e-3 of the defocus.
    assert np.all(np.abs(found - expected) < 4 * error + 5e-3 * expected), (found, expected, error)


@needs_llvm
@pytest.mark.parametrize(("index", "aperture"), [(1.0, APERTURE), (1.41, APERTURE / 4)])
def test_in_focus_the_picture_is_the_pinholes_within_noise(index: float, aperture: float) -> None:
    """Through the window a quarter of the aperture: toward the image's edges the full one is astigmatic."""
    shape: dict[str, Any] = {"fy": 155.0, "distortion": (-0.25, 0.08, 0.004, -0.003, 0.01)}

    def frames(seeds: range, texture: Image | None = None, **lens: Any) -> FloatArray:
        sensor = small_sensor(index, MANY, **shape, **lens)
        renderer, state = _renderer(sensor, texture, 144), flat_surface(sensor).material
        return np.stack([renderer.radiance(state, seed)[..., 0] for seed in seeds]).astype(np.float64)

    count, bare = len(SEEDS), frames(range(1), plain())  # a dot near the light must not outweigh all others
    sharp = frames(SEEDS) / bare
    misses = {}
    for focus in (EYE, 14.5):
        other = frames(range(100, 100 + count), aperture_mm=aperture, focus_mm=focus) / bare  # independent noise
        noise = (sharp.var(0, ddof=1) + other.var(0, ddof=1)).mean() / count
        misses[focus] = ((sharp.mean(0) - other.mean(0)) ** 2).mean() / noise
    # Noise sits at the dots' edges, some 150 pixels: four times √(2 / 150), and as many for √(2 / (150 · 14)).
    assert misses[EYE] == pytest.approx(1, abs=0.5)
    assert misses[14.5] > 10


@needs_llvm
def test_defocus_does_not_move_centroids() -> None:
    """In an undeformed and a raised, turned and shifted state."""
    camera: dict[str, Any] = {"distortion": (-0.2, 0.05, 1e-3, -2e-3, 0.0)}
    pinhole = small_sensor(1.45, MANY, **camera)
    lens = small_sensor(1.45, MANY, **camera, aperture_mm=APERTURE, focus_mm=15.0)
    rest, optics = flat_surface(pinhole).material, Optics.of(pinhole)
    shifts = []
    for state in (rest, rigid(rotation("z", 3.0), (0.3, -0.2, 1.0))(rest)):
        sharp, blurred = (_removed(sensor, state).mean(0) for sensor in (pinhole, lens))
        # The texture's dots: their centres in the moved state are an affine map of the grid.
        affine = np.linalg.lstsq(np.column_stack([rest[:, :2], np.ones(len(state))]), state, rcond=None)[0]
        for x, y in product(np.arange(-2, 3) * 2.5 + 0.3, np.arange(-2, 3) * 2.0 + 0.1):
            u, v = optics.project(np.array([[x, y, 1.0]]) @ affine)[0]
            near = np.hypot(COLUMNS - u, ROWS - v) < 7.5
            if 8 < u < 72 and 8 < v < 52:
                weights = [frame[near] / frame[near].sum() for frame in (sharp, blurred)]
                shifts.append([((weights[1] - weights[0]) * places[near]).sum() for places in (COLUMNS, ROWS)])
    assert len(shifts) >= 18
    # A dot takes some 1500 samples a frame, 12000 in 8. Pupil points move them by c / 4 = 0.8 px (rms) at most, which
    # at random would leave 0.8 / √12000 = 0.007 px a dot: four times that, and its 18th part's root for the mean.
    assert np.abs(shifts).max() < 0.03
    assert np.abs(np.mean(shifts, axis=0)).max() < 0.03 / np.sqrt(18)


@needs_llvm
def test_each_camera_has_its_own_aperture() -> None:
    main = small_sensor(1.45, MANY)
    soft = FurtherCamera(**main.camera.model_dump() | {"name": "soft", "aperture_mm": 3.0, "focus_mm": 10.0})
    rest = flat_surface(main).material
    images = _renderer(main.model_copy(update={"further_cameras": (soft,)})).radiances(rest, 3)
    assert np.array_equal(images[""], _renderer(main).radiance(rest, 3))
    bare = _renderer(main, plain()).radiance(rest, 3)
    contrast = {name: (image / bare)[15:45, 20:60].std() for name, image in images.items()}
    assert contrast[""] > 0.2
    assert contrast["soft"] < 0.5 * contrast[""]  # dots of 6 px in blur circles of 19 px


@needs_llvm
@pytest.mark.usefixtures("one_cache")
def test_a_dataset_with_an_aperture_passes_verify(tiny: Path, tmp_path: Path) -> None:
    lens = ["sensor.camera.aperture_mm={ uniform = [0.5, 1.5] }", "sensor.camera.focus_mm=19.0"]
    generate(load_scene(tiny, lens), 1, tmp_path / "data")
    report = verify_dataset(tmp_path / "data")
    assert report.ok, report.record()


@pytest.mark.parametrize(("change", "message"), [
    ({}, "needs focus_mm"),
    ({"focus_mm": 1.5}, "wider than focus_mm"),
    ({"focus_mm": 20.0, "lens": "fisheye", "distortion": (0, 0, 0, 0)}, "fisheye lens has no flat plane"),
    ({"focus_mm": 20.0, "position_mm": (9.0, 0.0, 6.5), "look_at_mm": (0, 0, 0)}, "tilted pupil reaches down"),
])  # fmt: skip
def test_impossible_lenses_are_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small_sensor(1.45, aperture_mm=APERTURE, **change)


def test_an_axis_that_does_not_reach_the_window_and_scalar_variants_are_refused() -> None:
    straight = small_sensor(1.45, aperture_mm=APERTURE, focus_mm=20.0)
    back = Mirror(position_mm=(0.2, -0.1, 12.0), normal=(0.0, 0.0, -1.0), size_mm=(2.0, 2.0))
    refused(r"focus_mm.*does not reach the window", ThinLens.of, straight.model_copy(update={"mirrors": (back,)}))
    blind = FurtherCamera(**straight.camera.model_dump() | {"name": "blind"})
    main = small_sensor(1.45, position_mm=(2.0, -0.1, 20.0), look_at_mm=(2.0, -0.1, 0.0))
    sensor = main.model_copy(update={"further_cameras": (blind,), "mirrors": (back,)})
    refused(r"further_cameras 'blind'.*focus_mm", rendered, sensor)
    refused(r"aperture_mm.*LLVM", rendered, straight, variant=SCALAR)
