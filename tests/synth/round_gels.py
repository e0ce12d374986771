"""Round gels for the tests: capsules of quadratic triangles, and sensors that look at them from within."""

import numpy as np

from synth.arrays import FloatArray, Points
from synth.scene import Camera, Gel, Light, NoPattern, Sensor, Window
from synth.surface import FACE_EDGES, ContactFaces, GelSurface

RADIUS, LENGTH = 12.0, 8.0
"""Of the coated face, mm: a hemisphere about (0, 0, RADIUS) and a cylinder above it."""
INNER = 9.0
"""Radius of the window's face."""
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
    return Sensor(
        gel=Gel(size_mm=(24, 24, 20), youngs_modulus_kpa=200),
        window=Window(refractive_index=index, thickness_mm=1, **window),
        pattern=NoPattern(kind="none"),
        lights=lights or (light,),
        camera=Camera(**given),
    )


def on_capsule(points: Points) -> Points:
    """Points (n, 3) moved along the normal onto the face."""
    foot = points * (0, 0, 1)
    foot[:, 2] = np.maximum(foot[:, 2], RADIUS)
    arm = points - foot
    return foot + arm * (RADIUS / np.linalg.norm(arm, axis=1, keepdims=True))


def capsule(rings: int, length: float = LENGTH, subdivisions: int = 3) -> GelSurface:
    """The face as rings of 6, 12, 18, ... nodes about the tip, as far from each other along the meridians."""
    end = RADIUS * np.pi / 2 + length
    places = [(0.0, 0.0)]
    places += [(end * k / rings, np.pi / 3 / k * i) for k in range(1, rings + 1) for i in range(6 * k)]
    arc, azimuth = np.array(places).T
    angle = np.minimum(arc / RADIUS, np.pi / 2)
    across, z = RADIUS * np.sin(angle), RADIUS * (1 - np.cos(angle)) + np.maximum(arc - RADIUS * np.pi / 2, 0)
    nodes = np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), z])
    faces = []
    for k in range(1, rings + 1):
        inner, outer = 1 + 3 * (k - 1) * (k - 2), 1 + 3 * k * (k - 1)
        for i in range(6 * k):
            sector, along = divmod(i, k)
            low = 0 if k == 1 else inner + (sector * (k - 1) + along) % (6 * (k - 1))
            high, after = outer + i, outer + (i + 1) % (6 * k)
            faces.append((low, after, high))
            if along < k - 1:
                faces.append((low, inner + (sector * (k - 1) + along + 1) % (6 * (k - 1)), after))
    return quadratic(nodes, np.array(faces), subdivisions)


def quadratic(nodes: Points, corners: FloatArray, subdivisions: int) -> GelSurface:
    """Triangles with nodes amid their edges, laid on the face; normals out of the gel."""
    edges = np.sort(np.concatenate([corners[:, pair] for pair in FACE_EDGES]), axis=1)
    unique, number = np.unique(edges, axis=0, return_inverse=True)
    middles = on_capsule(nodes[unique].mean(axis=1))
    six = np.column_stack([corners, len(nodes) + number.reshape(3, -1).T]).astype(np.int32)
    return GelSurface(ContactFaces(np.vstack([nodes, middles]), six), subdivisions)


def pressed(points: Points, place: Points, depth: float, shear: tuple[float, float, float] = (0, 0, 0)) -> Points:
    """Moved inward about a place (3,) on the face by a dent of some 3 mm radius, and sideways."""
    dent = np.exp(-((points - place) ** 2).sum(axis=1) / 9.0)[:, None]
    foot = np.array([0.0, 0.0, max(place[2], RADIUS)])
    return points + dent * ((foot - place) / RADIUS * depth + np.array(shear))
