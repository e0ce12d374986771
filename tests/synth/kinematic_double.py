"""A kinematic double: flat gels moved by a formula in place of the solver, under a camera that tests can alter."""

from collections.abc import Callable

import numpy as np

from synth.arrays import FloatArray, Points
from synth.flow.field import FlowField
from synth.optics import Optics
from synth.scene import BoxGel, Camera, Light, Mirror, NoPattern, PlaneWindow, Sensor
from synth.surface import ContactFaces, GelSurface

WIDTH, HEIGHT = 64, 48
LENS = (-0.25, 0.08, 1e-3, -2e-3, 0.01)
STRAIGHT = {"position_mm": (1.0, -0.5, 24.0), "look_at_mm": (1.0, -0.5, 0.0)}
OBLIQUE = {"position_mm": (3.0, -2.0, 22.0), "look_at_mm": (-0.5, 0.7, 0.0)}

FISHEYE = {"lens": "fisheye", "distortion": (0.05, -0.02, 0.004, -0.001), "fx": 52.0, "fy": 53.0}
SIDES = (
    {"position_mm": (6.0, -0.5, 16.0), "normal": (-1.0, 0.0, -0.25), "size_mm": (12.0, 8.0), "rotation_deg": 4.0},
    {"position_mm": (-5.0, -0.5, 16.0), "normal": (1.0, 0.1, -0.2), "size_mm": (13.0, 7.0)},
)
"""Two mirrors beside the view, one a little turned: with STRAIGHT, the gel is seen three times."""
PERISCOPE = ({"position_mm": (0.0, -2.0, 16.0), "normal": (0.05, -1.0, -1.1), "size_mm": (16.0, 9.0)},)
"""One mirror at about 45 degrees, for a camera that looks along +y: LEVEL."""
LEVEL = {"position_mm": (0.4, -16.0, 15.0), "look_at_mm": (0.0, -2.0, 15.5)}
PERISCOPE_VIEW = {"mirrors": PERISCOPE, **LEVEL}


def sensor(*, index: float = 1.0, mirrors: tuple[dict, ...] = (), **camera: object) -> Sensor:
    """A 20 x 15 x 4 mm pad with a 5 mm window (outer face at z = 9) and a camera of 64 x 48 px."""
    given = {"width": WIDTH, "height": HEIGHT, "fx": 70.0, "fy": 71.0, "cx": 31.7, "cy": 24.4, **STRAIGHT, **camera}
    return Sensor(
        gel=BoxGel(size_mm=(20, 15, 4), youngs_modulus_kpa=200),
        window=PlaneWindow(refractive_index=index, thickness_mm=5),
        pattern=NoPattern(kind="none"),
        lights=(Light(position_mm=(9, 0, 3), size_mm=(1, 1), color=(1, 1, 1), power=1),),
        camera=Camera(**given),
        mirrors=tuple(Mirror(**mirror) for mirror in mirrors),
    )


def optics(*, index: float = 1.0, mirrors: tuple[dict, ...] = (), **camera: object) -> Optics:
    return Optics.of(sensor(index=index, mirrors=mirrors, **camera))


def sheet(columns: int, rows: int, width: float, height: float, subdivisions: int = 1) -> GelSurface:
    """A flat rectangle around the origin at z = 0, normals toward -z as on a pad."""
    x, y = np.linspace(-width / 2, width / 2, columns + 1), np.linspace(-height / 2, height / 2, rows + 1)
    grid = np.stack(np.meshgrid(x, y, [0.0]), axis=-1).reshape(-1, 3)
    row, column = np.divmod(np.arange(columns * rows), columns)
    a = row * (columns + 1) + column
    b, c, d = a + 1, a + columns + 1, a + columns + 2
    faces = np.concatenate([np.column_stack([a, c, b]), np.column_stack([b, c, d])]).astype(np.int32)
    return GelSurface(ContactFaces(grid, faces), subdivisions)


def rotation(axis: str, degrees: float) -> FloatArray:
    """(3, 3), from the first toward the second of the other two axes, by components."""
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    angle, matrix = np.radians(degrees), np.eye(3)
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[j, i], matrix[i, j] = np.sin(angle), -np.sin(angle)
    return matrix


def rigid(matrix: FloatArray, shift: tuple[float, float, float]) -> Callable[[Points], Points]:
    return lambda points: points @ matrix.T + np.array(shift)


def folded(points: Points, crease: float = 2.0, shrink: float = 1 / 3) -> Points:
    """What lies right of x = crease folded over it, shrunk along x, up to 1 mm above the rest."""
    found, over = points.copy(), points[:, 0] > crease
    beyond = points[over, 0] - crease
    found[over, 0] = crease - beyond * shrink
    found[over, 2] = np.minimum(beyond * 4, 1.0)
    return found


def dented(points: Points, depth: float, shear: tuple[float, float] = (0.0, 0.0)) -> Points:
    """With a dent of some 3 mm radius beside the middle, carried along."""
    dent = np.exp(-((points[:, :2] - (0.4, -0.3)) ** 2).sum(1) / 9.0)
    return points + np.outer(dent, [*shear, depth])


def assert_same_flow(first: FlowField, second: FlowField) -> None:
    for name in ("forward", "forward_visible", "backward", "backward_visible"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), strict=True)


def pixel_centres(width: int = WIDTH, height: int = HEIGHT) -> FloatArray:
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
