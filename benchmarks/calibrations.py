"""How near does `synth calibrate --ball` come to lights that are known?

Synthetic bare sensors of 160 x 120 px, with three to eight lights in three colours around the view, are drawn by their
number and the seed: azimuths, distances, heights, sizes and powers. Each gives three noisy frames at rest and four
presses of a ball of 3 mm. The fit starts from as many lights, evenly spaced, turned by a random angle.
calibrations.csv has a row per sensor: the largest error of its lights' azimuth and elevation, seen from the gel's
middle, and of their power, and whether these are within 5 degrees, 10 degrees and 10 per cent.
"""

import contextlib
import io
import json
import time
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tomli_w
from scipy.optimize import linear_sum_assignment

from benchmarks.rows import Row, arguments, machine, measure, show
from synth.arrays import FloatArray, Points
from synth.calibrate.irradiance import LightGeometry, LitGel
from synth.cli import main as synth
from synth.press.press import MeshRule
from synth.render.camera_image import camera_image
from synth.render.pattern import albedo, pixels_per_mm
from synth.render.renderer import Renderer
from synth.render.variant import choose_variant
from synth.scene import Render, Scene, Sensor
from synth.scene.validation import validated
from synth.simulate import simulate
from synth.surface import GelSurface

AZIMUTH_DEG, ELEVATION_DEG, POWER = 5.0, 10.0, 0.1
"""Errors within which a sensor counts as found; of the power, relative."""
LIGHTS, RADIUS_MM, DEPTHS_MM, VIEW_MM = (3, 8), 3.0, (0.4, 0.65), (13.0, 9.75)
PLACES_MM = ((-3.0, -2.0), (3.0, 1.8), (2.6, -2.2), (-2.6, 2.2))
LEVELS = (0.35, 0.55)
"""Encoded value of each channel in the middle of the gel at rest."""


def main(argv: list[str]) -> int:
    """Measure, or go on; 1 if fewer than nine of ten sensors are found."""
    parser = arguments("calibrations", __doc__)
    parser.add_argument("--n", type=int, default=10, help="number of sensors")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(argv)
    cases = [{"seed": given.seed, "sensor": number} for number in range(given.n)]
    rows = measure(given.out / "calibrations.csv", cases, partial(calibrated, given.out / "calibrations"))
    print(machine())
    show(rows, list(rows[0]), "Largest error of a sensor's lights")
    found = sum(row["found"] for row in rows)
    print(f"{found} of {len(rows)} sensors are within {AZIMUTH_DEG:g} and {ELEVATION_DEG:g} degrees and {POWER:.0%}")
    return 0 if found >= 0.9 * len(rows) else 1


