"""Round gels for the tests: capsules of quadratic triangles, and sensors that look at them from within."""

import numpy as np

from benchmarks.capsule_surface import capsule_surface
from synth.arrays import Points
from synth.mesh.capsule import CapsuleFace
from synth.scene import BoxGel, Camera, Light, NoPattern, Sensor
from synth.surface import GelSurface

RADIUS, LENGTH = 12.0, 8.0  # Of the coated face, mm: a hemisphere about (0, 0, RADIUS) and a cylinder above it
INNER = 9.0  # Radius of the window's face
SPHERE = {"shape": "sphere", "radius_mm": INNER, "center_z_mm": RADIUS}
CAPSULE = {"shape": "capsule", "radius_mm": INNER, "center_z_mm": RADIUS}
CYLINDER = {"shape": "cylinder", "radius_mm": INNER}
WIDE = {"lens": "fisheye", "distortion": (-0.02, 0.004, -0.001, 0.0), "fx": 18.6, "fy": 19.3}
INSIDE = {"position_mm": (0.0, 0.0, RADIUS + 1.0), "look_at_mm": (0.0, 0.0, 0.0)}
ASKEW = {"position_mm": (2.5, -3.0, RADIUS + 2.0), "look_at_mm": (-2.0, 4.0, 3.0)}


def sensor(window: dict, index: float = 1.45, lights: tuple[Light, ...] = (), **camera: object) -> Sensor:
    """A camera of 64 x 64 px and some 190 degrees of field, unless other numbers are given."""
    given = {"width": 64, "height": 64, "cx": 31.8, "cy": 32.3, **WIDE, **INSIDE, **camera}
    light = Light(position_mm=(10.0, 0.0, 14.0), size_mm=(0.5, 0.5), color=(1, 1, 1), power=1)
    parts = {"gel": BoxGel(size_mm=(24, 24, 20), youngs_modulus_kpa=200), "pattern": NoPattern(kind="none")}
    glass = {"refractive_index": index, "thickness_mm": 1, **window}
    return Sensor(**parts, window=glass, lights=lights or (light,), camera=Camera(**given))


def on_face(points: Points) -> Points:
    foot = points * (0, 0, 1)
    foot[:, 2] = np.maximum(foot[:, 2], RADIUS)
    arm = points - foot
    return foot + arm * (RADIUS / np.linalg.norm(arm, axis=1, keepdims=True))


def capsule(edge_mm: float, length: float = LENGTH) -> GelSurface:
    """The face at rest, of quadratic triangles with edges of about that length."""
    return capsule_surface(CapsuleFace(RADIUS, RADIUS - INNER, length), edge_mm)


def dented(points: Points, place: Points, depth: float, shear: tuple[float, float, float] = (0, 0, 0)) -> Points:
    """Moved inward about a place (3,) on the face by a dent of some 3 mm radius, and sideways."""
    dent = np.exp(-((points - place) ** 2).sum(axis=1) / 9.0)[:, None]
    foot = np.array([0.0, 0.0, max(place[2], RADIUS)])
    return points + dent * ((foot - place) / RADIUS * depth + np.array(shear))
