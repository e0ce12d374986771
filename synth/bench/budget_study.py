"""What the study of the error budget runs: draws of scenes, each on meshes of the ladder and on a reference's.

A draw is the one that `generate` makes a trajectory of: same streams, same mesh, same wanted states. The states that
its pairs show are judged.

What a press gives is decided by its draw, its mesh and the solver. So a study is of scenes, seed and solver, a press is
known again by its mesh, and which of the meshes the error model would choose is no part of either: a changed model asks
for some other meshes and leaves what was measured as it is.
"""

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from synth.errors import InputError
from synth.mesh import Counts, Focus, PadMesh, domed, graded_box
from synth.planning.prediction import ITERATIONS_PER_RECORD, ITERATIONS_PER_STEP, SOLVE_GROWTH
from synth.scene import Gel, Scene
from synth.scene.sampling import MAX_DRAWS, draw, draw_sensor, pairs_of, sensor_of
from synth.scene.template import Template
from synth.simulate.footprint import footprint
from synth.simulate.indenter import rigid_body
from synth.simulate.mesh_rule import MeshRule
from synth.simulate.newton import MAX_ITERATIONS
from synth.simulate.path import Path as IndenterPath
from synth.simulate.resolution import (
    LADDER,
    MARGIN,
    STEEPEST_DEPTH,
    Fineness,
    Resolution,
    depth_growth,
    graded_mesh,
    ladder,
    lateral_spacing,
    predicted_error_px,
)

BEYOND = 3
"""Rungs that are run above the chosen one."""
REFERENCE = "reference"
"""In place of a rung's name."""
CHOOSERS = ("error_model.py", "resolution.py", "shared.py")
"""Of `synth.simulate`: choose a mesh, and have no part in a press on it."""


@dataclass(frozen=True)
class Reference:
    """What errors are measured against; all else is as for any draw.

    Attributes:
        across: elements across the contact, at most.
        finer: how many times smaller than the chosen mesh's elements its own are to be, at least. Errors fall with the
            power 1.6 of their size: a quarter of the chosen mesh's error is left.
        beside: elements beside it, along x and along y; three and two on the ladder.
        step_mm: longest load step.
        correction_iterations: of Newton's method in one augmented-Lagrangian pass, more near balance; with a draw's
            fewer, some passes are dropped.
    """

    across: int = 18
    finer: float = 2.4
    beside: tuple[int, int] = (4, 3)
    step_mm: float = 0.125
    correction_iterations: int = MAX_ITERATIONS

    def across_of(self, gel: Gel, focus: Focus, chosen_mm: float) -> int:
        """Elements across a draw's contact, given the size of those of its chosen mesh."""
        for number in range(LADDER[1], self.across, 2):
            if self.finer * lateral_spacing(gel, focus, Counts((number, number), self.beside)) <= chosen_mm:
                return number
        return self.across

    def mesh(self, gel: Gel, focus: Focus, chosen_mm: float) -> tuple[PadMesh, float]:
        """The mesh of a pad, and the spacing under the contact (mm); arguments as of `across_of`.

        Through the thickness it has one element more than `graded_mesh` would have for as many across; the first is
        still as high as wide, or lower.
        """
        return next(self.meshes(gel, focus, chosen_mm))

    def meshes(self, gel: Gel, focus: Focus, chosen_mm: float) -> Iterator[tuple[PadMesh, float]]:
        """That mesh, then finer ones, which do as well; as of `mesh`."""
        for number in sorted({*range(self.across_of(gel, focus, chosen_mm), self.across, 2), self.across}):
            yield self._mesh(gel, focus, number)

    def _mesh(self, gel: Gel, focus: Focus, number: int) -> tuple[PadMesh, float]:
        size, across = gel.size_mm, (number, number)
        fine = lateral_spacing(gel, focus, Counts(across, self.beside))
        height = size[2] / fine
        through = max(2, math.ceil(math.log1p(height * (STEEPEST_DEPTH - 1)) / math.log(STEEPEST_DEPTH))) + 1
        counts = Counts(across, self.beside, through, growth=depth_growth(through, height))
        box = graded_box(size, focus, counts, tuple(layer.thickness_mm for layer in gel.layers))
        return domed(box, gel.dome_radius_mm), fine


@dataclass(frozen=True, eq=False)
class Drawn:
    """One draw of a scene.

    Attributes:
        template: of the scene.
        index: number of the trajectory.
        attempt: how many draws before it the schema or the mesher refused.
        scene: what was drawn.
        focus: where it touches.
        frames: numbers of the states that the trajectory's pairs show.
        chosen: the mesh that its budget asks for.
        target_px: the budget.
    """

    template: Template
    index: int
    attempt: int
    scene: Scene
    focus: Focus
    frames: frozenset[int]
    chosen: Resolution
    target_px: float

    @property
    def judged(self) -> list[int]:
        """The frames in which the gel is pressed."""
        return sorted(self.frames - {0})

    @property
    def chosen_rung(self) -> str:
        """The name of the mesh that its budget asks for."""
        return str(Fineness(self.chosen.across, self.chosen.through))

    def mesh(self, rung: str) -> tuple[PadMesh, float]:
        """The mesh of a rung, and its spacing under the contact (mm)."""
        return graded_mesh(self.scene.sensor.gel, self.focus, *Fineness.of(rung))

    def predicted_px(self, spacing_mm: float) -> float:
        """What the error model says of a mesh, as `resolve` asks it."""
        return predicted_error_px(self.scene, self.focus, spacing_mm)


