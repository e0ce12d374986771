"""A picture of the user's own: its values come out in the right place without aliasing; or one clear message."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import refused
from PIL import ExifTags
from PIL import Image as Pillow
from render_scenes import small_sensor
from tiny_scene import TEXT, write_tiny

from synth.arrays import FloatArray
from synth.dataset.reader import read_dataset
from synth.pipeline.generate import generate
from synth.planning import check_buildable
from synth.render.bitmap import read_picture
from synth.render.pattern import albedo, check_pattern
from synth.render.variant import choose_variant
from synth.scene import Bitmap, Coating, Sensor
from synth.scene.template import load_scene

ROWS, COLUMNS = 252, 336  # Texels of the pad of 12 x 9 mm at 7 px per mm
WHOLE, FLOATS = cv2.imencode(".png", np.eye(50, dtype=np.uint8))[1].tobytes(), cv2.imencode(".tiff", np.ones((4, 4)))[1]
NO_PICTURES = {"missing": None, "empty": b"", "text": b"<svg/>", "truncated": WHOLE[:-20], "float": FLOATS.tobytes()}
BITMAP = 'sensor.pattern={ kind = "bitmap", file = "art/mine.png", width_mm = 8 }'


def _sensor(pattern: Bitmap, coating: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Sensor:
    return small_sensor(pattern=pattern).model_copy(update={"coating": Coating(reflectance=coating)})


def _bitmap(file: str, **where: object) -> Bitmap:
    return Bitmap(**({"kind": "bitmap", "file": file, "width_mm": 12.0} | where))


def _laid(folder: Path, stored: np.ndarray, coating=(1.0, 1.0, 1.0), **where: object) -> FloatArray:
    """The texture with a picture, given as OpenCV stores it: BGR."""
    assert cv2.imwrite(str(folder / "mine.png"), stored)
    texture = albedo(_sensor(_bitmap("mine.png", **where), coating), np.random.default_rng(0), folder)
    assert texture.shape == (ROWS, COLUMNS, 3)
    return texture.astype(np.float64)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3])
def test_values_come_back(tmp_path: Path, kind: type, channels: int) -> None:
    full = np.iinfo(kind).max
    stored = np.random.default_rng(1).integers(0, full + 1, (ROWS, COLUMNS, channels)).astype(kind)
    texture = _laid(tmp_path, stored)
    wanted = np.repeat(stored, 3, axis=2) if channels == 1 else stored[:, :, ::-1]
    # The other direction of sRGB's curve, from IEC 61966-2-1.
    power = 1.055 * np.maximum(texture, 1e-9) ** (1 / 2.4) - 0.055
    encoded = np.where(texture <= 0.0031308, 12.92 * texture, power)
    # Texels and pixels coincide: what remains is rounding in float32, far below the 1/255 that is promised.
    assert np.abs(encoded - wanted / full).max() < 1e-5


def test_a_coarse_picture_is_placed_and_turned_about_its_middle(tmp_path: Path) -> None:
    stored = np.full((30, 40), 255, np.uint8)
    stored[4:6, 28:30] = 0  # its middle lies 9 px right of and 10 px above the picture's: 1.8 and -2 mm
    texture = _laid(tmp_path, stored, width_mm=8.0, offset_mm=(1.0, -0.5), rotation_deg=30.0)
    dark = 1 - texture[:, :, 0]
    x, y = ((np.arange(COLUMNS) + 0.5) / COLUMNS - 0.5) * 12, ((np.arange(ROWS) + 0.5) / ROWS - 0.5) * 9
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    # Linear interpolation is even about the mark's middle; a texel is 0.036 mm.
    assert (dark * x).sum() / dark.sum() == pytest.approx(1.0 + 1.8 * c + 2.0 * s, abs=2e-3)
    assert (dark * y[:, None]).sum() / dark.sum() == pytest.approx(-0.5 + 1.8 * s - 2.0 * c, abs=2e-3)
    assert dark.sum() * (12 / COLUMNS) ** 2 == pytest.approx(0.4**2, rel=5e-3)


def test_white_transparent_and_beside_it_is_the_bare_coating(tmp_path: Path) -> None:
    coating = (0.6, 0.5, 0.4)
    stored = np.full((100, 100, 4), 255, np.uint8)
    stored[:50, :, :3], stored[:50, :50, 3] = 0, 0  # upper half black, its left quarter transparent
    stored[50:, :50] = (0, 0, 255, 128)  # lower left: red, half transparent
    texture = _laid(tmp_path, stored, coating, width_mm=6.0)

    def at(x: float, y: float) -> FloatArray:
        return texture[int((y / 9 + 0.5) * ROWS), int((x / 12 + 0.5) * COLUMNS)]

    transparent_black, black, white, beside_it = at(-1.5, -1.5), at(1.5, -1.5), at(1.5, 1.5), at(5.0, 0.0)
    np.testing.assert_allclose([transparent_black, white, beside_it], [coating] * 3, atol=1e-6)
    np.testing.assert_allclose(black, 0, atol=1e-6)
    share = 128 / 255
    np.testing.assert_allclose(at(-1.5, 1.5), [0.6, 0.5 * (1 - share), 0.4 * (1 - share)], atol=1e-6)
    edge = texture[int(0.33 * ROWS) : int(0.36 * ROWS), COLUMNS // 4 + 3 : 3 * COLUMNS // 4 - 3]
    assert 0 <= edge.min() <= edge.max() <= 0.6 + 1e-6  # no fringe brighter than coating or black


def test_stripes_finer_than_a_texel_become_their_mean(tmp_path: Path) -> None:
    columns = round(COLUMNS / 0.3)  # one dark and one bright column a period
    stored = np.zeros((600, columns), np.uint8)
    stored[:, ::2] = 255
    texture = _laid(tmp_path, stored, rotation_deg=4.0)[:, :, 0]
    inner = texture[ROWS // 2 - 8 : ROWS // 2 + 8, 40:-40]
    pixels = inner.reshape(4, 4, -1, 4).mean(axis=(1, 3))  # four texels a pixel
    # A texel's box leaves (2/pi) sinc(1/0.6) = 0.1 of a stripe's first harmonic at 1/3 cycle per texel, of which linear
    # interpolation and the pixel's own box leave sinc(4/3) = 0.2: 0.02. Seen: 0.014; 0.052 without the averages.
    assert pixels.std() < 0.03
    assert inner.mean() == pytest.approx(0.5, abs=0.01)


def test_grey_with_alpha_palettes_and_turned_photographs_are_read(tmp_path: Path) -> None:
    values = np.random.default_rng(0).integers(0, 256, (6, 8, 2)).astype(np.uint8)
    Pillow.fromarray(values, "LA").save(tmp_path / "la.png")
    Pillow.fromarray(values[:, :, 0]).convert("P").save(tmp_path / "palette.png")
    Pillow.fromarray(values[:, :, 0]).save(tmp_path / "grey.tiff")
    sensors = (_sensor(_bitmap(name)) for name in ("la.png", "palette.png", "grey.tiff"))
    with_alpha, palette, grey = (albedo(sensor, np.random.default_rng(0), tmp_path) for sensor in sensors)
    assert np.array_equal(palette, grey)
    opacity, place = values[3, 4, 1] / 255, (int(3.5 / 6 * ROWS), int(4.5 / 8 * COLUMNS))
    # Half a texel of 42 off the pixel's middle.
    assert with_alpha[place] == pytest.approx(1 - opacity * (1 - grey[place]), abs=0.03)
    stored = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)
    exif = Pillow.Exif()
    exif[ExifTags.Base.Orientation] = 6  # to be turned by a quarter, clockwise
    Pillow.fromarray(stored).save(tmp_path / "photograph.png", exif=exif)
    Pillow.fromarray(np.rot90(stored, -1)).save(tmp_path / "turned.png")
    pictures = (read_picture(_bitmap(name), tmp_path) for name in ("photograph.png", "turned.png"))
    np.testing.assert_array_equal(*pictures)


@pytest.mark.parametrize("data", NO_PICTURES.values(), ids=NO_PICTURES)
def test_what_is_no_picture_is_refused_in_one_line(tmp_path: Path, data: bytes | None) -> None:
    path, sensor = tmp_path / "mine.png", _sensor(_bitmap("mine.png"))
    message = "cannot be read: No such file or directory" if data is None else "no whole picture of 8 or 16 bits"
    if data is not None:
        path.write_bytes(data)
    line = rf"\Asensor\.pattern\.file: {re.escape(str(path))}.*{message}.*\Z"
    refused(line, albedo, sensor, np.random.default_rng(0), tmp_path)
    refused(line, check_pattern, sensor, tmp_path)


@pytest.fixture
def scene(tiny: Path, one_cache: None, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tiny.parent / "art").mkdir()
    monkeypatch.chdir(tiny.parent)
    return tiny


def _draw(scene: Path, picture: np.ndarray) -> None:
    assert cv2.imwrite(str(scene.parent / "art" / "mine.png"), picture)


def _is_half_black(scene: Path, out: str, *overrides: str) -> bool:
    generate(load_scene(scene, [*overrides, "sensor.camera.read_noise=0"]), 1, scene.parent / out)
    image = read_dataset(scene.parent / out).read(0).image1
    return bool(image[:, 2:14].max() < 10 and image[:, 18:30].mean() > 50)


def test_a_picture_lies_beside_the_scene_or_where_the_user_is(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _draw(scene, np.where(np.arange(80) < 40, 0, 255).astype(np.uint8)[None].repeat(60, axis=0))
    monkeypatch.chdir(scene.parent / "art")
    assert _is_half_black(scene, "by_set", BITMAP.replace("art/", ""))
    monkeypatch.chdir("/")
    bitmap = re.sub(r"pattern = .*", BITMAP.removeprefix("sensor."), TEXT)
    assert _is_half_black(write_tiny(scene.parent, bitmap), "beside")


def test_a_missing_picture_is_told_and_another_one_is_another_scene(scene: Path) -> None:
    place = f"{scene} with --set sensor.pattern: sensor.pattern.file"
    assert refused(".", load_scene, scene, [BITMAP]) == f"{place}: there is no file {scene.parent / 'art/mine.png'}"
    hashes = []
    for grey in (100, 100, 101):
        _draw(scene, np.full((4, 4), grey, np.uint8))
        hashes.append(load_scene(scene, [BITMAP]).hash)
    assert hashes[0] == hashes[1] != hashes[2]


@pytest.mark.parametrize(("override", "message"), [
    (BITMAP, "sensor.pattern.file: .*mine.png is no whole picture"),
    ("sensor.pattern.spacing_mm=[1, 0.05]", "sensor.pattern.spacing_mm = 0.05: .*at least"),
])  # fmt: skip
def test_what_cannot_be_painted_is_refused_before_the_job(scene: Path, override: str, message: str) -> None:
    (scene.parent / "art" / "mine.png").write_text("no picture")
    said = refused(message, lambda: check_buildable(load_scene(scene, [override]), choose_variant("cpu")))
    assert said.startswith(f"{scene} with --set {override.partition('=')[0]}: sensor.pattern.")
