"""What a ball's contact tells of the lights."""

import numpy as np
import pytest
from commands import refused
from render_scenes import FAST, needs_llvm, small_sensor

from synth.arrays import FloatArray
from synth.calibrate.ball_fit import Balls, find_presses
from synth.calibrate.contact import change, find_contact, flanks
from synth.calibrate.irradiance import LightGeometry, LitGel
from synth.calibrate.layouts import chosen
from synth.calibrate.lights import Target
from synth.calibrate.pressed_ball import press_ball
from synth.calibrate.sensor_fit import room_of
from synth.render.pattern import albedo
from synth.render.renderer import Renderer
from synth.scene import Light, Render, Sensor


def _sensor(*azimuths: float) -> Sensor:
    """A bare pad of 12 x 9 mm, lit in red, green and blue from azimuths in degrees."""
    lights = []
    for channel, angle in enumerate(np.radians(azimuths)):
        outward = np.array([np.cos(angle), np.sin(angle)])
        place = (*(7.0 * outward), 2.5)
        color = (float(channel == 0), float(channel == 1), float(channel == 2))
        lights.append(Light(position_mm=place, aim_mm=(0, 0, 0), size_mm=(1.5, 0.6), color=color, power=300))
    view = {"width": 160, "height": 120, "fx": 265.0, "fy": 265.0, "cx": 80.0, "cy": 60.0, "gamma": 2.2}
    return small_sensor(1.41, None, tuple(lights), **view)


@needs_llvm
def test_azimuths_of_known_lights_are_read_off_a_balls_flanks() -> None:
    """Lights that are 7 mm away are seen from the contact, 1.5 mm from the middle, up to 5 degrees turned."""
    azimuths = (-90.0, 20.0, 140.0)
    sensor = _sensor(*azimuths)
    ball = press_ball(sensor, 3.0, 0.5, np.zeros(2), 0.5)
    texture, render = albedo(sensor, np.random.default_rng(0)), Render(samples_per_pixel=16, light="separated")
    renderer = Renderer(sensor, render, ball.surface, texture, FAST)
    rest, pressed = (_encoded(renderer.radiance(each, 0)) for each in (ball.surface.material, ball.positions))
    changed = change(pressed, rest, np.ones(rest.shape[:2], dtype=bool))
    contact = find_contact(changed, "frame")
    middle = np.array([80.0, 60.0])
    assert np.linalg.norm(contact.middle - middle) < 4  # px: the search's grid has a pitch of 6 px
    columns, rows = np.meshgrid(np.arange(160), np.arange(120))
    pixels = np.column_stack([columns.ravel(), rows.ravel()]) + 0.5
    azimuth, rise = flanks(pixels, changed.reshape(-1, 3), contact)
    assert np.abs((azimuth - azimuths + 180) % 360 - 180).max() < 8  # and the circle is up to 4 px of 20 off
    assert rise.min() > 10


def _encoded(radiance: FloatArray) -> FloatArray:
    return np.asarray(np.clip(radiance, 0, 1), dtype=np.float64) ** (1 / 2.2)


def test_a_frame_without_a_contact_is_refused() -> None:
    noise = np.random.default_rng(0).normal(0, 0.5, (120, 160, 3))
    refused("frame: no ball's contact is seen", find_contact, noise, "frame")


def _on_a_ball(radius_px: float) -> FloatArray:
    """What a ball changes, encoded (120, 160, 3): planes of 60 levels within a circle."""
    y, x = np.mgrid[:120, :160] + 0.5
    u, v = (x - 80) / radius_px, (y - 60) / radius_px
    return np.stack([u, -v, v], axis=-1) * (np.hypot(u, v) < 1)[:, :, None] * 60 / 255


WRONG = {
    "no contact": (_on_a_ball(20.0) * 0, 3.0, "b.png: no ball's contact is seen in it"),
    "another radius": (_on_a_ball(40.0), 1.0, r"has a radius of \S+ mm, which no ball of --radius-mm = 1 makes"),
    "another sensor": (
        _on_a_ball(20.0) + 0.1,
        3.0,
        "beside the ball it differs by 25.5 of 255 from the frames at rest",
    ),
}


