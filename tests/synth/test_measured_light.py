"""Measured light: the intensities that GelSight's model has, at rest and tilted, in shadow; or one clear message."""

import json
import re
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import refused, said
from render_scenes import FAST, SCALAR, flat_surface, needs_llvm, plain, small_sensor
from tiny_scene import LIGHTS, TEXT, write_tiny

from synth.arrays import FloatArray, Points
from synth.cli import main
from synth.dataset.images import encode_png, read_png
from synth.dataset.reader import read_dataset
from synth.render.coating import is_separated
from synth.render.measured_light import read_measured_light
from synth.render.renderer import Renderer
from synth.scene import Light, MeasuredLight, Render, Sensor
from synth.scene.template import load_scene

RENDER = Render(samples_per_pixel=4, max_depth=4, light="separated")
LEDS, WIDTH, HEIGHT, PITCH = 4, 240, 180, 0.05  # 12 x 9 mm, all of the pad
AZIMUTHS = np.radians([0.0, 90, 180, 270])
GSSIM = Path(__file__).parents[3] / "shared/real/gssim"
SCALE = [0.5, 0.4, 0.45, 0.35]


def _coefficients() -> FloatArray:
    """(6, LEDs, 10): terms x², xy, y², x, y, 1 of A's upper triangle, b and c, rising toward each LED's azimuth."""
    values = 0.1 * np.random.default_rng(2).standard_normal((6, LEDS, 10))
    values[5, :, 6:] += np.stack([0.3 * np.cos(AZIMUTHS), 0.3 * np.sin(AZIMUTHS), 0 * AZIMUTHS, 0.4 + 0 * AZIMUTHS], 1)
    return values


def _fields() -> FloatArray:
    """Flat fields (LEDs, 18, 24) that fall off toward one side each, as stored in 16 bits."""
    y, x = np.mgrid[-1:1:18j, -1:1:24j]
    fields = [s * (0.8 + 0.2 * (x * np.cos(a) + y * np.sin(a))) for s, a in zip(SCALE, AZIMUTHS, strict=True)]
    return np.round(np.array(fields) * 65535) / 65535


def _written(folder: Path, **changes: object) -> None:
    values = changes.pop("values", _coefficients())
    text = {"version": 3.0, "nL": LEDS, "width": WIDTH, "height": HEIGHT, "mmperpixel": PITCH} | changes
    lines = [f"{key}: {value}" for key, value in text.items() if value is not None]
    lines += ["quadfit: ", f"    rows: {len(values)}", f"    values: {json.dumps(values.ravel().tolist())}"]
    lines += [
        "camera: ",
        "    shutter: 3",
        "flatfield: ",
        "    modelfile: led.png",
        f"    scale: {SCALE[: text['nL']]}",
    ]
    (folder / "led.yaml").write_text("\n".join(lines) + "\n")
    tiles = [*np.round(_fields() * 65535).astype(np.uint16), *np.zeros((2, 18, 24), np.uint16)]
    (folder / "led.png").write_bytes(encode_png(np.vstack([np.hstack(tiles[:3]), np.hstack(tiles[3:])])))


def _lit(index: float = 1.0, height: float = 2.5, flat_field: str | None = None) -> Sensor:
    """LEDs 0, 1 and 2 in red, green and blue, LED 3 off; the camera far above, so that rays are all but vertical."""
    colors, powers = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)), (1, 1, 1, 0)
    lights = tuple(
        Light(position_mm=(9 * np.cos(a), 9 * np.sin(a), height), size_mm=(0.3, 0.3), color=color, power=power)
        for a, color, power in zip(AZIMUTHS, colors, powers, strict=True)
    )
    far = {"position_mm": (0.0, 0.0, 1000.0), "look_at_mm": (0.0, 0.0, 0.0), "cx": 40.0, "cy": 30.0}
    focal = 7 * (1000 - 6 + 6 / index)  # 7 px per mm on the face below 6 mm of gel and window
    sensor = small_sensor(index, None, lights, **far, fx=focal, fy=focal)
    return sensor.model_copy(update={"measured_light": MeasuredLight(file="led.yaml", flat_field=flat_field)})


FLAT = {"flat_field": "led.png"}


