"""What a ball's contact tells of the lights."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomli_w
from commands import refused, said
from render_scenes import FAST, needs_llvm, small_sensor
from scipy.interpolate import LinearNDInterpolator

from benchmarks.calibrations import press_ball
from synth.arrays import FloatArray
from synth.calibrate.ball_fit import Balls, find_presses
from synth.calibrate.contact import change, find_contact, flanks
from synth.calibrate.irradiance import LightGeometry, LitGel, PressChange
from synth.calibrate.layouts import around, chosen
from synth.calibrate.lights import Room, Target, fit_lights
from synth.calibrate.pressed_ball import press_series
from synth.calibrate.sensor_fit import room_of
from synth.cli import main
from synth.render.camera_image import camera_image
from synth.render.pattern import albedo
from synth.render.renderer import Renderer
from synth.scene import Light, NoPattern, Render, Sensor


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
    surface, positions = press_ball(sensor, 3.0, 0.5, np.zeros(2), 0.5)
    texture, render = albedo(sensor, np.random.default_rng(0)), Render(samples_per_pixel=16, light="separated")
    renderer = Renderer(sensor, render, surface, texture, FAST)
    rest, pressed = (_encoded(renderer.radiance(each, 0)) for each in (surface.material, positions))
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


def test_a_series_has_the_faces_of_single_presses() -> None:
    sensor, place, depth = _sensor(0.0, 120.0, 240.0), np.array([0.5, -0.4]), 0.53
    series, (_, positions) = press_series(sensor, 3.0, 0.9, 0.5), press_ball(sensor, 3.0, depth, place, 0.5)
    pose = np.array([*place, np.log(depth)])
    surface, whole = series.pressed(pose)
    away = np.linalg.norm(positions[:, :2] - place, axis=1)
    near = away < 2.5
    for face in (series.face(pose), whole):
        height = LinearNDInterpolator(face[:, :2], face[:, 2])(positions[near, :2])
        # mm: both meshes are made for errors of 0.004, on either side, and largest where the gel leaves the ball
        assert np.sqrt(np.mean((height - positions[near, 2]) ** 2)) < 0.012
    # Edges stay where they are, and points of the pattern that the ball does not reach.
    ends = np.stack([-whole[:, :2].min(axis=0), whole[:, :2].max(axis=0)])
    assert ends == pytest.approx(np.tile(sensor.gel.size_mm[:2], (2, 1)) / 2, abs=0.1)  # mm: 0.055 is how it bulges
    far = np.linalg.norm(surface.material[:, :2] - place, axis=1) > 4.5
    np.testing.assert_allclose(whole[far, :2], surface.material[far, :2], atol=0.1)
    contact = away[positions[:, 2] - (depth - 3.0 + np.sqrt(9.0 - np.minimum(away, 3.0) ** 2)) < 0.01].max()
    assert series.depth_mm(contact) == pytest.approx(depth, rel=0.25)  # vertices are 0.2 mm apart


@needs_llvm
def test_poses_are_found_together_with_the_lights() -> None:
    """From poses as circles of contacts tell them, and the heights of lights half a millimetre off."""
    sensor, series = _sensor(-90.0, 20.0, 140.0), press_series(_sensor(-90.0, 20.0, 140.0), 3.0, 0.9, 0.5)
    truth, poses = LightGeometry.of(sensor.lights), np.array([[-1.5, -1.0, np.log(0.5)], [1.5, 1.0, np.log(0.4)]])
    columns, rows = (axis.ravel() for axis in np.meshgrid(np.arange(4, 160, 8), np.arange(4, 120, 8)))
    pixels = np.column_stack([columns, rows]) + 0.5
    flat = LitGel(sensor, pixels, FAST)

    def press(pose: FloatArray) -> PressChange:
        return PressChange(LitGel(sensor, pixels, FAST, (series.surface, series.face(pose))), flat)

    shown = np.concatenate([one.contributions(truth) for one in (flat, *map(press, poses))], axis=1)
    signal = 300 * np.einsum("mpc,mc->pc", shown, np.eye(3))
    target = Target(signal, np.ones_like(signal), 1.0, np.zeros(len(signal)))
    start = replace(truth, centre=truth.centre + np.array([0.0, 0.0, 0.5]))
    off = poses + np.array([[0.2, -0.2, 0.2], [-0.2, 0.1, -0.2]])
    found = fit_lights(flat, target, start, np.eye(3, dtype=bool), 0.0, room_of(sensor), 12, (press, press), off)
    assert np.abs(found.poses - poses).max() < 0.03  # the prior pulls: a tenth of where poses start
    assert np.abs(found.geometry.centre - truth.centre).max() < 0.25


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
    pressed = press_ball(sensor, 2.0, 0.8, np.array([0.5, -0.3]), 0.5)
    render = Render(samples_per_pixel=64, max_depth=3, light="separated")
    renderer = Renderer(sensor, render, pressed[0], albedo(sensor, np.random.default_rng(0)), FAST)
    image = renderer.radiance(pressed[1], 0)
    columns, rows = (axis.ravel() for axis in np.meshgrid(np.arange(40, 120, 5), np.arange(20, 100, 5)))
    gel = LitGel(sensor, np.column_stack([columns, rows]) + 0.5, FAST, pressed)
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
    found = chosen([gel], target, like, np.eye(3, dtype=bool), 0.0, room_of(start), fitted=False)
    azimuth = np.degrees(np.arctan2(found.centre[:, 1], found.centre[:, 0]))
    assert azimuth == pytest.approx([-90, 15, 135], abs=15.1)  # candidates are 15 degrees apart


@needs_llvm
def test_of_fitted_lights_the_misplaced_one_is_replaced_and_the_others_stay() -> None:
    truth, start = _sensor(-90.0, 15.0, 135.0), _sensor(-90.0, -150.0, 135.0)
    columns, rows = (axis.ravel() for axis in np.meshgrid(np.arange(4, 160, 12), np.arange(4, 120, 12)))
    gel = LitGel(truth, np.column_stack([columns, rows]) + 0.5, FAST)
    powers = 300 * np.array([[1, 0, 0], [1, 0, 0], [0, 0, 1]])
    signal = np.einsum("mpc,mc->pc", gel.contributions(LightGeometry.of(truth.lights)), powers)
    target = Target(signal, np.ones_like(signal), 1.0, np.zeros(len(signal)))
    like = LightGeometry.of(start.lights)
    found = chosen([gel], target, like, powers > 0, 0.0, room_of(start), fitted=True)
    np.testing.assert_array_equal(found.centre[[0, 2]], like.centre[[0, 2]])
    azimuth = np.degrees(np.arctan2(found.centre[1, 1], found.centre[1, 0]))
    assert azimuth == pytest.approx(15, abs=15.1)  # candidates are 15 degrees apart


@pytest.mark.slow
@needs_llvm
def test_known_lights_are_found_from_three_frames_at_rest_and_three_presses(tmp_path: Path, capsys) -> None:
    """Through the command, started 70 degrees off; a fourth press is judged and not fitted."""
    azimuths = np.array([-80.0, 35.0, 150.0])
    truth, start = (
        _sensor(*azimuths + turn).model_copy(update={"pattern": NoPattern(kind="none")}) for turn in (0, 70)
    )
    texture, render = (
        albedo(truth, np.random.default_rng(0)),
        Render(samples_per_pixel=36, max_depth=3, light="separated"),
    )
    depths, around = (0.45, 0.55, 0.4, 0.5), ((-2, -1.2), (2, 1), (1.8, -1.4), (-1.6, 1.5))
    presses = [press_ball(truth, 3.0, *each, 0.5) for each in zip(depths, np.array(around), strict=True)]
    still = presses[0][0]
    faces = [(still, still.material)] * 3 + presses
    for number, (surface, positions) in enumerate(faces):
        radiance = Renderer(truth, render, surface, texture, FAST).radiance(positions, number)
        image = camera_image(radiance, truth.camera, np.random.default_rng(number))
        cv2.imwrite(str(tmp_path / f"{number}.png"), image[:, :, ::-1])
    sensor = start.model_dump(mode="json", exclude={"further_cameras", "mirrors"}, exclude_none=True)
    content = {"name": "start", "sensor": sensor, "motion": {"depth_mm": 0.4, "steps": 1},
               "contact": {"indenter": {"shape": "sphere", "radius_mm": 3.0}, "friction": 0.5},
               "render": {"light": "separated", "max_depth": 3, "samples_per_pixel": 16}}  # fmt: skip
    (tmp_path / "start.toml").write_text(tomli_w.dumps(content))
    rest, fitted = ([tmp_path / f"{k}.png" for k in numbers] for numbers in ((0, 1, 2), (3, 4, 5)))
    given = ["--frames", *rest, "--ball", *fitted, "--judge-ball", tmp_path / "6.png", "--radius-mm", 3]
    out = tmp_path / "fit"
    said(capsys, main, "calibrate", "--scene", tmp_path / "start.toml", *given, "--steps", 16, "--out", out)
    record = json.loads((out / "calibration.json").read_text())
    places = np.array([light["position_mm"] for light in record["lights"]])
    powers = np.array([max(light["power_per_channel"]) for light in record["lights"]])
    own = np.array([light.position_mm for light in truth.lights])
    turned = np.degrees(np.arctan2(places[:, 1], places[:, 0])) - azimuths
    assert np.abs((turned + 180) % 360 - 180).max() < 5  # the bounds that calibration is to keep
    raised = np.subtract(*(np.degrees(np.arctan2(each[:, 2], np.hypot(*each[:, :2].T))) for each in (places, own)))
    assert np.abs(raised).max() < 10
    assert powers == pytest.approx([light.power for light in truth.lights], rel=0.1)
    assert [Path(contact["frame"]).stem for contact in record["contacts"]] == ["3", "4", "5", "6"]
    for contact in record["contacts"]:
        assert max(contact["rms_within"]) < 6  # levels: as between frames, the camera's noise is 2
        assert np.abs(np.subtract(*contact["azimuth_deg"].values())).max() < 5
    assert record["verdict"]["good"]
    given[given.index("--radius-mm") + 1] = 6
    command = ["calibrate", "--scene", tmp_path / "start.toml", *given, "--steps", 8, "--out", tmp_path / "wrong"]
    assert main(list(map(str, command))) == 2
    assert "--radius-mm = 6: a ball of 3.6 mm explains the frames far better" in capsys.readouterr().err


def test_a_long_light_across_a_corner_of_the_view_is_in_it() -> None:
    """Its ends and its middle are outside; an eighth of it is within."""
    room = Room(np.full((1, 3), -20.0), np.full((1, 3), 20.0), np.array([[-8.0, -6.0], [8.0, 6.0]]), np.zeros((2, 2)))
    light = LightGeometry(
        np.array([[9.0, 4.0, 3.0]]), np.array([[-1.0, -1.0, 0.0]]), np.array([[12.0, 0.5]]), np.array([[60.0]])
    )
    assert room.intrusion(light).max() > 0.3
    tried = around(light, room)
    assert len(tried.centre) > 100
    assert room.intrusion(tried).max() == 0
