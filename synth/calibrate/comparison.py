"""The fitted sensor rendered, beside the frame that it is to match."""

import io
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure

from synth.arrays import BoolArray, FloatArray, Points
from synth.calibrate.dots import find_dots
from synth.calibrate.frames import PLACE
from synth.errors import InputError
from synth.mesh import rest_surface
from synth.render.camera_image import encoded, expected_signal
from synth.render.measured_light import LightModel
from synth.render.pattern import albedo, pixels_per_mm
from synth.render.renderer import Renderer
from synth.render.variant import Variant
from synth.scene import Dots, Render, Sensor
from synth.surface import GelSurface

AMPLIFIED = 8
"""Factor of the differences in the picture."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """A frame and the sensor's picture of it without noise and quantisation, both (H, W, 3) in [0, 1], encoded.

    `outside` (H, W) are the pixels without dots in either picture. `rest`, of a bare gel's other frames, is the fitted
    frame, smoothed, whose own difference is the floor of every fit.
    """

    frame: FloatArray
    rendered: FloatArray
    outside: BoolArray
    rest: FloatArray | None = None

    def numbers(self) -> dict[str, Any]:
        """Mean absolute and signed differences per channel, levels of 255."""
        bare = 255 * (self.rendered - self.frame)[self.outside]
        found = {"mean_absolute_outside_dots": np.abs(bare).mean(axis=0), "bias_outside_dots": bare.mean(axis=0)}
        if self.rest is not None:
            found["floor"] = 255 * np.abs(self.rest - self.frame)[self.outside].mean(axis=0)
        rounded = {name: [round(float(x), 3) for x in values] for name, values in found.items()}
        return rounded | {"pixels_outside_dots": int(self.outside.sum())}

    def worst_place(self) -> tuple[float, tuple[int, int]]:
        """How far a place outside dots is off, in levels of 255, and its pixel (x, y).

        A place is a Gaussian neighbourhood of 2 % of the image's width; the worst one hundredth is left out.
        """
        sigma = PLACE * self.frame.shape[1]
        difference = 255 * (self.rendered - self.frame) * self.outside[:, :, None]
        weight = np.maximum(cv2.GaussianBlur(self.outside.astype(np.float64), (0, 0), sigma), 1e-6)
        local = np.abs(cv2.GaussianBlur(difference, (0, 0), sigma)).max(axis=2) / weight * self.outside
        row, column = np.unravel_index(int(np.argmax(local)), local.shape)
        return float(np.percentile(local[self.outside], 99)), (int(column), int(row))


def render_gel(
    sensor: Sensor,
    render: Render,
    variant: Variant,
    measured: LightModel | None = None,
    pressed: tuple[GelSurface, Points] | None = None,
) -> FloatArray:
    """The gel's picture (H, W, 3) at rest or pressed, encoded, in [0, 1], without noise and quantisation.

    A pressed face is a surface and its vertices (v, 3) mm.

    Dots are drawn on their grid without jitter, which no frame tells for another gel.
    """
    plain = sensor
    if isinstance(sensor.pattern, Dots):
        even = sensor.pattern.model_copy(update={"jitter_mm": 0.0, "radius_jitter": 0.0})
        plain = sensor.model_copy(update={"pattern": even})
    surface, positions = pressed or (rest := rest_surface(sensor.gel), rest.material)
    renderer = Renderer(sensor, render, surface, albedo(plain, np.random.default_rng(0)), variant, measured)
    return encoded(expected_signal(renderer.radiance(positions, 0), sensor.camera), sensor.camera)


def compare(frame: FloatArray, rendered: FloatArray, bare: BoolArray, sensor: Sensor) -> Comparison:
    """Frame against picture; `bare` are the frame's own pixels without dots.

    Dots of the picture are left out by their own darkness: they may lie beside the frame's where a gel was moved.
    """
    outside = bare.copy()
    if isinstance(sensor.pattern, Dots):
        pitch = sensor.pattern.spacing_mm[0] * pixels_per_mm(sensor)
        try:
            outside &= ~find_dots(rendered**sensor.camera.gamma, pitch).covered
        except InputError as error:
            raise InputError(f"in the picture of the fitted sensor: {error}") from error
        outside = cv2.erode(outside.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) > 0
    if not outside.any():
        raise InputError("no pixel of the frame is free of dots: give larger frames")
    return Comparison(frame, rendered, outside)


def picture(rows: dict[str, Comparison], title: str) -> bytes:
    """A PNG: a row per comparison with the frame, the fitted sensor, and their difference, amplified around grey."""
    figure = Figure(figsize=(12.6, 3.4 * len(rows) + 0.6), dpi=100)
    axes = figure.subplots(len(rows), 3, squeeze=False)
    for line, (name, row) in zip(axes, rows.items(), strict=True):
        difference = 0.5 + AMPLIFIED * (row.rendered - row.frame)
        errors = " ".join(f"{value:.1f}" for value in row.numbers()["mean_absolute_outside_dots"])
        titles = (name, "fitted sensor, rendered", f"difference x {AMPLIFIED}; compared, {errors} of 255")
        for axis, image, caption in zip(line, (row.frame, row.rendered, difference), titles, strict=True):
            axis.imshow(np.clip(image, 0, 1), interpolation="nearest")
            axis.set_title(caption, fontsize=9)
            axis.set_axis_off()
    figure.suptitle(title, fontsize=10, y=1 - 0.1 / figure.get_figheight())
    figure.tight_layout()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