def _radiance(sensor: Sensor, folder: Path, positions: Points | None = None, cells: int = 12) -> FloatArray:
    surface = flat_surface(sensor, cells)
    renderer = Renderer(sensor, RENDER, surface, plain(0.6), FAST, read_measured_light(sensor, folder))
    return renderer.radiance(surface.material if positions is None else positions, 0).astype(np.float64)


def _published(x: FloatArray, y: FloatArray, n: FloatArray, with_fields: bool) -> FloatArray:
    """What shadeQuadratic and createscan make at places in mm of LEDs 0 to 2; the normal is one for all."""
    u, v = x / (HEIGHT * PITCH), y / (HEIGHT * PITCH)
    terms = np.stack([u * u, u * v, v * v, u, v, np.ones_like(u)])
    found = []
    for led, numbers in enumerate(np.moveaxis(np.tensordot(_coefficients(), terms, (0, 0)), 0, 0)[:3]):
        a = np.array([[numbers[0], numbers[1], numbers[2]], [numbers[1], numbers[3], numbers[4]], numbers[[2, 4, 5]]])
        value = np.maximum(np.einsum("i,ij...,j", n, a, n) + np.tensordot(n, numbers[6:9], (0, 0)) + numbers[9], 0)
        if with_fields:
            places = (x / (WIDTH * PITCH) + 0.5) * 24 - 0.5, (y / (HEIGHT * PITCH) + 0.5) * 18 - 0.5
            field = _fields()[led].astype(np.float32)
            value = value * cv2.remap(field, *(p.astype(np.float32) for p in places), cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE) / SCALE[led]  # fmt: skip # noqa: E501
        found.append(value)
    return np.stack(found, axis=-1)


def _places() -> tuple[FloatArray, FloatArray]:
    """X and y on the face of the pixels' middles, mm."""
    x, y = np.meshgrid((np.arange(80) + 0.5 - 40) / 7, (np.arange(60) + 0.5 - 30) / 7)
    return x, y


@needs_llvm
@pytest.mark.parametrize("index", [1.0, 1.45])
@pytest.mark.parametrize("fields", [{}, FLAT], ids=["corrected", "with its flat field"])
def test_at_rest_it_is_what_was_published(tmp_path: Path, index: float, fields: dict) -> None:
    _written(tmp_path)
    found = _radiance(_lit(index, **fields), tmp_path)
    # Pixels of 1/7 mm are averaged: the second derivative of the field's bends, 0.1 / mm from texel to texel, shifts a
    # mean by up to 0.1 / 7 / 8 = 0.2 %; Fresnel's transmittance at 0.3 degrees is that straight on.
    assert np.abs(found - _published(*_places(), np.array([0.0, 0, 1]), bool(fields))).max() < 3e-3


@needs_llvm
@pytest.mark.parametrize("azimuth", [0.0, 0.7, 2.5, 4.4])
def test_a_face_tilted_by_30_degrees_is_what_was_published(tmp_path: Path, azimuth: float) -> None:
    """Lights that set behind the face still light it as measured."""
    _written(tmp_path)
    sensor, slope = _lit(**FLAT), np.tan(np.radians(30)) * np.array([np.cos(azimuth), np.sin(azimuth)])
    positions = flat_surface(sensor).material.copy()
    positions[:, 2] = positions[:, :2] @ slope
    normal = np.array([*-slope, 1]) / np.hypot(1, np.tan(np.radians(30)))
    x, y = _places()
    nearer = 1 + (x * slope[0] + y * slope[1]) / 1000  # of the plane's points on the pixels' rays, to first order
    expected = _published(x / nearer, y / nearer, normal, True)
    found = _radiance(sensor, tmp_path, positions)
    inside = slice(3, -3), slice(8, -8)  # the tilted pad's own outline
    assert np.abs(found - expected)[inside].max() < 4e-3  # as at rest, and (z / 1000)^2


