"""The outline of an object's contact, which the error model needs and a file of triangles does not tell.

Sampled where the object, pressed to its depth, cuts the undeformed face and a level halfway down.
"""

from dataclasses import dataclass

import numpy as np

from synth.arrays import FloatArray
from synth.mesh.focus import Focus
from synth.mesh.pad import face_height
from synth.simulate.measure import Distance
from synth.simulate.path import Path

COUNT = 160
"""Samples along each side of the zone."""
BLURRED = 1.5
"""Half width of the strip along the outline whose area gives its length, samples."""


@dataclass(frozen=True)
class Outline:
    """Where an object meets the undeformed face.

    Attributes:
        rim_mm: length of the contact's edges, inner ones as well.
        band_mm: half width of the band along them that touches, as `synth.simulate.error_model` has it; 0 for upright
            sides.
    """

    rim_mm: float
    band_mm: float


def outline(path: Path, focus: Focus) -> Outline:
    """The outline at the end of the press, within the zone that the indenter touches."""
    pose = path.pose(path.press_mm)
    distance = Distance(path.body, pose.centre[None], pose.rotation[None])
    axes = [
        centre + half * np.linspace(-1.1, 1.1, COUNT)
        for centre, half in zip(focus.centre_mm, focus.half_mm, strict=True)
    ]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    face = face_height(places, path.dome_radius_mm)

    def cut(level: float) -> FloatArray:
        """Distances from the object at a level below the face."""
        points = np.column_stack([places, face + level])
        return distance(points, np.zeros(len(points), dtype=np.int32))[1].reshape(COUNT, COUNT)

    spacing = [float(axis[1] - axis[0]) for axis in axes]
    cell = spacing[0] * spacing[1]
    at_face, slope = cut(0.0), np.zeros((COUNT, COUNT))
    slope = np.hypot(*np.gradient(at_face, *spacing))
    strip = BLURRED * np.sqrt(cell) * np.maximum(slope, 0.1)
    rim = float((np.maximum(1 - np.abs(at_face) / strip, 0.0) / strip * slope).sum() * cell)
    if rim == 0:
        return Outline(0.0, 0.0)
    lost = float(((at_face < 0).sum() - (cut(max(pose.depth_mm + path.face_mm, 0.0) / 2) < 0).sum()) * cell)
    return Outline(rim, 4 * max(lost, 0.0) / rim)
