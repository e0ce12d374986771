"""One press: a random scene instance with all that its simulation needs, built once and handed on."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from synth.mesh import PadMesh
from synth.scene import MeshIndenter, Scene
from synth.simulate.element import Element, p1p1, p2p1
from synth.simulate.indenter import object_radius
from synth.simulate.load_path import LoadPath, path_of
from synth.simulate.resolution import Accuracy

ELEMENTS: dict[str, Callable[[], Element]] = {"auto": p2p1, "p1p1": p1p1, "p2p1": p2p1}


@dataclass(frozen=True, eq=False)
class Press:
    """See the module's docstring.

    Attributes:
        scene: fully drawn.
        mesh: of scene.sensor.gel.
        path: the load path of its body, whose edges are rounded to what the mesh resolves.
        accuracy: what the mesh is predicted to give; None where that is left to `synth.simulate.resolution.accuracy`.
    """

    scene: Scene
    mesh: PadMesh
    path: LoadPath
    accuracy: Accuracy | None = None

    @classmethod
    def of(cls, scene: Scene, mesh: PadMesh, folder: Path | None = None, accuracy: Accuracy | None = None) -> "Press":
        """Build the body and its path for a mesh of the scene's gel; InputError where the indenter cannot be built."""
        return cls(scene, mesh, path_of(scene, folder, resolution_mm(scene, mesh)), accuracy)


def edge_radius_mm(scene: Scene, mesh: PadMesh) -> float | None:
    """Radius to which a mesh rounds the edges of a mesh indenter; None for other shapes."""
    indenter = scene.contact.indenter
    return object_radius(indenter, resolution_mm(scene, mesh)) if isinstance(indenter, MeshIndenter) else None


def resolution_mm(scene: Scene, mesh: PadMesh) -> float:
    """Smallest radius of an indenter's edges that the contact points resolve: half their distance."""
    return mesh.spacing_mm / (2 * ELEMENTS[scene.numerics.element]().order)
