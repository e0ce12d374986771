"""One picture of a sensor at rest, without simulation, and whether its light suits the camera."""

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from synth.dataset.atomic_files import refuse_foreign, replace_file
from synth.dataset.exr import write_channels
from synth.dataset.images import Raster, encode_png
from synth.errors import InputError
from synth.mesh import rest_surface
from synth.optics import Optics
from synth.render.camera_image import camera_image
from synth.render.exposure import advice, levels_of
from synth.render.measured_light import read_measured_light
from synth.render.pattern import albedo, pixels_per_mm
from synth.render.renderer import Renderer
from synth.render.rest_map import read_rest_map
from synth.render.variant import Variant
from synth.sampling import draw_sensor, stream
from synth.scene import Render, Sensor
from synth.scene.template import Template

MARK = b"tEXtSoftware\0synth preview"
"""Chunk of the PNG by which a later run knows its own picture."""
MOST_SAMPLES, MOST_RAYS = 16, 5_000_000
"""Most samples of a pixel and of all pixels."""
PLACES = {"place.X": "mm", "place.Y": "mm", "place.Z": "mm"}
"""Channels of the places, and their unit."""


def preview(template: Template, out: Path, seed: int, variant: Variant, places: Path | None = None) -> dict[str, Any]:
    """Write a picture of a job's first sensor, all cameras side by side; its levels and advice by camera.

    `places` is an EXR file for where the main camera's pixels see the gel at rest, mm in the scene's frame. Boxes look
    as in the first pair of `generate`, to the bit where that takes no more samples. InputError for what cannot be
    rendered, and for a file of somebody else.
    """
    refuse_foreign(out, MARK)
    if places is not None:
        refuse_foreign(places, min(PLACES).encode())
    instance = draw_sensor(template, seed, 0)
    if instance.content is None:
        raise InputError(f"{template.label}: {instance.rejected[-1]}")
    sensor, render = Sensor(**instance.content["sensor"]), Render(**instance.content.get("render", {}))
    pixels, samples = sum(one.width * one.height for one in sensor.cameras.values()), render.samples_per_pixel
    samples = max(1, min(MOST_SAMPLES if samples == "auto" else samples, MOST_SAMPLES, MOST_RAYS // pixels))
    folder = template.folder
    try:
        surface, scale = rest_surface(sensor.gel, folder), pixels_per_mm(sensor)
        painted = albedo(sensor, stream(template, seed, "pattern", 0), folder)
        maps = {name: read_rest_map(view.camera, folder) for name, view in sensor.views.items()}
        render, measured = render.model_copy(update={"samples_per_pixel": samples}), read_measured_light(sensor, folder)
        renderer = Renderer(sensor, render, surface, painted, variant, measured)
    except InputError as error:
        raise InputError(f"{template.label}: {error}") from error
    radiances = renderer.radiances(surface.material, int(stream(template, seed, "render rest", 0).integers(2**31)))
    images, cameras = [], {}
    for number, (name, radiance) in enumerate(radiances.items()):
        further = [number] if number else []  # as `generate` numbers the noise of a sample's images
        camera, noise = sensor.views[name].camera, stream(template, seed, "noise", 0, 0, *further)
        gel = np.asarray(radiance.any(axis=2) | ~radiance.any())  # all pixels where none is lit
        images.append(camera_image(radiance[:, :, :1] if variant.is_mono else radiance, camera, noise, maps[name]))
        levels = levels_of(images[-1].squeeze(), gel)
        cameras[name or "main"] = {"levels": levels, "advice": advice(levels, radiance, gel, camera, maps[name])}
    replace_file(out, _png(images))
    if places is not None:
        from synth.flow.view import View  # traces rays with Warp

        state = View(surface, Optics.of(sensor)).state(surface.material)
        points = state.hits.interpolate(surface.triangles, surface.material).reshape(*images[0].shape[:2], 3)
        planes = {name: points[..., axis].astype(np.float32) for axis, name in enumerate(PLACES)}
        write_channels(places, planes, PLACES)
    return {"picture": str(out), "pixels_per_mm": scale, "cameras": cameras}


def _png(images: list[Raster]) -> bytes:
    """Images (H, W, 1 or 3) side by side, with 8 bits, and MARK behind PNG's header of 33 bytes."""
    tall = max(map(len, images))
    eight = (np.round(image * (255 / np.iinfo(image.dtype).max)).astype(np.uint8) for image in images)
    parts = [np.pad(image, ((0, tall - len(image)), (0, 0), (0, 0))) for image in eight]
    png, size, check = encode_png(np.hstack(parts).squeeze()), len(MARK) - len(b"tEXt"), zlib.crc32(MARK)
    return png[:33] + struct.pack(">I", size) + MARK + struct.pack(">I", check) + png[33:]
