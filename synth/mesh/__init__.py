"""Tetrahedral meshes of the gel pad."""

from synth.mesh.cache import edge_length, mesh_key, pad_mesh
from synth.mesh.dome import domed, rest_surface
from synth.mesh.face import face_height, face_of
from synth.mesh.graded import Counts, Focus, graded_box
from synth.mesh.pad import PadMesh, check_mesh

__all__ = [
    "Counts", "Focus", "PadMesh", "check_mesh", "domed", "edge_length", "face_height", "face_of",
    "graded_box", "mesh_key", "pad_mesh", "rest_surface",
]  # fmt: skip
