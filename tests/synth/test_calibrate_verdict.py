"""Marks brighter than the coating, and which frames a calibration says are no good."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from render_scenes import FAST, needs_llvm
from test_calibrate import _frame, _real_frame, _start

from benchmarks.calibrations import press_ball
from synth.arrays import FloatArray
from synth.calibrate.comparison import Comparison, render_gel
from synth.calibrate.contact import change, find_contact, flanks
from synth.calibrate.dot_grid import fit_dot_grid
from synth.calibrate.dots import find_dots
from synth.calibrate.frames import Frames, at_rest, read_frames
from synth.calibrate.run import render_settings, start_sensor
from synth.calibrate.sensor_fit import find_grid, fit_sensor
from synth.calibrate.verdict import ALLOWED_OFF_GRID, common_displacement, verdict
from synth.cli import main
from synth.errors import InputError
from synth.render.pattern import pixels_per_mm
from synth.scene import Coating
from synth.scene.template import load_scene

REAL = Path(__file__).parents[3] / "shared/real"
needs_recordings = pytest.mark.skipif(not REAL.is_dir(), reason="the real recordings are not here")


@needs_llvm
def test_dots_brighter_than_the_coating_are_recovered() -> None:
    start = _start()
    lights = tuple(light.model_copy(update={"power": 900.0}) for light in start.lights)
    light = {"coating": Coating(reflectance=(0.05,) * 3), "lights": lights}
    grid = {"spacing_mm": (1.55, 1.62), "offset_mm": (0.33, -0.2), "radius_mm": 0.3, "reflectance": (0.6, 0.4, 0.5)}
    camera = start.camera.model_copy(update={"blur_px": 0.8})
    truth = start.model_copy(update=light | {"camera": camera, "pattern": start.pattern.model_copy(update=grid)})
    image = _frame(truth)
    fit = fit_sensor(start.model_copy(update=light), Frames(image, image, 1 / 255), FAST, None, 0)
    pattern = fit.sensor.pattern
    # As for dark dots; brightness differs across a dot by the lights' fall-off, some 2 % of a ratio of 12.
    assert pattern.spacing_mm == pytest.approx((1.55, 1.62), rel=3e-3)
    assert pattern.radius_mm == pytest.approx(0.3, rel=0.03)
    assert pattern.reflectance == pytest.approx((0.6, 0.4, 0.5), rel=0.05)
    assert fit.sensor.camera.blur_px == pytest.approx(0.8, abs=0.15)


def _dots(move: FloatArray) -> FloatArray:
    """A frame (240, 320, 3) of dark dots 31.5 px apart; `move` (7, 10, 2) px displaces them."""
    y, x = np.mgrid[:240, :320] + 0.5
    frame = np.ones((240, 320))
    for row, column in np.ndindex(7, 10):
        centre = np.array([18 + 31.5 * column, 25 + 31.5 * row]) + move[row, column]
        away = np.hypot(x - centre[0], y - centre[1])
        frame *= 1 - 0.8 * np.clip(6.5 - away, 0, 1)
    return np.repeat(0.4 * frame[:, :, None], 3, axis=2)


def _off_grid(linear: FloatArray) -> float:
    sensor = start_sensor(load_scene("gelsight_mini", []), (320, 240))
    dots = find_dots(linear, sensor.pattern.spacing_mm[0] * pixels_per_mm(sensor))
    grid = fit_dot_grid(sensor, sensor.pattern, dots.centres, None)
    return common_displacement(grid.index, grid.residual_px) / grid.pitch_px


def test_a_press_shows_in_what_neighbouring_dots_share_and_uneven_printing_does_not() -> None:
    place = np.stack(np.meshgrid(np.arange(10), np.arange(7)), axis=-1) - [5.0, 3.0]
    away = np.hypot(*np.moveaxis(place, 2, 0))[..., None]
    press = 3.5 * place * np.exp(-(away**2) / 5)  # up to 3.4 px outward around the contact
    jitter = np.random.default_rng(0).normal(0, 0.5, place.shape)  # 1.6 % of the pitch, gelsight_mini's own
    assert _off_grid(_dots(jitter)) < ALLOWED_OFF_GRID
    assert _off_grid(_dots(press)) > ALLOWED_OFF_GRID


@pytest.mark.parametrize(
    ("offset", "spot", "words"),
    [(3.0, 0, []), (5.0, 0, ["red 5."]), (0.0, 40, ["around pixel (60, 40)"]), (5.0, 40, ["red 5.", "(60, 40)"])],
    ids=["good", "other lights", "contact", "both"],
)
def test_the_verdict_names_the_residual_and_the_contact(offset: float, spot: float, words: list[str]) -> None:
    """A flat frame whose red is off by some levels, with a contact that is off by 40 on 3 % of the frame."""
    frame = np.full((120, 160, 3), 0.4)
    y, x = np.mgrid[:120, :160]
    rendered = frame + spot / 255 * np.exp(-((x - 60) ** 2 + (y - 40) ** 2) / 100)[..., None]
    rendered[..., 0] += offset / 255
    sensor = start_sensor(load_scene("digit", []), (160, 120))
    rows = {"frames": Comparison(frame, rendered, np.ones((120, 160), dtype=bool))}
    found = verdict(rows, {"frames": None}, sensor, False)
    assert found.good == (not words)
    assert len(found.reasons) == len(words)
    assert all(word in reason for word, reason in zip(words, found.reasons, strict=True))
    assert "scale" in found.lines()[-1]


def test_other_frames_of_a_bare_gel_are_compared_where_they_are_not_pressed() -> None:
    """A contact of 40 levels on a gel whose every level rose by 3; the edge of what counts as pressed is at 8."""
    rest = np.full((120, 160, 3), 0.4)
    y, x = np.mgrid[:120, :160]
    contact = 40 * np.exp(-((x - 60) ** 2 + (y - 40) ** 2) / 200)
    frame = rest + (3 + contact[..., None]) / 255
    still, smooth = at_rest(frame, rest)
    assert not still[contact > 5].any()
    assert still[contact < 0.5].all()  # four pixels further out: the neighbourhood's 3, and 1 by smoothing
    floor = Comparison(frame, rest, still, smooth).numbers()["floor"]
    assert floor == pytest.approx([3 + contact[still].mean()] * 3, abs=1e-3)


@needs_recordings
def test_pressed_real_gels_are_told_from_gels_at_rest_by_their_dots() -> None:
    def off_grid(image: FloatArray) -> float:
        try:
            return _off_grid((image[:, :, ::-1] / 255) ** 2.2)
        except InputError:  # no grid at all
            return 1.0

    pressed = sorted((REAL / "gelsight_mini/validation").glob("*_[12].png"))
    assert len(pressed) == 16
    assert min(off_grid(cv2.imread(str(path))) for path in pressed) > ALLOWED_OFF_GRID
    for name, number in [("avocado_real__exp_num_7__camera_0", 408), ("screw_driver_red__exp_num_2__camera_0", 344)]:
        assert off_grid(_real_frame(name, number)) < ALLOWED_OFF_GRID


@needs_recordings
def test_the_white_dots_of_a_real_gel_are_found_and_its_press_refused() -> None:
    sensor = start_sensor(load_scene("tac3d_single", []), (640, 480))
    linear = (cv2.imread(str(REAL / "other_sensors/tac3d/0000.png"))[:, :, ::-1] / 255) ** sensor.camera.gamma
    dots = find_dots(linear, sensor.pattern.spacing_mm[0] * pixels_per_mm(sensor))
    assert len(dots.centres) > 300  # of some 340
    with pytest.raises(InputError, match="the gel is pressed"):
        find_grid(sensor, linear, None)


@needs_llvm
@needs_recordings
@pytest.mark.parametrize(("frame", "status"), [("9dtact/rest", 0), ("9dtact/ball", 1), ("digit/0000", 1)])
def test_a_real_bare_gel_at_rest_passes_and_pressed_ones_do_not(tmp_path: Path, frame: str, status: int) -> None:
    path = str(REAL / f"other_sensors/{frame}.png")
    assert main(["calibrate", "--scene", "digit", "--frames", path, "--steps", "4", "--out", str(tmp_path)]) == status


PRESSES = {"0002": (1.458, -0.892, 0.503), "0034": (3.533, 1.068, 0.28), "0010": (-1.123, -4.439, 0.52)}
"""Photographs of a ball that the scene was not fitted to: the ball's place, mm, and the depth's logarithm, found."""


@needs_llvm
@needs_recordings
def test_the_scene_of_a_photographed_digit_lights_contacts_as_photographs_that_it_was_not_fitted_to() -> None:
    template = load_scene("digit_calibrated", [])
    sensor, render = start_sensor(template, (240, 320)), render_settings(template)
    paths = {name: REAL / f"other_sensors/digit/{name}.png" for name in ("rest", *PRESSES)}
    shown = {name: read_frames([path]).encoded for name, path in paths.items()}
    rest, y, x = render_gel(sensor, render, FAST), *np.mgrid[:320, :240]
    assert 255 * np.abs(rest - shown["rest"]).mean() < 6  # measured: 5.4, 4.8 and 6.0
    pixels, bare = np.column_stack([x.ravel(), y.ravel()]) + 0.5, np.ones((320, 240), dtype=bool)
    missed = []
    for name, (*place, depth) in PRESSES.items():
        ball = press_ball(sensor, 2.9, np.exp(depth), np.array(place), 0.65)
        pressed = render_gel(sensor, render, FAST, None, ball)
        changed = change(shown[name], shown["rest"], bare)
        contact = find_contact(changed, name)
        missed.append((pressed - shown[name])[contact.away((320, 240)) < 1])
        (azimuth, rise), (own, own_rise) = (
            flanks(pixels, each.reshape(-1, 3), contact) for each in (changed, 255 * (pressed - rest))
        )
        assert np.abs((own - azimuth + 180) % 360 - 180).max() < 15  # the bounds that the scene is to keep
        assert own_rise == pytest.approx(rise, rel=0.2)
    # Measured in six photographs: 11.1, 13.6 and 18.4.
    assert (255 * np.sqrt(np.mean(np.vstack(missed) ** 2, axis=0)) < [15, 17, 18]).all()
