"""The shape of a gel's contact face: which nodes of a mesh lie on it, which are bonded, and where between them it runs.

Nodes on a shape are recognised by their coordinates: those of flat pads and domes lie on it to the last bit, those of
round gels within rounding.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from synth.arrays import BoolArray, FloatArray, Points
from synth.mesh.cad import CadFace
from synth.mesh.capsule import CapsuleFace
from synth.scene import CapsuleGel, FileGel, Gel
from synth.scene.gel import dome_height


@dataclass(frozen=True)
class PadFace:
    """The face of a box or of a dome, part of a sphere of that radius; bonded where z is the pad's thickness."""

    dome_radius_mm: float | None = None

    def holds(self, points: Points) -> BoolArray:
        """Which points (n, 3) mm lie on the contact face."""
        return np.asarray(points[:, 2] == face_height(points[:, :2], self.dome_radius_mm))

    def bonded(self, points: Points, size_mm: tuple[float, float, float]) -> BoolArray:
        """Which points (n, 3) mm of a gel whose bounding box is of that size are held by the window."""
        return np.asarray(points[:, 2] == size_mm[2])

    def project(self, points: Points) -> Points:
        """Points (n, 3) mm near the contact face, moved onto it along z."""
        return np.column_stack([points[:, :2], face_height(points[:, :2], self.dome_radius_mm)])

    def __str__(self) -> str:
        return "pad" if self.dome_radius_mm is None else f"pad of dome radius {self.dome_radius_mm} mm"


FLAT_FACE = PadFace()
RoundFace = CapsuleFace | CadFace
Face = PadFace | RoundFace


def face_of(gel: Gel, folder: Path = Path()) -> Face:
    """The shape of a scene's gel, whose files are relative to `folder`."""
    match gel:
        case CapsuleGel():
            return CapsuleFace(gel.radius_mm, gel.thickness_mm, gel.length_mm, gel.cut_end == "held")
        case FileGel():
            files = folder / gel.outer, folder / gel.window
            return CadFace(*files, gel.unit, gel.rotation_deg, gel.cut_end == "held")
        case _:
            return PadFace(gel.dome_radius_mm)


def face_height(places: FloatArray, dome_radius_mm: float | None) -> FloatArray:
    """Z (n,) mm of the undeformed contact face of a pad at places (n, 2) mm."""
    if dome_radius_mm is None:
        return np.zeros(len(places))
    return np.asarray(dome_height((places**2).sum(axis=1), dome_radius_mm))