@pytest.mark.parametrize(("changed", "radius", "message"), WRONG.values(), ids=WRONG)
def test_frames_that_the_ball_cannot_have_made_are_refused(changed: FloatArray, radius: float, message: str) -> None:
    rest, bare = np.full((120, 160, 3), 0.4), {"b.png": np.ones((120, 160), dtype=bool)}
    balls = Balls({"b.png": rest + changed}, radius, 0.5)
    assert refused(message, find_presses, _sensor(-90.0, 20.0, 140.0), balls, rest, bare).count("\n") == 0


def test_a_press_through_the_gel_is_refused() -> None:
    message = "\\Aa ball of 3 mm pressed in by 2.8 mm: motion.depth_mm = 2.8 is more than 85 %.*\\Z"
    refused(message, press_ball, _sensor(0.0, 120.0, 240.0), 3.0, 2.8, np.zeros(2), 0.5)


def test_a_camera_that_moved_is_refused() -> None:
    """Light that falls off by a level a pixel, seen 12 px beside."""
    rest = np.linspace(0.2, 0.8, 172)[None, :, None] * np.ones((120, 1, 3))
    frame = rest[:, 12:] + _on_a_ball(20.0)
    balls, bare = Balls({"b.png": frame}, 3.0, 0.5), {"b.png": np.ones((120, 160), dtype=bool)}
    sensor = _sensor(-90.0, 20.0, 140.0)
    refused("the camera moved, or it is another sensor's", find_presses, sensor, balls, rest[:, :160], bare)


@needs_llvm
def test_light_on_a_pressed_face_is_what_the_renderer_renders() -> None:
    """With the shadow that the contact throws."""
    sensor = _sensor(-90.0, 20.0, 140.0)
    ball = press_ball(sensor, 2.0, 0.8, np.array([0.5, -0.3]), 0.5)
    render = Render(samples_per_pixel=64, max_depth=3, light="separated")
    renderer = Renderer(sensor, render, ball.surface, albedo(sensor, np.random.default_rng(0)), FAST)
    image = renderer.radiance(ball.positions, 0)
    columns, rows = (axis.ravel() for axis in np.meshgrid(np.arange(40, 120, 5), np.arange(20, 100, 5)))
    gel = LitGel(sensor, np.column_stack([columns, rows]) + 0.5, FAST, (ball.surface, ball.positions))
    lit = 300 * gel.contributions(LightGeometry.of(sensor.lights))
    for channel in range(3):
        seen, own = image[rows, columns, channel], lit[channel, :, channel]
        # Shadows' edges are sharp within a pixel, which the renderer averages: a few of 256 points lie on one.
        assert np.median(np.abs(own - seen)) < 0.015 * seen.mean()
        assert own.mean() == pytest.approx(seen.mean(), rel=0.02)


@needs_llvm
def test_a_layout_is_chosen_from_all_around_and_not_near_the_presets() -> None:
    truth, start = _sensor(-90.0, 15.0, 135.0), _sensor(60.0, -150.0, -20.0)
    columns, rows = (axis.ravel() for axis in np.meshgrid(np.arange(4, 160, 12), np.arange(4, 120, 12)))
    gel = LitGel(truth, np.column_stack([columns, rows]) + 0.5, FAST)
    signal = 300 * np.einsum("mpc,mc->pc", gel.contributions(LightGeometry.of(truth.lights)), np.eye(3))
    target = Target(signal, np.ones_like(signal), 1.0, np.zeros(len(signal)))
    like = LightGeometry.of(start.lights)
    found = chosen([gel], target, like, np.eye(3, dtype=bool), 0.0, room_of(start))
    azimuth = np.degrees(np.arctan2(found.centre[:, 1], found.centre[:, 0]))
    assert azimuth == pytest.approx([-90, 15, 135], abs=15.1)  # candidates are 15 degrees apart