@needs_llvm
def test_a_ridge_takes_away_the_light_that_it_blocks_and_no_other(tmp_path: Path) -> None:
    _written(tmp_path)
    sensor = _lit(height=1.0)
    positions = flat_surface(sensor, 96).material.copy()
    positions[:, 2] = 0.8 * np.exp(-((positions[:, 0] / 0.4) ** 2))  # along y; LED 0 stands at +x, LED 2 at -x
    found = _radiance(sensor, tmp_path, positions, 96)
    flat = _published(*_places(), np.array([0.0, 0, 1]), False)
    share = (found / np.maximum(flat, 1e-9))[25:35]
    # LED 0 at (9, 1 mm) over the ridge's top of 0.8 mm at x = 0 lights nothing at -9 * 0.8 / 0.2 < x: all of that side.
    left, right = share[:, 12:28], share[:, 52:68]
    assert np.abs(left[..., 0]).max() < 0.02
    assert np.abs(right[..., 2]).max() < 0.02
    assert np.abs(np.stack([left[..., 2], right[..., 0], left[..., 1], right[..., 1]]) - 1).max() < 0.02


@needs_llvm
def test_a_reused_renderer_takes_other_light_and_its_frames_are_those_of_a_new_one(tmp_path: Path) -> None:
    _written(tmp_path)
    first = _lit(**FLAT)
    surface = flat_surface(first)
    shared = Renderer(first, RENDER, surface, plain(0.6), FAST, read_measured_light(first, tmp_path))
    before = shared.radiance(surface.material, 0)
    _written(tmp_path, values=1.1 * _coefficients())
    measured = read_measured_light(first, tmp_path)
    assert shared.reuse(first, RENDER, surface, plain(0.5), measured)
    found = shared.radiance(surface.material, 0)
    own = Renderer(first, RENDER, surface, plain(0.5), FAST, measured)
    np.testing.assert_array_equal(found, own.radiance(surface.material, 0))
    assert found == pytest.approx(before * 1.1 * 0.5 / 0.6, rel=1e-5)  # float32


@needs_llvm
def test_a_scene_with_it_generates_and_its_files_are_part_of_its_hash(tmp_path: Path, capsys, one_cache: None) -> None:
    _written(tmp_path)
    lights = "[[sensor.lights]]".join(LIGHTS.split("[[sensor.lights]]")[: LEDS + 1])
    write_tiny(tmp_path, TEXT.replace(LIGHTS, re.sub("power = .*", "power = 0.3", lights)))
    mine = tmp_path / "measured.toml"
    mine.write_text("""extends = "tiny.toml"
render.light = "separated"
sensor.camera.gamma = 1.0
sensor.measured_light = { file = "led.yaml", flat_field = "led.png" }
""")
    said(capsys, main, "generate", "--scene", mine, "--n", 1, "--out", tmp_path / "data")
    ((first, second),) = [sample.images for sample in read_dataset(tmp_path / "data")]
    assert first.max() > 60
    assert np.abs(first.astype(int) - second).max() > 5
    said(capsys, main, "preview", "--scene", mine, "--out", tmp_path / "p.png")
    np.testing.assert_array_equal(read_png(tmp_path / "p.png"), first)
    hashes = {load_scene(mine).hash}
    for name in ("led.yaml", "led.png"):
        with (tmp_path / name).open("ab") as file:
            file.write(b"\n")
        hashes.add(load_scene(mine).hash)
    assert len(hashes) == 3
    refused(r'needs render\.light = "separated" \(given: "path_traced"\)', is_separated, Render(), _lit(), FAST)
    refused(r"a vectorised variant \(here: scalar_rgb\)", is_separated, RENDER, _lit(), SCALAR)


WRONG = {
    "another number of LEDs": ({"nL": 2, "values": _coefficients()[:, :2]}, "holds 2 LEDs, the scene has 4 lights"),
    "no pitch": ({"mmperpixel": None}, r"is no light as GelSight publishes it \('mmperpixel'\)"),
    "another table": ({"values": _coefficients()[:5]}, "200 numbers in quadfit, 4 lights"),
    "not finite": ({"values": np.full((6, LEDS, 10), np.inf)}, "values is no list of finite numbers"),
}


@pytest.mark.parametrize(("changes", "message"), WRONG.values(), ids=WRONG)
def test_other_files_are_refused_in_one_line(tmp_path: Path, changes: dict, message: str) -> None:
    _written(tmp_path, **changes)
    path = re.escape(str(tmp_path / "led.yaml"))
    refused(rf"\Asensor\.measured_light\.file: {path} .*{message}.*\Z", read_measured_light, _lit(**FLAT), tmp_path)


