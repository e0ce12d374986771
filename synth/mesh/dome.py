r"""Pads whose contact face is part of a sphere: the meshes of boxes, mapped.

The face z_f(x, y) = R - sqrt(R² - x² - y²) touches z = 0 at its apex; the pad's sides and its bonded face, z = H, stay
as they are. A point of the box goes to

.. math::  z' = z_f + z \frac{H - z_f}{H}

so that layers, and the elements' heights, keep their shares of the thickness. Structured meshes stay valid whatever R:
each of their tetrahedra has one edge along z, and its volume is a third of the area of its shadow on z = 0 times that
edge's length, which the map shortens by (H - z_f) / H and nothing else. They are flattened and sheared toward the
corners. Unstructured tetrahedra may turn over, which is checked.

The mesh is the chords' polyhedron: its volume differs from the cap's by O(h²). `synth.simulate.space` puts the
mid-edge nodes of the face back on the sphere, for contact and for the picture.
"""

from dataclasses import replace

import numpy as np

from synth.errors import InputError
from synth.mesh.face import PadFace, face_height
from synth.mesh.pad import PadMesh


def domed(mesh: PadMesh, dome_radius_mm: float | None) -> PadMesh:
    """A flat pad's mesh with its contact face bulged to a sphere; the mesh itself for None.

    InputError where a tetrahedron turns over.
    """
    if dome_radius_mm is None:
        return mesh
    points, thickness = mesh.points.copy(), mesh.size_mm[2]
    face = face_height(points[:, :2], dome_radius_mm)
    inner = face + points[:, 2] * ((thickness - face) / thickness)
    # The face's nodes and the bonded ones come out to the last bit.
    points[:, 2] = np.where(points[:, 2] == thickness, thickness, inner)
    bulged = replace(mesh, points=points, face=PadFace(dome_radius_mm))
    if bulged.volumes.min() <= 0:
        raise InputError(
            f"a mesh of even edge length turns over where it is bulged to sensor.gel.dome_radius_mm = "
            f"{dome_radius_mm}: leave out numerics.edge_length_mm, or make it smaller"
        )
    return bulged
