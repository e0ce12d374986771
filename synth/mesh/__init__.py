"""Tetrahedral meshes of the gel pad."""

from synth.mesh.cache import default_edge_length, mesh_key, pad_mesh
from synth.mesh.pad import PadMesh

__all__ = ["PadMesh", "default_edge_length", "mesh_key", "pad_mesh"]
