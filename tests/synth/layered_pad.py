"""A small box of gel, plain or with a film under its face: the pad of the solver's verification."""

import numpy as np
from pads import SIZE, brick

from synth.mesh import PadMesh

FILM = {"thickness_mm": 1.0, "youngs_modulus_kpa": 2000.0, "poisson_ratio": 0.499, "stiffening": (0.1, 0.02)}


def layered(mesh: PadMesh, interface: float = 1.0) -> PadMesh:
    """The same pad in two layers, which meet at z = interface."""
    layer = (mesh.points[mesh.tets].mean(axis=1)[:, 2] > interface).astype(np.int32)
    assert 0 < layer.sum() < len(layer)
    return PadMesh(mesh.points, mesh.tets, mesh.size_mm, layer)


def pad(layers: bool) -> PadMesh:
    """Plain, or with the first of four planes of cells for a film."""
    return layered(brick(SIZE, (4, 4, 4))) if layers else brick()
