"""One picture of a sensor at rest, without simulation, and whether its light suits the camera."""

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from synth.arrays import Image
from synth.dataset.images import Raster, encode_png
from synth.dataset.storage import refuse_foreign, replace_file
from synth.errors import InputError
from synth.mesh import rest_surface
from synth.render.camera_image import camera_image
from synth.render.exposure import AIM, DARK, fault, levels_of, light_factor
from synth.render.pattern import albedo, pixels_per_mm
from synth.render.renderer import Renderer
from synth.render.variant import Variant
from synth.scene import Camera, Render, Sensor
from synth.scene.sampling import draw_sensor, stream
from synth.scene.template import Template

MARK = b"tEXtSoftware\0synth preview"
"""Chunk at the beginning of the PNG by which a later run knows its own picture."""
MOST_SAMPLES, MOST_RAYS = 16, 5_000_000
"""Most samples a pixel, and of all pixels."""


def preview(template: Template, out: Path, seed: int, variant: Variant) -> dict[str, Any]:
    """Write a picture of a job's first sensor, all cameras side by side; its numbers and advice, by camera.

    Flat gels look as in the first pair of `generate`, to the bit where that takes no more samples. InputError for what
    cannot be rendered, and for a file of somebody else.
    """
    refuse_foreign(out, MARK)
    instance = draw_sensor(template, seed, 0)
    if instance.content is None:
        raise InputError(f"{template.label}: {instance.rejected[-1]}")
    sensor, render = Sensor(**instance.content["sensor"]), Render(**instance.content.get("render", {}))
    pixels = sum(camera.width * camera.height for camera in sensor.cameras.values())
    most = max(1, min(MOST_SAMPLES, MOST_RAYS // pixels))
    wanted = most if render.samples_per_pixel == "auto" else min(most, render.samples_per_pixel)
    try:
        surface, scale = rest_surface(sensor.gel, template.folder), pixels_per_mm(sensor)
        painted = albedo(sensor, stream(template, seed, "pattern", 0), template.folder)
        renderer = Renderer(sensor, render.model_copy(update={"samples_per_pixel": wanted}), surface, painted, variant)
    except InputError as error:
        raise InputError(f"{template.label}: {error}") from error
    radiances = renderer.radiances(surface.material, int(stream(template, seed, "render rest", 0).integers(2**31)))
    images, cameras = [], {}
    for number, ((name, radiance), camera) in enumerate(zip(radiances.items(), sensor.cameras.values(), strict=True)):
        own = (number,) if number else ()  # as in `synth.pipeline.finishing`
        channels = radiance[:, :, :1] if variant.is_mono else radiance
        images.append(camera_image(channels, camera, stream(template, seed, "noise", 0, 0, *own)))
        cameras[name or "main"] = _judged(images[-1].squeeze(), radiance, camera)
    replace_file(out, _png(images))
    return {"picture": str(out), "pixels_per_mm": scale, "cameras": cameras}


def table_of(found: dict[str, Any]) -> Table:
    """The levels that `preview` found, for people."""
    table = Table("camera", "channel", "mean", "at white", f"below {100 * DARK:.0f} %")
    for name, camera in found["cameras"].items():
        for one in camera["levels"]:
            table.add_row(name, one["channel"], *(f"{100 * one[key]:.1f} %" for key in ("mean", "clipped", "dark")))
    return table


def _judged(image: Raster, radiance: Image, camera: Camera) -> dict[str, Any]:
    """Levels of a camera's picture, and a sentence on its light."""
    gel = radiance.any(axis=2)
    if not gel.any():
        advice = "no light: no pixel shows lit gel; check the camera's place, and the lights' places, aims and power"
        return {"levels": [], "advice": advice}
    levels = levels_of(image, gel)
    trouble, factor = fault(levels), light_factor(radiance, gel, camera)
    mend = (
        f"multiply the power of all sensor.lights by {factor:.3g}, or give --set sensor.camera.exposure="
        f"{factor * camera.exposure:.3g}; the brightest per cent is then at {100 * AIM:.0f} % of white"
    )
    if trouble.startswith("flat"):
        mend = "lights at the gel's sides, or a pattern, give contrast"
    advice = f"{trouble}; {mend}" if trouble else "light suits the camera"
    return {"levels": [vars(one) for one in levels], "factor": factor, "advice": advice}


def _png(images: list[Raster]) -> bytes:
    """Pictures (H, W, 1 or 3) side by side as one of 8 bits, with MARK behind its header of 33 bytes."""
    whole = np.zeros((max(map(len, images)), sum(image.shape[1] for image in images), images[0].shape[2]), np.uint8)
    left = 0
    for image in images:
        right = left + image.shape[1]
        whole[: len(image), left:right] = np.round(image * (255 / np.iinfo(image.dtype).max))
        left = right
    png, size, check = encode_png(whole.squeeze()), len(MARK) - 4, zlib.crc32(MARK)
    return png[:33] + struct.pack(">I", size) + MARK + struct.pack(">I", check) + png[33:]
