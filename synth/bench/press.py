"""One press of the benchmark: built, warmed up, and timed."""

import statistics
import time
from dataclasses import dataclass

import numpy as np

from synth.bench.cases import GEL, INDENTER, Case
from synth.bench.setting import Setting
from synth.mesh import PadMesh
from synth.simulate import Trajectory
from synth.simulate.indenter import rigid_body
from synth.simulate.material import pad_material
from synth.simulate.path import Path
from synth.simulate.space import function_space
from synth.simulate.stepping import Stepper
from synth.simulate.system import System

SHORT_S = 2.0
"""Presses that take less are timed REPEATS times; their median counts."""
REPEATS = 3


@dataclass(frozen=True)
class Press:
    """What a press gave and took.

    Attributes:
        trajectory: of the last repeat; all are the same.
        seconds: processor time of the press alone, median over the repeats. The solver runs on one thread, so that on
            an idle core this is the wall time; on a busy machine it is what repeats.
        wall_s: wall time of the repeat that took this long.
        repeats: how often it was run.
        setup_s: sparse pattern and symbolic analysis, shared by all presses on meshes of one topology.
        unknowns: displacement components and pressures that are not held.
    """

    trajectory: Trajectory
    seconds: float
    wall_s: float
    repeats: int
    setup_s: float
    unknowns: int


def pressed(case: Case, setting: Setting, mesh: PadMesh, short_s: float = SHORT_S) -> Press:
    """Run a case and time it.

    Args:
        case: how the ball moves.
        setting: how it is simulated.
        mesh: the setting's mesh for this case.
        short_s: presses that take less are run REPEATS times.
    """
    taken: list[tuple[float, float]] = []
    setup_s = 0.0
    while not taken or (taken[0][0] < short_s and len(taken) < REPEATS):
        started = time.perf_counter()
        stepper = ready_stepper(case, setting, mesh)
        if not taken:
            setup_s = time.perf_counter() - started
        began = time.process_time()
        trajectory = stepper.run()[0]
        taken.append((time.process_time() - began, trajectory.seconds))
    seconds, wall_s = statistics.median_low(taken)
    return Press(trajectory, seconds, wall_s, len(taken), setup_s, len(stepper.system.free))


def ready_stepper(case: Case, setting: Setting, mesh: PadMesh) -> Stepper:
    """A stepper at the start of the path, kernels compiled and the sparse pattern analysed."""
    space = function_space(mesh, setting.built_element())
    single, keep = setting.driver.single_precision, setting.driver.keep_factors
    system = System(space, pad_material(GEL, mesh), penalty=setting.numerics.penalty, single=single, keep=keep)
    body = rigid_body(INDENTER, None, mesh.spacing_mm / (2 * space.element.order))
    path, modulus = Path(case.motion, body), GEL.youngs_modulus_kpa / 1000
    stepper = Stepper(system, [path], [case.friction], setting.numerics, [modulus], setting.driver)
    factorise_at_rest(stepper, path)
    return stepper


def factorise_at_rest(stepper: Stepper, path: Path) -> None:
    """A Newton step in the undeformed state, thrown away: it makes the solver analyse the pattern."""
    system, indenters, active = stepper.system, stepper.indenters, np.ones(1, dtype=bool)
    pose = path.pose(0.0)
    indenters.centre.assign(pose.centre[None])
    indenters.rotation.assign(pose.rotation[None])
    rest = system.zero()
    balance = system.balance(rest, indenters, active)
    system.newton_step(system.tangent(rest, indenters, active), np.ones_like(balance.free), active)
