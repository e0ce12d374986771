"""The parts of a scene's schema that say how finely it is rendered and simulated."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from synth.scene.part import Part, Positive


class Render(Part):
    """How pictures are rendered: samples, path length and method."""

    samples_per_pixel: Annotated[int, Field(ge=1, le=65536)] | Literal["auto"] = 36
    """Rounded up to a full grid and a multiple of the number of lights. auto: for every sensor drawn, as many as it
    takes so that the renderer's noise is a quarter of the main camera's own."""
    max_depth: Annotated[int, Field(ge=2, le=64)] = 4
    """Longest light path in surfaces and lights; 2 is direct light only. The window does not count."""
    light: Literal["path_traced", "separated"] = "path_traced"
    """separated: direct light in closed form, what is blocked of it and bounced light sampled at their own rates; with
    as many samples a quarter of the noise or less (docs/reports/light.md). For matt coatings; scalar variants, where
    there is neither LLVM nor a GPU, path-trace what has the same expectation."""


Cells = Annotated[int, Field(ge=4, le=200, multiple_of=2)]
"""An even number of elements, so that a mesh is its own mirror image."""
MAX_PENALTY = 1e4


class Numerics(Part):
    """Resolution and tolerances of the simulation."""

    element: Literal["auto", "p1p1", "p2p1"] = "auto"
    """auto is p2p1: at every run time it was the more accurate."""
    target_error_px: Positive | None = None
    """Root-mean-square error that the flow over the seen face may have from the simulation; default 0.5. The mesh is
    made as fine under each trajectory's contact as this asks for."""
    target_error_percent: Annotated[float, Field(ge=0.1, le=50)] | None = None
    """Error that the simulation may leave in the contact force, and in the displacement of the contact face (relative
    L2), each in percent of the largest of the press; default: no limit. The mesh is the finer of those that this and
    target_error_px ask for."""
    edge_length_mm: Positive | None = None
    """Instead of a target: one fTetWild mesh for all trajectories with tetrahedra of this edge at the contact face."""
    solver: Literal["auto", "single", "batched"] = "auto"
    """batched: many trajectories at once on one mesh of the pad, for GPUs; `cells` or edge_length_mm say which, and a
    target is only what `plan` compares with. The same laws and tolerances, other meshes: other samples. auto: batched
    where a GPU renders and all sensors' pads can share a mesh."""
    cells: tuple[Cells, Cells, Annotated[int, Field(ge=1, le=20)]] = (16, 12, 2)
    """Elements of the batched solver's mesh along x and y, where they are even in size, and through the thickness."""
    max_step_mm: Positive = 0.25
    """Longest motion of the indenter in one load step; steps are halved when Newton fails."""
    tolerance: Annotated[float, Field(ge=1e-12, le=1e-2)] = 1e-6
    """Newton stops when the residual is below this fraction of the norm of all nodal forces."""
    penalty: Annotated[float, Field(ge=1, le=MAX_PENALTY)] = 50.0
    """Contact stiffness in multiples of E per mm, before augmented-Lagrangian updates; sharp bodies get up to four
    times as much, mesh indenters up to eight times. Retries of objects and deep penetration raise it further."""

    @model_validator(mode="after")
    def _one_resolution(self) -> "Numerics":
        if self.target_error_px is not None and self.edge_length_mm is not None:
            raise ValueError("target_error_px and edge_length_mm both fix the mesh: give one of them")
        if self.target_error_percent is not None and (self.edge_length_mm is not None or self.element == "p1p1"):
            raise ValueError(
                f"target_error_percent = {self.target_error_percent:g} is predicted for meshes of its own, of P2/P1 "
                'elements: leave out edge_length_mm, and element = "p1p1"'
            )
        return self
