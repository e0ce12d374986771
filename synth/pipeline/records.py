"""What those who make samples are given, and what they hand on and give back."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from synth.dataset.job import Job
from synth.dataset.manifest import Failure, ManifestEntry
from synth.dataset.store import Output, open_store
from synth.planning import Plan
from synth.press.load_path import LoadPath
from synth.press.resolution import Accuracy
from synth.sampling import SampleFrames, stream
from synth.scene import Scene
from synth.simulate import State
from synth.surface import ContactFaces

Task = tuple[int, tuple[int, ...]]
"""A trajectory and its samples that are wanted."""


@dataclass(frozen=True)
class JobContext:
    """What every task of a job shares; picklable. `cache` is where meshes are kept beside the dataset."""

    plan: Plan
    job: Job
    out: Output
    cache: Path

    @property
    def mesh_folders(self) -> tuple[Path, Path] | None:
        """Folders of fTetWild's meshes, which are random, so that all must use the same ones. None for other meshes."""
        return (open_store(self.out).meshes(), self.cache) if self.plan.mesh.kind == "tetwild" else None

    def stream(self, purpose: str, *numbers: int) -> np.random.Generator:
        return stream(self.plan.template, self.job.seed, purpose, *numbers)


@dataclass(frozen=True)
class Outcome:
    """What a task did: manifest lines of the samples on disk, failed instances, samples given up, and warnings."""

    entries: tuple[ManifestEntry, ...]
    failures: tuple[Failure, ...]
    given_up: tuple[int, ...]
    warnings: tuple[str, ...] = ()

    @staticmethod
    def of_all(outcomes: Iterable["Outcome"]) -> "Outcome":
        """Several tasks as one."""
        every = list(outcomes)
        entries, failures = (tuple(chain(*(getattr(one, name) for one in every))) for name in ("entries", "failures"))
        given_up = tuple(number for one in every for number in one.given_up)
        warnings = tuple(dict.fromkeys(chain(*(one.warnings for one in every))))
        return Outcome(entries, failures, given_up, warnings)


@dataclass(frozen=True, eq=False)
class SimulatedTrajectory:
    """A simulated trajectory, less what no sample shows; picklable."""

    number: int  # of the trajectory
    scene: Scene  # fully drawn
    samples: tuple[SampleFrames, ...]  # that are wanted
    states: dict[int, State]  # by number, those that the samples show; displacements are those of the contact face
    mesh: dict[str, Any]  # what is said of the mesh: hash and element
    faces: ContactFaces  # of the mesh
    path: LoadPath  # of its press
    warning: str  # of detail that rounding takes off
    accuracy: Accuracy | None  # of the mesh; None where it is left to whoever finishes the samples
    failures: tuple[Failure, ...]  # instances that failed before
    seconds: float  # of the simulation

    @property
    def sensor(self) -> int:
        return self.samples[0].sensor
