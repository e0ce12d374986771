"""Makes small solids for the simulation to press into a gel: everyday and technical objects of our own design.

Each file is a binary STL in millimetres, a closed surface oriented outward, whose side worth pressing faces +z. Axes
are right-handed, as in any STL file. The files are made anew, beside this script or in a given folder, by

    python scenes/objects/make.py [FOLDER]
"""

import argparse
from pathlib import Path

import numpy as np
from manifold3d import Manifold
from objects import OBJECTS

TOLERANCE = 1e-2
"""How far simplification may move the surface, mm: it removes the slivers that Boolean operations leave."""
DECIMALS = 4
"""Of the coordinates in mm, so that the last digits of a platform's sine do not reach the file."""
TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
"""A triangle in a binary STL file."""


def stl(name: str, solid: Manifold) -> bytes:
    """Binary STL of a solid, its triangles in an order that does not depend on how it was computed."""
    mesh = solid.as_original().simplify(TOLERANCE).to_mesh64()
    rounded = np.round(mesh.vert_properties, DECIMALS) + 0.0  # adding 0 removes the sign of -0
    vertices, rank = np.unique(rounded, axis=0, return_inverse=True)
    indices = rank[mesh.tri_verts]
    indices = np.take_along_axis(indices, (indices.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    corners = vertices[indices[np.lexsort(indices.T[::-1])]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    triangles = np.zeros(len(corners), dtype=TRIANGLE)
    triangles["corners"] = corners
    triangles["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    header = f"{name}, mm".encode().ljust(80)
    return header + np.uint32(len(triangles)).tobytes() + triangles.tobytes()


def main() -> None:
    """Write one file for each object."""
    parser = argparse.ArgumentParser(description="Make the STL files of the objects.")
    parser.add_argument(
        "folder", nargs="?", type=Path, default=Path(__file__).parent, help="default: beside the script"
    )
    folder: Path = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    for name, build in OBJECTS.items():
        (folder / f"{name}.stl").write_bytes(stl(name, build()))


if __name__ == "__main__":
    main()
