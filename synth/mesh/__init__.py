"""Tetrahedral meshes of the gel pad."""

from synth.mesh.cache import default_edge_length, mesh_key, pad_mesh
from synth.mesh.focus import Focus
from synth.mesh.graded import Counts, graded_box
from synth.mesh.pad import PadMesh, check_mesh

__all__ = ["Counts", "Focus", "PadMesh", "check_mesh", "default_edge_length", "graded_box", "mesh_key", "pad_mesh"]
