"""Path-traced radiance of the gel's coating, as the camera receives it before its sensor adds anything.

One Mitsuba scene per sensor instance: the coated surface, the LEDs, and nothing outside (black). The indenter is hidden
by the opaque coating and never part of it. For a frame only vertex positions and normals are exchanged; several cameras
are several sets of rays in that one scene.

Light that the window's outer face reflects back onto the gel comes from mirror images (`synth.render.lights`);
scalar variants, whose camera stands outside, leave it out. All leave out light that the pad's sides reflect.

Pixels are box-filtered. In vectorised variants the samples of one pixel are neighbours in the wavefront and are summed
in a fixed order, not by atomic adds: the same seed gives the same bits with any number of threads.
"""

import math
from typing import Any

import numpy as np

from synth.arrays import Image, Points
from synth.render.albedo_map import AlbedoMap
from synth.render.camera_image import PILOT, needed_samples
from synth.render.camera_rays import CameraRays, pinhole
from synth.render.chart import Chart, chart_of
from synth.render.coating import is_separated, reflection
from synth.render.gel_hits import GelHits
from synth.render.gel_mesh import GelMesh
from synth.render.lights import all_lights, emitters, panel_corners, panels, reflecting_plane
from synth.render.measured_light import LightModel
from synth.render.path_tracer import PathTracer
from synth.render.pattern import is_grey
from synth.render.recordings import Recordings
from synth.render.separated_light import SeparatedLight
from synth.render.smooth_light import FrameGeometry
from synth.render.thin_lens import check_views
from synth.render.variant import Variant
from synth.scene import Render, Sensor
from synth.surface import GelSurface

_PIXELS = 320 * 240
"""Pixels of a picture up to which bounced light is sampled as often as pixels are: more see the same faces."""
_MAX_WAVEFRONT, _MAX_WAVEFRONT_GPU = 2**22, 2**24
"""Samples traced at once. Constants, because the split into passes decides the random numbers."""

_PILOT_SEEDS = (1, 2)

_LIGHT_PART = 2**31
"""Stands for the number of a pass in the seed of what all pixels share."""


