"""One press of the study of the error budget: run as `generate` runs it, timed, and probed at the picture's points."""

import statistics
import time
from dataclasses import dataclass, replace
from pathlib import Path as FilePath

import numpy as np

from synth.arrays import FloatArray
from synth.bench.budget_field import field, places
from synth.bench.budget_study import REFERENCE, Drawn, Job, Reference, Study, drawn
from synth.bench.press import REPEATS, SHORT_S, factorise_at_rest
from synth.errors import InputError
from synth.mesh import PadMesh
from synth.scene import Scene
from synth.simulate import Trajectory
from synth.simulate.driver import STANDARD, Driver
from synth.simulate.solve import stepper_of
from synth.simulate.stepping import Stepper


@dataclass(frozen=True)
class Measurement:
    """What is kept of a press, but for its field.

    Attributes:
        scene, index, rung: which; see `synth.bench.budget_study.Job`.
        status: as of a trajectory, or "refused" where the press cannot be set up.
        reason: why it is not "complete".
        seconds: processor time of the press, median of REPEATS below SHORT_S; mesh, compiled kernels and the analysis
            of the sparse pattern exist before.
        wall_s: wall time of that press.
        setup_s: processor time of that analysis.
        unknowns: displacement components and pressures that are not held.
        spacing_mm: edge length under the contact.
        penetration_mm: deepest contact point inside the indenter in the judged states that were reached.
        iterations: Newton's, in all.
        attempt: of the draw.
        mesh: its hash.
        machine: what it ran on.
    """

    scene: str
    index: int
    rung: str
    status: str
    reason: str
    seconds: float
    wall_s: float
    setup_s: float
    unknowns: int
    spacing_mm: float
    penetration_mm: float
    iterations: int
    attempt: int
    mesh: str
    machine: str

    @property
    def job(self) -> Job:
        """What was asked for."""
        return Job(self.scene, self.index, self.rung)

    @property
    def complete(self) -> bool:
        """Whether all states were reached."""
        return self.status == "complete"


@dataclass(frozen=True, eq=False)
class Pressed:
    """A measurement with its field.

    Attributes:
        measurement: of the press.
        points: (n, 2) mm of the contact face.
        frames: k numbers of the judged states.
        displacement: (k, n, 3) mm in them; None where the press is not complete.
    """

    measurement: Measurement
    points: FloatArray
    frames: tuple[int, ...]
    displacement: FloatArray | None


def press(study: Study, job: Job, machine: str = "") -> Pressed:
    """Run a job.

    Args:
        study: that it belongs to.
        job: which press.
        machine: to be noted.
    """
    one = drawn(study.template(job.scene), study.seed, job.index)
    scene, driver = one.scene, STANDARD
    if job.rung == REFERENCE:
        mesh, spacing_mm = study.reference.mesh(scene.sensor.gel, one.focus, one.chosen.spacing_mm)
        scene, driver = _as_reference(scene, study.reference)
    else:
        mesh, spacing_mm = one.mesh(job.rung)
    points = places(scene)
    same = (one.attempt, mesh.hash, machine)
    try:
        trajectory, (seconds, wall_s), setup_s, unknowns = _timed(scene, mesh, one, driver)
    except InputError as error:
        nothing = (np.nan, np.nan, np.nan, 0, spacing_mm, np.nan, 0)
        refused = Measurement(job.scene, job.index, job.rung, "refused", str(error), *nothing, *same)
        return Pressed(refused, points, tuple(one.judged), None)
    reached = [trajectory.states[k].max_penetration_mm for k in one.judged if k < len(trajectory.states)]
    measurement = Measurement(
        scene=job.scene,
        index=job.index,
        rung=job.rung,
        status=trajectory.status,
        reason=trajectory.reason,
        seconds=seconds,
        wall_s=wall_s,
        setup_s=setup_s,
        unknowns=unknowns,
        spacing_mm=spacing_mm,
        penetration_mm=max(reached, default=float("nan")),
        iterations=sum(state.newton_iterations for state in trajectory.states),
        attempt=one.attempt,
        mesh=mesh.hash,
        machine=machine,
    )
    seen = field(trajectory, one.judged, points) if measurement.complete else None
    return Pressed(measurement, points, tuple(one.judged), seen)


def _as_reference(scene: Scene, reference: Reference) -> tuple[Scene, Driver]:
    """The scene and the driver of its reference."""
    step = min(reference.step_mm, scene.numerics.max_step_mm)
    numerics = scene.numerics.model_copy(update={"max_step_mm": step})
    driver = replace(STANDARD, correction_iterations=reference.correction_iterations)
    return scene.model_copy(update={"numerics": numerics}), driver


def _timed(
    scene: Scene, mesh: PadMesh, one: Drawn, driver: Driver
) -> tuple[Trajectory, tuple[float, float], float, int]:
    """The trajectory, processor and wall time of the press and processor time of the set-up (s), number of unknowns.

    Raises:
        InputError: the indenter cannot be built.
    """
    taken: list[tuple[float, float]] = []
    setup_s = 0.0
    while not taken or (taken[0][0] < SHORT_S and len(taken) < REPEATS):
        started = time.process_time()
        stepper = ready_stepper(scene, mesh, one.template.source.parent, one.frames, driver)
        began = time.process_time()
        trajectory = stepper.run()[0]
        taken.append((time.process_time() - began, trajectory.seconds))
        setup_s = setup_s or began - started  # the pattern is analysed the first time only
    return trajectory, statistics.median_low(taken), setup_s, len(stepper.system.free)


def ready_stepper(
    scene: Scene, mesh: PadMesh, folder: FilePath, frames: frozenset[int], driver: Driver = STANDARD
) -> Stepper:
    """A stepper at the start of a scene's path, whose run gives what `synth.simulate.simulate` gives.

    Kernels are compiled and the sparse pattern is analysed, which all draws of one fineness share.

    Args:
        scene: fully drawn.
        mesh: of its pad.
        folder: what a mesh indenter's file name is relative to.
        frames: numbers of the states that are wanted.
        driver: of Newton's method.

    Raises:
        InputError: the indenter cannot be built.
    """
    stepper = stepper_of([scene], mesh, folder, frames=frames, driver=driver)
    factorise_at_rest(stepper, stepper.samples[0].path)
    return stepper