def test_missing_files_and_a_picture_without_tiles_are_refused(tmp_path: Path) -> None:
    read = partial(read_measured_light, _lit(**FLAT), tmp_path)
    refused(r"led\.yaml cannot be read: No such file", read)
    _written(tmp_path)
    (tmp_path / "led.png").write_bytes(encode_png(np.ones((36, 71), np.uint8)))
    refused(r"flat_field: .*led\.png is no picture of 4 equal tiles, 3 side by side", read)
    (tmp_path / "led.png").unlink()
    refused(r"flat_field: .*led\.png cannot be read", read)


@needs_llvm
@pytest.mark.skipif(not GSSIM.is_dir(), reason="no ../shared/real/gssim here: measured light of real devices")
@pytest.mark.parametrize("name", ["series1_1587_M6G0", "series2_2EF6_4JNW", "modulus1600_570C_TRLJ"])
def test_real_devices_are_met_at_rest_and_tilted_by_30_degrees(name: str) -> None:
    """Against the published formula with the published picture: rest within 2 levels, tilts within 10 per cent."""
    text, png = (GSSIM / f"{name}.yaml").read_text(), cv2.imread(str(GSSIM / f"{name}.png"), cv2.IMREAD_UNCHANGED)
    number = {key: float(re.search(rf"^{key}: (\S+)", text, re.M)[1]) for key in ("width", "height", "mmperpixel")}
    wide, high = (number[key] * number["mmperpixel"] for key in ("width", "height"))
    values = json.loads(re.search(r"quadfit:.*?values: (\[.*?\])", text, re.S)[1])
    scale = json.loads(re.search(r"flatfield:.*?scale: (\[.*?\])", text, re.S)[1])
    numbers = np.array(values).reshape(6, 6, 10)
    png = png if png.ndim == 2 else png[:, :, 0]
    rows, columns = png.shape[0] // 2, png.shape[1] // 3
    first = _lit().lights
    lights = (*first[:3], *[first[3]] * 3)
    focal = 80 / wide * (1000 - 6 + 6)
    camera = {"position_mm": (0.0, 0.0, 1000.0), "look_at_mm": (0.0, 0.0, 0.0), "cx": 40.0, "cy": 30.0}
    sensor = small_sensor(1.0, None, lights, **camera, fx=focal, fy=focal)
    sensor = sensor.model_copy(update={
        "gel": sensor.gel.model_copy(update={"size_mm": (1.2 * wide, 1.2 * high, 3.0)}),
        "measured_light": MeasuredLight(file=f"{name}.yaml", flat_field=f"{name}.png")})  # fmt: skip
    x, y = np.meshgrid((np.arange(80) + 0.5 - 40) * wide / 80, (np.arange(60) + 0.5 - 30) * wide / 80)
    u, v = x / high, y / high
    terms = np.stack([u * u, u * v, v * v, u, v, np.ones_like(u)])
    for polar, azimuth in [(0, 0), *((30, angle) for angle in range(0, 360, 60))]:
        slope = -np.tan(np.radians(polar)) * np.array([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))])
        n = np.array([*-slope, 1]) / np.hypot(1, np.linalg.norm(slope))
        positions = flat_surface(sensor).material.copy()
        positions[:, 2] = positions[:, :2] @ slope
        found = _radiance(sensor, GSSIM, positions)[6:-6, 12:-12]
        for led in range(3):
            a, b, c, d, e, f, *rest = np.tensordot(numbers[:, led], terms, (0, 0))
            form = np.einsum("i,ij...,j", n, np.array([[a, b, c], [b, d, e], [c, e, f]]), n)
            form = np.maximum(form + np.tensordot(n, np.array(rest[:3]), (0, 0)) + rest[3], 0)
            tile = png[led // 3 * rows : (led // 3 + 1) * rows, led % 3 * columns : (led % 3 + 1) * columns]
            places = ((x / wide + 0.5) * columns - 0.5, (y / high + 0.5) * rows - 0.5)
            field = cv2.remap(tile.astype(np.float32) / np.iinfo(png.dtype).max, *(p.astype(np.float32) for p in places), cv2.INTER_AREA)  # fmt: skip # noqa: E501
            error = np.abs(found[..., led] - (form * field / scale[led])[6:-6, 12:-12])
            own = found[..., led].mean()
            assert error.mean() < (2 / 255 if polar == 0 else 0.1 * own)
