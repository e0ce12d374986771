"""One press: a random scene instance with all that its simulation needs, and the rule by which its mesh is chosen."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from synth.errors import InputError
from synth.mesh import PadMesh, edge_length, pad_mesh
from synth.press.indenter import RigidBody, object_radius
from synth.press.load_path import LoadPath
from synth.press.resolution import (
    FINER,
    Accuracy,
    Resolution,
    accuracy,
    resolution_mm,
    resolve,
    scale_px_per_mm,
    shared_mesh,
    shared_spacing_mm,
)
from synth.press.scene_path import path_of
from synth.scene import MeshIndenter, RoundGel, Scene
from synth.scene.numerics import MAX_PENALTY

BLUNTER = ((1.5, 4.0), (2.25, 4.0), (1.8, 3.0), (1.0, 2.0))
"""Factors on the radius of an object's edges and on the contact stiffness, in turn, where its press is incomplete.
Depth then counts from the rounded edge, as for any stated `fillet_mm`."""
SEEN_PX = 1.0
"""What rounding takes off an object's surface is warned of from this size on."""


@dataclass(frozen=True, eq=False)
class Press:
    """A fully drawn scene with all that its simulation needs, built once and handed on.

    The edges of its body are rounded as stated, or to what the mesh resolves. The accuracy is what the mesh is
    predicted to give; None where that is left to `synth.press.resolution.accuracy`.
    """

    scene: Scene
    mesh: PadMesh
    path: LoadPath
    accuracy: Accuracy | None = None

    @classmethod
    def of(cls, scene: Scene, mesh: PadMesh, folder: Path | None = None, accuracy: Accuracy | None = None) -> "Press":
        """Build the body and its path for a mesh of the scene's gel; InputError where the indenter cannot be built."""
        return cls(scene, mesh, path_of(scene, folder, resolution_mm(scene, mesh.spacing_mm)), accuracy)


def as_pressed(scene: Scene, body: RigidBody) -> Scene:
    """The scene with the radius that its indenter's edges had."""
    indenter = scene.contact.indenter
    if not hasattr(indenter, "fillet_mm"):
        return scene
    rounded = indenter.model_copy(update={"fillet_mm": body.fillet_mm})
    return scene.model_copy(update={"contact": scene.contact.model_copy(update={"indenter": rounded})})


def edge_radius_mm(scene: Scene, mesh: PadMesh) -> float | None:
    """Radius to which a mesh rounds the edges of a mesh indenter; None for other shapes."""
    indenter = scene.contact.indenter
    return (
        object_radius(indenter, resolution_mm(scene, mesh.spacing_mm)) if isinstance(indenter, MeshIndenter) else None
    )


def blunter(press: Press) -> Iterator[Scene]:
    """Scenes for pressing an object again, by BLUNTER; none for other shapes, or where the radius is stated."""
    scene, indenter, radius = press.scene, press.scene.contact.indenter, press.path.body.fillet_mm
    if isinstance(indenter, MeshIndenter) and indenter.fillet_mm is None:
        for factor, stiffer in BLUNTER:
            rounder = indenter.model_copy(update={"fillet_mm": factor * radius})
            contact = scene.contact.model_copy(update={"indenter": rounder})
            numerics = scene.numerics.model_copy(update={"penalty": min(stiffer * scene.numerics.penalty, MAX_PENALTY)})
            yield scene.model_copy(update={"contact": contact, "numerics": numerics})


DEFAULT_TARGET_PX = 0.5


