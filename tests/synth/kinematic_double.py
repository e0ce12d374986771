"""A kinematic double: flat gels moved by a formula in place of the solver, under a camera that tests can alter."""

from collections.abc import Callable

import numpy as np

from synth.arrays import FloatArray, Points
from synth.optics import Optics
from synth.scene import Camera, Gel, Light, NoPattern, Sensor, Window
from synth.surface import ContactFaces, GelSurface

WIDTH, HEIGHT = 64, 48
LENS = (-0.25, 0.08, 1e-3, -2e-3, 0.01)
STRAIGHT = {"position_mm": (1.0, -0.5, 24.0), "look_at_mm": (1.0, -0.5, 0.0)}
OBLIQUE = {"position_mm": (3.0, -2.0, 22.0), "look_at_mm": (-0.5, 0.7, 0.0)}


def sensor(*, index: float = 1.0, **camera: object) -> Sensor:
    """A 20 x 15 x 4 mm pad with a 5 mm window (outer face at z = 9) and a camera of 64 x 48 px."""
    given = {"width": WIDTH, "height": HEIGHT, "fx": 70.0, "fy": 71.0, "cx": 31.7, "cy": 24.4, **STRAIGHT, **camera}
    return Sensor(
        gel=Gel(size_mm=(20, 15, 4), youngs_modulus_kpa=200),
        window=Window(refractive_index=index, thickness_mm=5),
        pattern=NoPattern(kind="none"),
        lights=(Light(position_mm=(9, 0, 3), size_mm=(1, 1), color=(1, 1, 1), power=1),),
        camera=Camera(**given),
    )


def optics(*, index: float = 1.0, **camera: object) -> Optics:
    return Optics.of(sensor(index=index, **camera))


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


def pixel_centres(width: int = WIDTH, height: int = HEIGHT) -> FloatArray:
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