def drawn(seed: int, number: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Content of the known scene, and of the one that the fit starts from."""
    rng = np.random.default_rng([seed, number])
    count = int(rng.integers(LIGHTS[0], LIGHTS[1] + 1))
    spacing, turn = 360 / count, rng.uniform(0, 360)
    truth, start = [], []
    for k in range(count):
        color = np.eye(3)[k % 3].tolist()
        angle = turn + spacing * (k + rng.uniform(-0.25, 0.25))
        size = [rng.uniform(1, 2.5), rng.uniform(0.4, 0.8)]
        truth.append(_light(angle, rng.uniform(1.5, 3), rng.uniform(1, 4), size, rng.uniform(0.6, 1.6), color))
    other = rng.uniform(0, 360)
    for k, light in enumerate(truth):
        start.append(_light(other + spacing * k, 2.0, 2.5, [1.5, 0.6], 1.0, light["color"]))
    known = validated(_scene(truth), "known lights", Scene).sensor
    gel = LitGel(known, np.array([[80.5, 60.5]]), choose_variant("auto"))
    one = gel.contributions(LightGeometry.of(known.lights))[:, 0]
    lit = (one * [np.multiply(light.power, light.color) for light in known.lights]).sum(axis=0)
    power = rng.uniform(*LEVELS, 3) ** known.camera.gamma / (lit * known.camera.exposure)
    for light in truth:
        light["power"] *= float(power @ light["color"])
    for light in start:
        light["power"] = float(power.mean())
    return _scene(truth), _scene(start)


def _light(
    angle: float, beside: float, height: float, size: list[float], power: float, color: list[float]
) -> dict[str, Any]:
    """A light so far (mm) beside the view in an azimuth of degrees, turned to the gel's middle."""
    outward = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    half = np.array(VIEW_MM) / 2 + beside
    place = [*(outward * np.min(half / np.maximum(np.abs(outward), 1e-9))).tolist(), height]
    return {"position_mm": place, "aim_mm": [0.0, 0.0, height], "size_mm": size, "power": power, "color": color}


def _scene(lights: list[dict[str, Any]]) -> dict[str, Any]:
    focal = 160 / VIEW_MM[0] * 30
    camera = {"width": 160, "height": 120, "fx": focal, "fy": focal, "cx": 80.0, "cy": 60.0, "gamma": 2.2,
              "position_mm": [0.0, 0.0, 30.0], "look_at_mm": [0.0, 0.0, 0.0],
              "read_noise": 0.004, "shot_noise": 0.006}  # fmt: skip
    sensor = {
        "gel": {"shape": "box", "size_mm": [18.0, 14.0, 2.5], "youngs_modulus_kpa": 200.0},
        "window": {"refractive_index": 1.41, "thickness_mm": 4.0},
        "coating": {"reflectance": [0.65, 0.65, 0.65]},
        "pattern": {"kind": "none"},
        "camera": camera,
        "lights": lights,
    }
    contact = {"indenter": {"shape": "sphere", "radius_mm": RADIUS_MM}, "friction": 0.5}
    render = {"light": "separated", "max_depth": 3, "samples_per_pixel": 36}
    return {"name": "known_lights", "sensor": sensor, "contact": contact, "render": render,
            "motion": {"depth_mm": 0.4, "steps": 1}}  # fmt: skip


def photographs(content: dict[str, Any], rng: np.random.Generator, out: Path) -> tuple[list[Path], list[Path]]:
    """Three frames of a scene's sensor at rest and four presses, written as PNG."""
    scene = validated(content, "known lights", Scene)
    sensor, render = scene.sensor, Render.model_validate(content["render"])
    depths, places = rng.uniform(*DEPTHS_MM, 4), np.array(PLACES_MM) + rng.uniform(-0.4, 0.4, (4, 2))
    presses = [
        press_ball(sensor, RADIUS_MM, float(depth), place, 0.5) for depth, place in zip(depths, places, strict=True)
    ]
    texture, still = albedo(sensor, rng), presses[0][0]
    faces = [(still, still.material)] * 3 + presses
    files = []
    for number, (surface, positions) in enumerate(faces):
        radiance = Renderer(sensor, render, surface, texture, choose_variant("auto")).radiance(positions, number)
        files.append(out / f"{number}.png")
        cv2.imwrite(str(files[-1]), camera_image(radiance, sensor.camera, rng)[:, :, ::-1])
    return files[:3], files[3:]


def press_ball(
    sensor: Sensor, radius_mm: float, depth_mm: float, place_mm: FloatArray, friction: float
) -> tuple[GelSurface, Points]:
    """The face and its vertices (v, 3) mm under a ball, simulated at its own place (2,) mm."""
    content = {
        "name": "ball",
        "sensor": sensor.model_dump(),
        "contact": {"indenter": {"shape": "sphere", "radius_mm": radius_mm}, "friction": friction},
        "motion": {"depth_mm": depth_mm, "position_mm": place_mm.tolist(), "steps": 1},
        "numerics": {"target_error_px": 0.004 * pixels_per_mm(sensor)},
    }
    scene = validated(content, "a pressed ball", Scene)
    trajectory = simulate(scene, MeshRule.of(scene).resolution(scene).mesh)
    assert trajectory.status == "complete", trajectory.reason
    surface = GelSurface(trajectory.space.surface, 3)
    return surface, surface.positions(trajectory.states[-1].displacement[trajectory.space.surface_nodes])


def calibrated(out: Path, case: Row) -> Row:
    """A sensor's photographs, the command, and how far its lights are from the known ones."""
    known, start = drawn(case["seed"], case["sensor"])
    folder = out / f"{case['seed']}_{case['sensor']}"
    folder.mkdir(parents=True, exist_ok=True)
    rest, balls = photographs(known, np.random.default_rng([case["seed"], case["sensor"], 1]), folder)
    (folder / "start.toml").write_text(tomli_w.dumps(start))
    (folder / "known.toml").write_text(tomli_w.dumps(known))
    began = time.process_time()
    files = ["--frames", *map(str, rest), "--ball", *map(str, balls), "--radius-mm", str(RADIUS_MM)]
    with contextlib.redirect_stdout(io.StringIO()):
        synth(["calibrate", "--scene", str(folder / "start.toml"), *files, "--out", str(folder / "fit")])
    record = json.loads((folder / "fit" / "calibration.json").read_text())
    row = differences(validated(known, "known lights", Scene).sensor, record["lights"])
    return {"lights": len(known["sensor"]["lights"]), **row, "good": record["verdict"]["good"],
            "processor_s": time.process_time() - began}  # fmt: skip


def differences(known: Sensor, found: list[dict[str, Any]]) -> Row:
    """Largest errors of the lights that were found, each beside the nearest known one of its channel."""
    errors: list[FloatArray] = []
    for channel in range(3):
        own = [light for light in known.lights if light.color[channel] > 0]
        fitted = [light for light in found if np.argmax(light["power_per_channel"]) == channel]
        if len(own) != len(fitted):
            errors.append(np.full((1, 3), np.inf))
            continue
        places = [np.array([light.position_mm for light in own]), np.array([light["position_mm"] for light in fitted])]
        first, second = linear_sum_assignment(np.linalg.norm(places[0][:, None] - places[1], axis=2))
        seen = [_direction(place[order]) for place, order in zip(places, (first, second), strict=True)]
        turned = (seen[1] - seen[0] + 180) % 360 - 180
        powers = [max(fitted[b]["power_per_channel"]) / own[a].power - 1 for a, b in zip(first, second, strict=True)]
        errors.append(np.abs(np.column_stack([turned, powers])))
    azimuth, elevation, power = np.vstack(errors).max(axis=0)
    within = azimuth <= AZIMUTH_DEG and elevation <= ELEVATION_DEG and power <= POWER
    return {
        "azimuth_deg": float(azimuth),
        "elevation_deg": float(elevation),
        "power": float(power),
        "found": bool(within),
    }


def _direction(place: FloatArray) -> FloatArray:
    """Azimuth and elevation (n, 2) in degrees of places (n, 3) from the gel's middle."""
    x, y, z = place.T
    return np.degrees(np.column_stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))]))