class Renderer:
    """The renderer of one sensor instance, or of one after another.

    `samples_per_pixel` is rounded up to the next full grid (see `full_grid`). The albedo, (rows, columns, 3 or 4)
    float32 over the contact face from `pattern.albedo`, must not be changed afterwards; `measured` is from
    `read_measured_light`. InputError for a light in the camera's view, a lens that cannot focus, and a lens or light
    that this variant or coating cannot have; ValueError for a mono variant with a sensor that is not grey.
    """

    def __init__(
        self,
        sensor: Sensor,
        render: Render,
        surface: GelSurface,
        albedo: Image,
        variant: Variant,
        measured: LightModel | None = None,
    ) -> None:
        if variant.is_mono and not is_grey(sensor):
            raise ValueError(f"{variant.name} renders grey sensors only: choose the variant with grey=is_grey(sensor)")
        self._variant, self._recordings = variant, Recordings()
        self._separated = is_separated(render, sensor, variant)
        mi = variant.load()
        check_views(sensor)
        self._built = self._parts(sensor)
        refracts = sensor.window.refractive_index != 1
        self._behind = reflecting_plane(sensor) if variant.is_vectorised else None
        self._set_meshes(surface, chart_of(sensor))
        bsdf = (
            mi.load_dict({"type": "null"})
            if self._separated
            else reflection(mi, sensor.coating, albedo, variant.is_mono)
        )
        shapes = {name: _gel(name, mesh, bsdf, not variant.is_vectorised, mi) for name, mesh in self._meshes.items()}
        if variant.is_vectorised:
            contents = self._shapes = shapes | {"lights": panels(all_lights(sensor), mi)}
        else:
            contents = shapes | emitters(sensor.lights, mi) | ({"window": _window(sensor, mi)} if refracts else {})
        self._scene = mi.load_dict({"type": "scene", **contents}, optimize=False)
        self._parameters = mi.traverse(self._scene)
        if variant.is_vectorised:
            self._hits = GelHits(shapes, self._meshes["gel"], mi)
        else:  # a path through Mitsuba's window is one interaction longer than one that starts inside
            depth = render.max_depth + refracts
            self._integrator = mi.load_dict({"type": "path", "max_depth": depth, "hide_emitters": True})
        self._use(sensor, render, albedo, measured)

    def reuse(
        self, sensor: Sensor, render: Render, surface: GelSurface, albedo: Image, measured: LightModel | None = None
    ) -> bool:
        """Render this sensor from now on, if light is separated and it differs in numbers alone; else say False.

        What Dr.Jit has recorded of frames serves it, too.
        """
        if not (self._separated and is_separated(render, sensor, self._variant)) or self._parts(sensor) != self._built:
            return False
        check_views(sensor)
        self._behind = reflecting_plane(sensor)
        self.take(surface)
        self._parameters["lights.vertex_positions"] = panel_corners(all_lights(sensor))
        self._use(sensor, render, albedo, measured)
        return True

    def _parts(self, sensor: Sensor) -> tuple[Any, ...]:
        """What of a sensor is built into Mitsuba's scene, and is no number in it."""
        return len(all_lights(sensor)), reflecting_plane(sensor) is None, chart_of(sensor)

    def _use(self, sensor: Sensor, render: Render, albedo: Image, measured: LightModel | None) -> None:
        mi = self._variant.load()
        self._sensor, self._render, self._views = sensor, render, sensor.views
        lit = len(all_lights(sensor)) if self._variant.is_vectorised else sum(x.power > 0 for x in sensor.lights)
        self._lit = 1 if self._separated else lit  # separated: all at every sample
        self._light: Any = None
        if self._separated:
            colors = albedo.mean(axis=2, keepdims=True) if self._variant.is_mono else albedo
            painted = AlbedoMap(colors, mi)
            self._light = SeparatedLight(sensor, self._scene, self._hits, painted, measured, render.max_depth, mi)
        elif self._variant.is_vectorised:
            self._light = PathTracer(sensor, self._scene, self._hits, self._shapes, render.max_depth, mi)
        if self._variant.is_vectorised:
            self._rays = {name: CameraRays(view, mi) for name, view in self._views.items()}
        wanted = render.samples_per_pixel
        self._set_samples(mi, PILOT if wanted == "auto" else wanted)
        if wanted == "auto":  # fixed seeds, so that a sensor always gets the same number
            at_rest = self._meshes["gel"].surface.material
            first, second = (self.radiance(at_rest, seed) for seed in _PILOT_SEEDS)
            self._set_samples(mi, needed_samples(first, second, self._views[""].camera, self.samples_per_pixel))

    def _set_samples(self, mi: Any, wanted: int) -> None:
        self.samples_per_pixel = full_grid(wanted, self._lit)
        if not self._variant.is_vectorised:
            self._sampler = mi.load_dict({"type": "multijitter", "sample_count": self.samples_per_pixel})
            self._sensors = {name: self._build_pinhole(mi, view) for name, view in self._views.items()}

    def take(self, surface: GelSurface) -> None:
        """Render this surface from now on: `radiance` gets the positions of its vertices."""
        mesh = self._meshes["gel"]
        if surface is mesh.surface:
            return
        self._set_meshes(surface, mesh.chart)
        for name, mesh in self._meshes.items():
            self._replace(f"{name}.faces", mesh.faces())
            self._replace(f"{name}.vertex_texcoords", mesh.texture_coordinates())
            self._replace(f"{name}.vertex_positions", mesh.positions(surface.material))
            if not self._variant.is_vectorised:
                self._replace(f"{name}.vertex_normals", mesh.normals(surface.material))
        self._parameters.update()
        if self._variant.is_vectorised:
            self._hits.take(self._meshes["gel"])

    def _set_meshes(self, surface: GelSurface, chart: Chart) -> None:
        self._meshes = {"gel": GelMesh(surface, chart)}
        if self._behind is not None:
            self._meshes["image"] = GelMesh(surface, chart, self._behind)

    def _replace(self, key: str, values: Any) -> None:
        """Set an array of another length. Scalar variants compare old and new by elements, and stop at that."""
        if self._variant.is_vectorised:
            self._parameters[key] = values
            return
        owner, kind, *_ = self._parameters.properties[key]
        self._parameters.set_property(owner, kind, type(self._parameters[key])(values))
        self._parameters.set_dirty(key)

    def radiance(self, positions: Points, seed: int) -> Image:
        """Linear radiance (H, W, 3) float32 of the deformed gel in the main camera; zero where a pixel sees past it.

        Positions are (v, 3) float64 mm, those of the surface's vertices; frames with different non-negative seeds have
        independent noise. Mono variants give three equal channels.
        """
        self._deform(positions, seed)
        return self._frame("", seed)

    def radiances(self, positions: Points, seed: int) -> dict[str, Image]:
        """`radiance` in every camera, by name ("" is the main camera); independent noise in each."""
        self._deform(positions, seed)
        return {name: self._frame(name, seed) for name in self._views}

    def _frame(self, name: str, seed: int) -> Image:
        mi = self._variant.load()
        number = list(self._views).index(name)
        if self._variant.is_vectorised:
            return self._trace(mi, name, seed, number)
        own = _mitsuba_seed(seed, 0, number)
        image = mi.render(self._scene, sensor=self._sensors[name], integrator=self._integrator, seed=own)
        return np.array(image, dtype=np.float32)

    def _deform(self, positions: Points, seed: int) -> None:
        """Move the vertices, and find what light is the same for all cameras."""
        for name, mesh in self._meshes.items():
            self._parameters[f"{name}.vertex_positions"] = mesh.positions(positions)
        self._parameters.update()
        if not self._variant.is_vectorised:  # normals come second: positions make Mitsuba compute its own
            for name, mesh in self._meshes.items():
                self._parameters[f"{name}.vertex_normals"] = mesh.normals(positions)
            self._parameters.update()
            return
        self._hits.place(self._parameters["gel.vertex_positions"])
        self._prepared = None
        if self._separated:
            mi, camera = self._variant.load(), self._views[""].camera
            is_deep = self._render.max_depth > 2 and self._sensor.measured_light is None
            frame = FrameGeometry(self._sensor, self._meshes["gel"], positions, is_deep)
            numbers = frame.numbers(_mitsuba_seed(seed, _LIGHT_PART, 0), mi)
            primary = min(camera.width * camera.height, _PIXELS) * self.samples_per_pixel
            static = (self._light.static, frame.sizes, primary, frame.bounces)
            self._prepared = self._recordings.of(prepare, *static)(self._light, numbers)

    def _trace(self, mi: Any, name: str, seed: int, number: int) -> Image:
        """All pixels in passes of whole pixels, each pixel's samples one after another in the wavefront."""
        import drjit as dr

        camera, samples = self._views[name].camera, self.samples_per_pixel
        pixels = camera.width * camera.height
        step = max(1, (_MAX_WAVEFRONT_GPU if self._variant.is_on_gpu else _MAX_WAVEFRONT) // samples)
        parts: list[Any] = []
        for k, first in enumerate(range(0, pixels, step)):
            starts = dr.opaque(mi.UInt32, first), dr.opaque(mi.UInt32, _mitsuba_seed(seed, k, number))
            values = (self._light, self._prepared, self._rays[name], *starts)
            static: tuple[Any, ...] = (None, min(step, pixels - first), samples, self._variant.is_mono)
            if self._separated:  # Mitsuba's textures, which a path tracer looks up, cannot be replayed on a GPU
                static = ((self._light.static, self._rays[name].static), *static[1:])
                parts.append(self._recordings.of(traced, *static)(*values))
            else:
                parts.append(traced(*values, *static))
            # Read when the next one is queued: the device works while that is recorded, and holds two.
            parts[-2:-1] = map(_read, parts[-2:-1])
        sums = np.concatenate([*parts[:-1], _read(parts[-1])])
        image: Image = np.empty((camera.height, camera.width, 3), dtype=np.float32)
        image.reshape(pixels, 3)[:] = sums / samples  # a single channel fills all three
        return image

    def _build_pinhole(self, mi: Any, sensor: Sensor) -> Any:
        camera = sensor.camera
        description = pinhole(sensor)
        description["to_world"] = mi.ScalarTransform4f(description["to_world"])
        description["film"] = {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        }
        description["sampler"] = self._sampler
        return mi.load_dict(description)


def prepare(light: SeparatedLight, frame: Any, _: Any, *arguments: Any) -> Any:
    """See `SeparatedLight.prepare`."""
    return light.prepare(frame, *arguments)


def traced(
    light: Any, prepared: Any, rays: CameraRays, first: Any, seed: Any, _: Any, count: int, samples: int, is_mono: bool
) -> list[Any]:
    """Summed samples of `count` pixels from `first` (mi.UInt32) on: (count,) mi.Float of each channel, queued."""
    import drjit as dr
    import mitsuba as mi

    sampler = mi.load_dict({"type": "multijitter", "sample_count": samples})
    sampler.set_samples_per_wavefront(samples)
    sampler.seed(seed, count * samples)
    pixel = dr.arange(mi.UInt32, count * samples) // dr.opaque(mi.UInt32, samples) + first
    offset = sampler.next_2d()
    pupil = sampler.next_2d() if rays.has_aperture else None
    ray, weight, valid = rays.sample(pixel, offset, pupil)
    color, seen = light.radiance(ray, sampler, valid, prepared, samples)
    channels = [dr.select(valid & seen, color[i] * weight, 0) for i in range(1 if is_mono else 3)]
    dr.eval(channels)  # all at once: each sum alone would trace everything anew
    return [dr.block_sum(channel, samples) for channel in channels]


def _read(channels: list[Any]) -> Image:
    """(count, channels) float32 numbers of the device, which are waited for."""
    return np.stack([np.array(channel) for channel in channels], axis=-1)


def _gel(name: str, mesh: GelMesh, bsdf: Any, smooth: bool, mi: Any) -> Any:
    """The mesh with its coating, seen from either side; `smooth`: shaded by Mitsuba with normals of its vertices."""
    properties = mi.Properties()
    properties["bsdf"] = bsdf
    surface = mesh.surface
    counts = len(surface.material), len(surface.triangles)
    shape = mi.Mesh(name, *counts, props=properties, has_vertex_normals=smooth, has_vertex_texcoords=True)
    parameters = mi.traverse(shape)
    parameters["faces"] = mesh.faces()
    parameters["vertex_texcoords"] = mesh.texture_coordinates()
    parameters["vertex_positions"] = mesh.positions(surface.material)
    parameters.update()
    return shape


def full_grid(samples: int, lights: int) -> int:
    """Samples per pixel rounded up to a full grid of nearly equal sides, and to a multiple of the number of lights.

    Multi-jittered sampling needs the grid. The multiple gives every light the same share of a pixel's samples, which
    about halves the noise.
    """
    while True:
        side = math.isqrt(samples)
        if samples % side == 0 and samples % max(lights, 1) == 0:
            return samples
        samples += 1


def _window(sensor: Sensor, mi: Any) -> dict[str, Any]:
    """The window's outer face for scalar variants: refracts, and absorbs what it reflects (see the module)."""
    thickness = sensor.gel.size_mm[2]
    reach = 10 * (sensor.camera.position_mm[2] + max(sensor.gel.size_mm))
    transform = mi.ScalarTransform4f
    return {
        "type": "rectangle",
        "to_world": transform().translate([0, 0, thickness + sensor.window.thickness_mm])
        @ transform().scale([reach, reach, 1]),
        "bsdf": {
            "type": "dielectric",
            "int_ior": sensor.window.refractive_index,
            "ext_ior": 1.0,
            "specular_reflectance": {"type": "rgb", "value": 0.0},
        },
    }


def _mitsuba_seed(seed: int, part: int, camera: int) -> int:
    """The 32-bit seed that Mitsuba takes, from a seed of any size and the numbers of a pass and of a camera."""
    numbers = [seed, part, camera] if camera else [seed, part]
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])
