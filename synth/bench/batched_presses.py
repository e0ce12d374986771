"""The presses that `synth.bench.batched` is about, and the meshes that it takes them on."""

from collections.abc import Sequence

import numpy as np

from synth.mesh import Counts, Focus, PadMesh, graded_box
from synth.scene import Scene

SIZE_MM = (20.0, 15.0, 4.0)
RADII_MM = (2.0, 6.0)
"""Between which the balls' radii are drawn."""
PLACES_MM = (6.0, 4.0)
"""Half width of the rectangle that the balls' centres are drawn from."""


def ball_scene(
    rng: np.random.Generator, depth_mm: float, drag_mm: float, steps: int, radii_mm: Sequence[float] = RADII_MM
) -> Scene:
    """A ball at a random place, with friction, that is dragged by drag_mm in a random direction once it is down."""
    angle = rng.uniform(0, 2 * np.pi)
    light = {"position_mm": [0, 0, 0.1], "size_mm": [1, 1], "color": [1, 1, 1], "power": 1}
    camera = {"width": 16, "height": 16, "fx": 9, "fy": 9, "cx": 8, "cy": 8, "position_mm": [0, 0, 90]}
    return Scene.model_validate(
        {
            "name": "bench",
            "sensor": {
                "gel": {"size_mm": SIZE_MM, "youngs_modulus_kpa": 200.0, "poisson_ratio": 0.4999},
                "pattern": {"kind": "none"},
                "lights": [light],
                "camera": camera,
            },
            "contact": {
                "indenter": {"shape": "sphere", "radius_mm": float(rng.uniform(radii_mm[0], radii_mm[1]))},
                "friction": float(rng.uniform(0.3, 1.0)),
            },
            "motion": {
                "depth_mm": depth_mm,
                "shear_mm": [float(drag_mm * np.cos(angle)), float(drag_mm * np.sin(angle))],
                "position_mm": [float(rng.uniform(-half, half)) for half in PLACES_MM],
                "steps": steps,
            },
        }
    )


def shared_mesh(
    across: Sequence[int],
    through: int,
    growth: float,
    zone_mm: Sequence[float] | None = None,
    outside: Sequence[int] = (1, 1),
) -> PadMesh:
    """A mesh for presses anywhere in PLACES_MM.

    Args:
        across: elements along x and y, in all or, with a zone, in it.
        through: the thickness.
        growth: per element through the thickness.
        zone_mm: half width of a rectangle beyond which elements grow; none: they are even.
        outside: elements on either side of it, along x and y.
    """
    if zone_mm is None:
        counts = Counts((across[0] - 2, across[1] - 2), (1, 1), through, growth=growth)
        return graded_box(SIZE_MM, Focus((0.0, 0.0), (SIZE_MM[0] / 2, SIZE_MM[1] / 2)), counts)
    counts = Counts((across[0], across[1]), (outside[0], outside[1]), through, growth=growth)
    return graded_box(SIZE_MM, Focus((0.0, 0.0), (zone_mm[0], zone_mm[1])), counts)
