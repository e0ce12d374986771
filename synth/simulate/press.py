"""One press: a random scene instance with all that its simulation needs, and the rule by which its mesh is chosen."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from synth.mesh import PadMesh, default_edge_length, pad_mesh
from synth.scene import MeshIndenter, Scene
from synth.scene.numerics import MAX_PENALTY
from synth.simulate.element import Element, p1p1, p2p1
from synth.simulate.indenter import object_radius
from synth.simulate.load_path import LoadPath, path_of
from synth.simulate.resolution import Accuracy, Resolution, accuracy, resolve, shared_mesh, shared_spacing_mm

BLUNTER = ((1.5, 1.0), (1.5, 2.0), (2.25, 4.0), (1.8, 3.0), (1.0, 2.0))
"""Factors on the radius of an object's edges and on the contact stiffness, in turn, where its press is incomplete.
Depth then counts from the rounded edge, as for any stated `fillet_mm`."""
ELEMENTS: dict[str, Callable[[], Element]] = {"auto": p2p1, "p1p1": p1p1, "p2p1": p2p1}


@dataclass(frozen=True, eq=False)
class Press:
    """A fully drawn scene with all that its simulation needs, built once and handed on.

    The edges of its body are rounded to what the mesh resolves. The accuracy is what the mesh is predicted to give;
    None where that is left to `synth.simulate.resolution.accuracy`.
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


def blunter(press: Press) -> Iterator[Scene]:
    """Scenes for pressing an object again, by BLUNTER; none for other shapes, or if the edges are rounder already."""
    scene, indenter, radius = press.scene, press.scene.contact.indenter, edge_radius_mm(press.scene, press.mesh) or 0.0
    if isinstance(indenter, MeshIndenter) and (indenter.fillet_mm or 0.0) < radius:
        for factor, stiffer in BLUNTER:
            rounder = indenter.model_copy(update={"fillet_mm": factor * radius})
            contact = scene.contact.model_copy(update={"indenter": rounder})
            numerics = scene.numerics.model_copy(update={"penalty": min(stiffer * scene.numerics.penalty, MAX_PENALTY)})
            yield scene.model_copy(update={"contact": contact, "numerics": numerics})


def resolution_mm(scene: Scene, mesh: PadMesh) -> float:
    """Smallest radius of an indenter's edges that the contact points resolve: half their distance."""
    return mesh.spacing_mm / (2 * ELEMENTS[scene.numerics.element]().order)


DEFAULT_TARGET_PX = 0.5


@dataclass(frozen=True)
class MeshRule:
    """How the meshes of a scene's trajectories are chosen: decided here, once, from the scene's numerics.

    "graded": around each contact, as fine as the target asks for; "even": `numerics.cells`, the same for all
    trajectories of a pad; "tetwild": by fTetWild, also the same for all: round gels, and others where
    `numerics.edge_length_mm` is given. The target is the root-mean-square error of the flow that the simulation may
    leave, NaN for "tetwild", for which nothing is predicted.
    """

    kind: Literal["graded", "even", "tetwild"]
    target_error_px: float

    @classmethod
    def of(cls, scene: Scene, is_batched: bool = False) -> "MeshRule":
        """The rule of a scene; `is_batched`: many trajectories are simulated at once."""
        numerics = scene.numerics
        if numerics.edge_length_mm is not None or scene.sensor.gel.is_round:
            return cls("tetwild", float("nan"))
        return cls("even" if is_batched else "graded", numerics.target_error_px or DEFAULT_TARGET_PX)

    def resolution(
        self, scene: Scene, folder: Path | None = None, mesh_folders: Sequence[Path] | None = None
    ) -> Resolution:
        """The mesh of a fully drawn scene, and what it is predicted to give; fTetWild's are kept in `mesh_folders`.

        InputError where the indenter, whose mesh file is relative to `folder`, or the mesh cannot be built.
        """
        gel, numerics = scene.sensor.gel, scene.numerics
        match self.kind:
            case "graded":
                return resolve(scene, folder, self.target_error_px)
            case "even":
                found = accuracy(scene, folder)
                mesh, spacing = shared_mesh(gel, numerics), shared_spacing_mm(gel, numerics)
                return Resolution(found.across, found.error_px, mesh, numerics.cells[2], spacing)
            case "tetwild":
                mesh = pad_mesh(gel, numerics, mesh_folders, folder)
                return Resolution(0, float("nan"), mesh, 0, numerics.edge_length_mm or default_edge_length(gel))

    def press(self, scene: Scene, folder: Path | None = None, mesh_folders: Sequence[Path] | None = None) -> Press:
        """Mesh, body and load path of a scene; arguments as for `resolution`.

        The accuracy of an even mesh is left out: whoever finishes the samples predicts it, beside the simulation.
        """
        if self.kind == "even":
            return Press.of(scene, shared_mesh(scene.sensor.gel, scene.numerics), folder)
        found = self.resolution(scene, folder, mesh_folders)
        return Press.of(scene, found.mesh, folder, Accuracy(found.across, found.error_px))
