"""What the makers of samples are given, and what they give back."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from synth.arrays import FloatArray
from synth.dataset.job import Job
from synth.dataset.sample import ManifestEntry
from synth.dataset.store import Output
from synth.render.variant import Variant
from synth.simulate import State
from synth.simulate.space import Space
from synth.template import Template

Task = tuple[int, tuple[int, ...]]
"""A trajectory and its samples that are wanted."""


@dataclass(frozen=True)
class Workplace:
    """What every task of a job shares; picklable.

    Attributes:
        template: the scene.
        job: what the dataset was asked for.
        out: of the dataset.
        variant: that renders.
        cache: where meshes are kept beside the dataset.
    """

    template: Template
    job: Job
    out: Output
    variant: Variant
    cache: Path

    @property
    def needs_meshes(self) -> bool:
        """Whether pads are meshed by fTetWild, which is random, so that all must use the same mesh."""
        return self.template.corners[0].numerics.edge_length_mm is not None

    @property
    def is_batched(self) -> bool:
        """Whether trajectories are simulated many at once."""
        return self.template.corners[0].numerics.solver == "batched"

    @property
    def has_gpu(self) -> bool:
        """Whether the renderer, and with it the batched solver, runs on a GPU."""
        return self.variant.name.startswith("cuda")


@dataclass(frozen=True)
class Failure:
    """A draw that gave no trajectory.

    Attributes:
        index: of the trajectory's first sample.
        draw: 0 for the trajectory's first failed draw, and so on.
        stage: "sensor", "draw" or "simulate".
        reason: for the user.
        last_good_state: of a simulation.
    """

    index: int
    draw: int
    stage: str
    reason: str
    last_good_state: dict[str, Any] | None


@dataclass(frozen=True)
class Outcome:
    """What a task did: manifest lines of the samples on disk, failed draws, and samples given up."""

    entries: tuple[ManifestEntry, ...]
    failures: tuple[Failure, ...]
    given_up: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class FaceState:
    """What pictures and flow need of a simulated state, at the nodes of the contact face.

    Attributes:
        displacement: (s, 3) float64 mm.
        traction: (s, 3) float64 MPa.
        force_n, torque_nmm: of the indenter on the gel.
        summary: the state's numbers, for the diagnostics.
    """

    displacement: FloatArray
    traction: FloatArray
    force_n: tuple[float, float, float]
    torque_nmm: tuple[float, float, float]
    summary: dict[str, Any]

    @staticmethod
    def of(state: State, space: Space) -> "FaceState":
        """The part of a state that lies on the contact face."""
        displacement = state.displacement[space.surface_nodes]
        return FaceState(displacement, state.traction, state.force_n, state.torque_nmm, state.summary())
