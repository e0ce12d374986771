"""Small sensors for the tests of rendering: a flat pad, one light, and every number known."""

from collections.abc import Callable

import numpy as np
import pytest
from kinematic_double import sheet
from scipy.optimize import brentq

from synth.arrays import Image, Points
from synth.render.renderer import Renderer
from synth.render.variant import Variant, choose_variant
from synth.scene import BoxGel, Camera, Coating, Light, NoPattern, Pattern, PlaneWindow, Render, Sensor
from synth.surface import GelSurface

FAST = choose_variant("cpu")
SCALAR = Variant("scalar_rgb", "test")
VARIANTS = [FAST, SCALAR] if FAST.is_vectorised else [SCALAR]
needs_llvm = pytest.mark.skipif(not FAST.is_vectorised, reason="no LLVM of version 16 or newer here")
DIRECT = Render(samples_per_pixel=36, max_depth=2)


def small_sensor(
    index: float = 1.0, pattern: Pattern | None = None, lights: tuple[Light, ...] | None = None, **camera: object
) -> Sensor:
    """A pad of 12 x 9 x 3 mm seen at about 8 px per mm from the height of 20 mm, slightly off its middle."""
    numbers: dict = {"width": 80, "height": 60, "fx": 140.0, "fy": 140.0, "cx": 42.5, "cy": 28.5}
    numbers |= {"position_mm": (0.2, -0.1, 20.0), "look_at_mm": (0.2, -0.1, 0.0)}
    light = Light(position_mm=(7.0, 2.0, 4.0), aim_mm=(0.0, 0.0, 0.0), size_mm=(0.05, 0.05), color=(1, 1, 1), power=100)
    return Sensor(
        gel=BoxGel(size_mm=(12.0, 9.0, 3.0), youngs_modulus_kpa=200),
        window=PlaneWindow(refractive_index=index, thickness_mm=3.0),
        coating=Coating(reflectance=(0.6, 0.6, 0.6)),
        pattern=pattern or NoPattern(kind="none"),
        lights=lights or (light,),
        camera=Camera(**(numbers | camera)),
    )


def flat_surface(sensor: Sensor, cells: int = 12) -> GelSurface:
    return sheet(cells, cells, *sensor.gel.size_mm[:2], 2)


def plain(value: float = 0.6) -> Image:
    return np.full((4, 4, 3), value, dtype=np.float32)


def rendered(
    sensor: Sensor,
    texture: Image | None = None,
    render: Render = DIRECT,
    variant: Variant = FAST,
    seed: int = 0,
    positions: Points | None = None,
    cells: int = 12,
) -> Image:
    """The radiance of the sensor's gel, flat unless positions of its surface's vertices are given."""
    surface = flat_surface(sensor, cells)
    renderer = Renderer(sensor, render, surface, plain() if texture is None else texture, variant)
    return renderer.radiance(surface.material if positions is None else positions, seed)


def internal_reflectance(cosine: float, index: float) -> float:
    """Of a body of refractive index n for unpolarised light from inside (Fresnel), 1 beyond the critical angle."""
    square = 1 - index**2 * (1 - cosine**2)
    if square <= 0:
        return 1.0
    outside = np.sqrt(square)
    across = (index * cosine - outside) / (index * cosine + outside)
    along = (cosine - index * outside) / (cosine + index * outside)
    return float(across**2 + along**2) / 2


def kernels_compiled(frame: Callable[[], object]) -> int:
    """How many kernels Dr.Jit compiles for what is rendered in `frame`; needs `JitFlag.KernelHistory`."""
    import drjit as dr

    dr.kernel_history_clear()
    frame()
    kernels = [kernel for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT]
    assert kernels
    return sum(not kernel["cache_hit"] for kernel in kernels)


def refracted_angle(above: float, below: float, distance: float, index: float) -> float:
    """The angle a from the normal in air of a ray that Snell's law bends: the root of R = h tan(a) + d tan(g)."""

    def beyond(angle: float) -> float:
        return above * np.tan(angle) + below * np.tan(np.arcsin(np.sin(angle) / index)) - distance

    return brentq(beyond, 0.0, np.pi / 2 - 1e-9, xtol=1e-15, rtol=1e-15)


def refracted_pixel(sensor: Sensor, x: float, y: float) -> tuple[float, float]:
    """Pixel of the point (x, y, 0) for a camera that looks straight down, by Snell's law and OpenCV's distortion."""
    camera, index = sensor.camera, sensor.window.refractive_index
    depth = sensor.gel.size_mm[2] + sensor.window.thickness_mm
    above = camera.position_mm[2] - depth
    dx, dy = x - camera.position_mm[0], y - camera.position_mm[1]
    distance = np.hypot(dx, dy)
    scale = np.tan(refracted_angle(above, depth, distance, index)) / distance if distance > 0 else 0.0
    u, v = dx * scale, dy * scale
    k1, k2, p1, p2, k3 = camera.distortion
    s = u * u + v * v
    radial = 1 + k1 * s + k2 * s**2 + k3 * s**3
    ud = u * radial + 2 * p1 * u * v + p2 * (s + 2 * u * u)
    vd = v * radial + p1 * (s + 2 * v * v) + 2 * p2 * u * v
    return camera.fx * ud + camera.cx, camera.fy * vd + camera.cy
