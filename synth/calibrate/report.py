"""What calibration writes: the fitted scene's content and its numbers."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from synth.arrays import FloatArray
from synth.calibrate.ball_fit import Press
from synth.calibrate.comparison import Comparison
from synth.calibrate.frames import Frames
from synth.calibrate.sensor_fit import SensorFit
from synth.calibrate.verdict import Verdict
from synth.scene import Dots, Sensor
from synth.scene.template import Template, with_files

_CAMERA = ("fx", "fy", "cx", "cy", "look_at_mm", "distortion", "blur_px", "vignetting", "read_noise", "shot_noise")
"""Fields that are fitted."""


def fitted_content(template: Template, fit: SensorFit, folder: str) -> dict[str, Any]:
    """The preset's content with the fitted sensor in place of its own; everything else keeps its distributions.

    `folder` is the preset's, relative to where the fitted scene will lie: indenters' files are found through it.
    """
    sensor = fit.sensor.model_dump(mode="json", exclude_none=True)
    given = template.content["sensor"]
    # What no undeformed frame tells keeps the preset's distributions: the pad's mechanics.
    sensor["gel"] = given["gel"]
    content = with_files(template.content, lambda name: str(Path(folder) / name))
    del content["sensor"]
    content["name"] = f"{template.name}_calibrated"
    content["description"] = f"{template.content.get('description', template.name)} Calibrated."
    ordered: dict[str, Any] = {key: content.pop(key) for key in ("name", "description", "references") if key in content}
    return {**ordered, "sensor": {key: value for key, value in sensor.items() if value not in ((), [])}, **content}


def numbers(
    preset: str,
    frames: Sequence[Path],
    fit: SensorFit,
    start: Sensor,
    rows: dict[str, Comparison],
    contacts: Sequence[dict[str, Any]],
    verdict: Verdict,
    given: Frames,
    seconds: float,
) -> dict[str, Any]:
    """JSON-able: everything that was found, and how well it fits."""
    camera = fit.sensor.camera
    record: dict[str, Any] = {
        "preset": preset,
        "frames": [str(path) for path in frames],
        "size": list(given.size),
        "seconds": round(seconds, 1),
        "steps": fit.lights.steps,
        "residual_of_the_lights": round(255 * fit.lights.residual, 3),
        "verdict": asdict(verdict),
        "differences": {name: row.numbers() for name, row in rows.items()},
        "contacts": list(contacts),
        "lights": _lights(fit, start),
        "camera": {key: getattr(camera, key) for key in _CAMERA},
        "coating": {
            "reflectance": list(fit.sensor.coating.reflectance),
            "note": "held at the preset's: an undeformed frame tells its product with the lights' powers alone",
        },
    }
    pattern = fit.sensor.pattern
    if isinstance(pattern, Dots) and fit.grid is not None:
        miss = fit.grid.residual_px
        record["pattern"] = pattern.model_dump(mode="json")
        record["dots"] = {
            "found": 0 if fit.dots is None else len(fit.dots.centres),
            "in_grid": len(fit.grid.used),
            "off_grid_px_rms": round(float(np.sqrt(np.mean(miss**2))), 4),
            "off_grid_px_max": round(float(np.hypot(*miss.T).max()), 4),
        }
    return record


def _lights(fit: SensorFit, start: Sensor) -> list[dict[str, Any]]:
    """One entry for each light of the preset, the dark ones included."""
    found = []
    for i, light in enumerate(start.lights):
        moved = fit.lights.geometry.centre[i] - light.position_mm
        found.append(
            {
                "power_per_channel": [float(f"{value:.6g}") for value in fit.lights.powers[i]],
                "preset_power_per_channel": [round(light.power * value, 3) for value in light.color],
                "position_mm": np.round(fit.lights.geometry.centre[i], 4).tolist(),
                "moved_mm": round(float(np.linalg.norm(moved)), 3),
                "size_mm": np.round(fit.lights.geometry.size[i], 4).tolist(),
                "viewing_angle_deg": round(float(fit.lights.geometry.viewing_angle_deg[i, 0]), 2),
            }
        )
    return found


def contact_numbers(press: Press, changed: FloatArray, shown: Comparison) -> dict[str, Any]:
    """Of a ball's contact in a frame and in the fitted sensor, the latter by the change (n, 3) at the press's pixels.

    Azimuths are in degrees, 0 to the right and 90 downward; rises, and what is missed within the circle, in levels of
    255, by channel.
    """
    azimuth, rise = zip(press.azimuth_and_rise(press.changed), press.azimuth_and_rise(changed), strict=True)
    miss = 255 * (shown.rendered - shown.frame)[shown.outside]
    return {
        "frame": press.name,
        "middle_px": [round(value, 1) for value in press.contact.middle],
        "radius_px": round(press.contact.radius, 1),
        "place_mm": np.round(press.pose[:2], 3).tolist(),
        "depth_mm": round(float(np.exp(press.pose[2])), 3),
        "azimuth_deg": {"frame": np.round(azimuth[0], 1).tolist(), "fitted": np.round(azimuth[1], 1).tolist()},
        "rise": {"frame": np.round(rise[0], 1).tolist(), "fitted": np.round(rise[1], 1).tolist()},
        "rms_within": np.round(np.sqrt(np.mean(miss**2, axis=0)), 2).tolist(),
    }


def contact_line(numbers: dict[str, Any]) -> str:
    """A contact's numbers in words."""
    said = [f"{key} {' '.join(f'{x:.0f}' for x in numbers['azimuth_deg'][key])} degrees, rise "
            f"{' '.join(f'{x:.0f}' for x in numbers['rise'][key])}" for key in ("frame", "fitted")]  # fmt: skip
    return f"{Path(numbers['frame']).name} on the ball: light from (red green blue) {'; '.join(said)}"


def summary(record: dict[str, Any]) -> list[str]:
    lines = [f"{record['preset']}: fitted in {record['seconds']} s, {record['steps']} steps of the lights' geometry"]
    for name, difference in record["differences"].items():
        line = f"mean absolute difference outside dots {_levels(difference['mean_absolute_outside_dots'])} of 255"
        floor = f"; the fitted frame itself, smoothed: {_levels(difference['floor'])}" if "floor" in difference else ""
        lines.append(f"{name}: {line} (red green blue){floor}")
    for contact in record["contacts"]:
        lines.append(f"{contact_line(contact)}; off by {_levels(contact['rms_within'])} (rms)")
    if "dots" in record:
        dots = record["dots"]
        lines.append(
            f"dots: {dots['in_grid']} of {dots['found']} on the grid, {dots['off_grid_px_rms']:.2f} px off it (rms)"
        )
    return lines


def _levels(values: Sequence[float]) -> str:
    return " ".join(f"{value:.2f}" for value in values)
