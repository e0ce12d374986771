"""What calibration starts from: a named scene with every distribution at its middle, seen at the frames' size."""

import copy
from typing import Any

import numpy as np

from synth.errors import InputError
from synth.scene import Dots, NoPattern, Render, Sensor
from synth.scene.template import Template, replaced
from synth.scene.validation import validated


def middle(kind: str, arguments: list[Any]) -> Any:
    """The middle of a distribution; of a choice, its first option."""
    match kind:
        case "uniform":
            return (arguments[0] + arguments[1]) / 2
        case "log_uniform":
            return float(np.sqrt(arguments[0] * arguments[1]))
        case _:
            return arguments[0]


def start_sensor(template: Template, size: tuple[int, int]) -> Sensor:
    """The preset's sensor at the middle of its distributions, with a camera that makes frames of the given size.

    Focal lengths and principal point scale with the width; the principal point keeps its place relative to the middle.
    A pattern, mirror, aperture or further camera that calibration does not know is an InputError.
    """
    content = copy.deepcopy(replaced(template.content["sensor"], middle))
    sensor = validated(content, template.label, Sensor, "sensor")
    if not isinstance(sensor.pattern, Dots | NoPattern):
        raise InputError(
            f"{template.label}: sensor.pattern.kind = {sensor.pattern.kind!r}: calibration needs a pattern that "
            "leaves smooth coating to see the lights by; allowed are 'dots' and 'none'"
        )
    if sensor.mirrors or sensor.further_cameras:
        raise InputError(f"{template.label}: calibration knows one camera without mirrors; take them out of the preset")
    if sensor.camera.aperture_mm:
        raise InputError(
            f"{template.label}: sensor.camera.aperture_mm = {sensor.camera.aperture_mm}: calibration fits one blur "
            "for the whole image; take the aperture out of the preset"
        )
    camera, (width, height) = sensor.camera, size
    scale = width / camera.width
    view = {
        "width": width,
        "height": height,
        "fx": camera.fx * scale,
        "fy": camera.fy * scale,
        "cx": width / 2 + (camera.cx - camera.width / 2) * scale,
        "cy": height / 2 + (camera.cy - camera.height / 2) * scale,
        "blur_px": camera.blur_px * scale,
    }
    return sensor.model_copy(update={"camera": camera.model_copy(update=view)})


def render_settings(template: Template) -> Render:
    """The preset's render settings at the middle of their distributions."""
    return validated(replaced(template.content.get("render", {}), middle), template.label, Render, "render")