def drawn(template: Template, seed: int, index: int) -> Drawn:
    """The draw of a trajectory: as `generate`, the first that the schema and the mesher take.

    Raises:
        InputError: none of its attempts can be used.
    """
    sensor, refused = draw_sensor(template, seed, sensor_of(template, index)), ""
    rule = MeshRule.of(template.numerics)
    for attempt in range(MAX_DRAWS):
        try:
            scene = draw(template, seed, index, attempt, sensor)
            chosen = rule.resolution(scene, template.source.parent)
            body = rigid_body(scene.contact.indenter, template.source.parent)
        except InputError as error:
            refused = str(error)
            continue
        gel = scene.sensor.gel
        focus = footprint(IndenterPath(scene.motion, body, gel.dome_radius_mm), gel.size_mm, MARGIN)
        frames = frozenset(k for pair in pairs_of(template, seed, index, scene.motion.steps) for k in pair.frames)
        return Drawn(template, index, attempt, scene, focus, frames, chosen, rule.target_error_px)
    raise InputError(f"{template.name}, draw {index}: none of {MAX_DRAWS} attempts can be used: {refused}")


@dataclass(frozen=True)
class Job:
    """One press: scene's name, number of its draw, and rung: a `Fineness` as text, or REFERENCE."""

    scene: str
    index: int
    rung: str


@dataclass(frozen=True)
class Study:
    """What is asked for.

    Attributes:
        templates: scenes of different names, whose meshes are chosen by a budget.
        seed: of the draws.
        draws: of each scene.
        across: elements across that rungs may have, rising.
        reference: what errors are measured against.

    Raises:
        InputError: two scenes of one name, or one with an edge length in place of a budget.
    """

    templates: tuple[Template, ...]
    seed: int
    draws: int
    across: tuple[int, ...] = LADDER
    reference: Reference = Reference()

    def __post_init__(self) -> None:
        """Refuse what has no budget or cannot be told apart."""
        names = [template.name for template in self.templates]
        for template in self.templates:
            if names.count(template.name) > 1:
                raise InputError(f"--scene: {names.count(template.name)} scenes are named {template.name!r}; give one")
            if template.corners[0].numerics.edge_length_mm is not None:
                raise InputError(
                    f"{template.source}: numerics.edge_length_mm is given, so that there is no error budget to be "
                    "studied; give target_error_px instead"
                )

    def record(self) -> dict[str, Any]:
        """What tells a study from others, JSON-able; more draws may be added to one."""
        return {
            "scenes": {template.name: template.hash for template in self.templates},
            "solver": solver(),
            "seed": self.seed,
            "across": list(self.across),
            "reference": {**asdict(self.reference), "beside": list(self.reference.beside)},
        }

    def template(self, name: str) -> Template:
        """The scene of that name."""
        return next(template for template in self.templates if template.name == name)

    def rungs(self, one: Drawn) -> list[str]:
        """The meshes that a draw is run on, cheapest first: those of its ladder up to BEYOND above the chosen one that
        have fewer elements across the contact than the reference.
        """
        gel = one.scene.sensor.gel
        finest = self.reference.across_of(gel, one.focus, one.chosen.spacing_mm)
        names = [str(fineness) for fineness in ladder(gel, one.focus, self.across) if fineness.across < finest]
        chosen = one.chosen_rung
        if chosen not in names:  # finer than all of them
            return [*names, chosen]
        return names[: names.index(chosen) + BEYOND + 1]

    def answered(self, one: Drawn, rung: str, mesh_hash: str) -> bool:
        """Whether a press on the mesh of that hash is what is asked for: on the rung's mesh, or on a reference's that
        is as fine as is wanted, or finer.
        """
        if rung != REFERENCE:
            return one.mesh(rung)[0].hash == mesh_hash
        found = self.reference.meshes(one.scene.sensor.gel, one.focus, one.chosen.spacing_mm)
        return any(mesh.hash == mesh_hash for mesh, _ in found)


def solver() -> str:
    """SHA-256 (16 hex digits) of the code that simulates on a given mesh: one study is of one solver."""
    digest = hashlib.sha256()
    for folder in ("mesh", "simulate"):
        for file in sorted((Path(__file__).parents[1] / folder).glob("*.py")):
            if not (folder == "simulate" and file.name in CHOOSERS):
                digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()[:16]


def jobs(study: Study, draws: Sequence[Drawn]) -> dict[Job, float]:
    """All presses with their work, in a unit of its own; references first, and the most work first of each kind, so
    that the last do not wait for one.
    """
    found: list[tuple[bool, float, str, int, str]] = []
    for one in draws:
        gel, numerics = one.scene.sensor.gel, one.scene.numerics
        body = rigid_body(one.scene.contact.indenter, one.template.source.parent)
        path = IndenterPath(one.scene.motion, body, gel.dome_radius_mm)
        for rung in [REFERENCE, *study.rungs(one)]:
            on_ladder, step = rung != REFERENCE, numerics.max_step_mm
            if on_ladder:
                mesh, _ = one.mesh(rung)
            else:
                mesh, _ = study.reference.mesh(gel, one.focus, one.chosen.spacing_mm)
                step = min(step, study.reference.step_mm)
            iterations = ITERATIONS_PER_STEP * path.length_mm / step + ITERATIONS_PER_RECORD * one.scene.motion.steps
            work = iterations * len(mesh.points) ** SOLVE_GROWTH
            found.append((on_ladder, -work, one.template.name, one.index, rung))
    return {Job(name, index, rung): -work for _, work, name, index, rung in sorted(found)}