@dataclass(frozen=True)
class MeshRule:
    """How the meshes of a scene's trajectories are chosen: decided here, once, from the scene's numerics.

    "graded": around each contact, as fine as the target asks for; "even": `numerics.cells`, the same for all
    trajectories of a pad; "tetwild": by fTetWild, also the same for all: round gels, and others where
    `numerics.edge_length_mm` is given. The targets are the root-mean-square error of the flow that the simulation may
    leave, NaN for "tetwild", for which nothing is predicted, and the error of force and displacement, if one is set.
    """

    kind: Literal["graded", "even", "tetwild"]
    target_error_px: float
    target_error_percent: float | None = None

    @classmethod
    def of(cls, scene: Scene, is_batched: bool = False) -> "MeshRule":
        """The rule of a scene; `is_batched`: many trajectories are simulated at once."""
        numerics = scene.numerics
        if numerics.edge_length_mm is not None or isinstance(scene.sensor.gel, RoundGel):
            return cls("tetwild", float("nan"))
        kind: Literal["even", "graded"] = "even" if is_batched else "graded"
        return cls(kind, numerics.target_error_px or DEFAULT_TARGET_PX, numerics.target_error_percent)

    def resolution(
        self, scene: Scene, folder: Path | None = None, mesh_folders: Sequence[Path] | None = None
    ) -> Resolution:
        """The mesh of a fully drawn scene, and what it is predicted to give; fTetWild's are kept in `mesh_folders`.

        InputError where the indenter, whose mesh file is relative to `folder`, or the mesh cannot be built.
        """
        gel, numerics = scene.sensor.gel, scene.numerics
        match self.kind:
            case "graded":
                return resolve(scene, folder, self.target_error_px, self.target_error_percent)
            case "even":
                found = accuracy(scene, folder)
                mesh, spacing = shared_mesh(gel, numerics), shared_spacing_mm(gel, numerics)
                return Resolution(**vars(found), mesh=mesh, through=numerics.cells[2], spacing_mm=spacing)
            case "tetwild":
                mesh = pad_mesh(gel, numerics, mesh_folders, folder)
                return Resolution(0, float("nan"), float("nan"), mesh, 0, edge_length(gel, numerics))

    def check_edges(self, scene: Scene, mesh: PadMesh) -> None:
        """InputError where the indenter's edges are stated to be sharper than a mesh resolves."""
        stated, least = getattr(scene.contact.indenter, "fillet_mm", None), resolution_mm(scene, mesh.spacing_mm)
        if stated is None or stated >= least:
            return
        finer = {
            "graded": f"which has {FINER[-1]} elements across the contact, the most there are",
            "even": "make numerics.cells finer",
            "tetwild": f"give numerics.edge_length_mm = {mesh.spacing_mm * stated / least:.2g}",
        }
        raise InputError(
            f"contact.indenter.fillet_mm = {stated:g} is sharper than this gel's mesh can follow, "
            f"{finer[self.kind]}; allowed are {least:.2g} mm ({least * scale_px_per_mm(scene):.2g} px) and more, or "
            "leave it out"
        )

    def lost_detail(self, scene: Scene, body: RigidBody, accuracy: Accuracy | None) -> str:
        """A warning that rounding changes what can be seen of an object, with the setting that keeps it; or nothing."""
        scale, radius = scale_px_per_mm(scene), body.fillet_mm
        indenter, cells = scene.contact.indenter, scene.numerics.cells
        if not isinstance(indenter, MeshIndenter) or indenter.fillet_mm or body.lost_mm * scale < SEEN_PX:
            return ""
        finer = 2.0  # so many times the elements across
        if self.kind == "graded" and accuracy:
            finer = min(finer, FINER[-1] / max(accuracy.across, 1))
        setting = f"contact.indenter.fillet_mm = {1.02 * radius / (2 * finer):.2g}"
        if self.kind == "even":
            setting += f" with numerics.cells = [{2 * cells[0]}, {2 * cells[1]}, {cells[2] + 1}]"
        elif self.kind == "tetwild":
            setting += f" with numerics.edge_length_mm = {edge_length(scene.sensor.gel, scene.numerics) / 2:.2g}"
        return (
            f"{indenter.file}: the gel's mesh rounds edges and notches to a radius of {radius:.2g} mm "
            f"({radius * scale:.2g} px), which moves the surface by up to {body.lost_mm:.2g} mm "
            f"({body.lost_mm * scale:.2g} px): parts and gaps less than {2 * radius:.2g} mm wide are changed or lost; "
            f"{setting} keeps finer ones, at about {finer**3:.0f} times the simulation's time"
        )

    def press(self, scene: Scene, folder: Path | None = None, mesh_folders: Sequence[Path] | None = None) -> Press:
        """Mesh, body and load path of a scene; arguments and errors as for `resolution`.

        InputError also where the mesh is too coarse for a stated `fillet_mm`.

        The accuracy of an even mesh is left out: whoever finishes the samples predicts it, beside the simulation.
        """
        if self.kind == "even":
            mesh = shared_mesh(scene.sensor.gel, scene.numerics)
            self.check_edges(scene, mesh)
            return Press.of(scene, mesh, folder)
        found = self.resolution(scene, folder, mesh_folders)
        self.check_edges(scene, found.mesh)
        return Press.of(scene, found.mesh, folder, Accuracy(found.across, found.error_px, found.error_percent))
