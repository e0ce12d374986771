"""What the step policy asks of a back end, and what it is answered.

A back end holds a press: its last two accepted states, the iterate of the present solve, a trial beside it, a Newton
direction, what contact remembers, and snapshots of all that.
"""

from collections.abc import Generator
from dataclasses import dataclass
from enum import Enum
from math import inf
from typing import Any, TypeVar

FORCE_FLOOR = 1e-6
"""Force in E mm² that is none: where the indenter has slid off, only rounding is left to compare with."""
STICK_FRICTION = 1e6
"""The rigid-motion predictor's coefficient of friction, at which nothing slides."""
PATH_DERIVATIVE_STEP = 1e-3
"""Share of a step over which that predictor takes the derivative along the load path."""


@dataclass(frozen=True)
class Evaluation:
    """What the policy sees of a state.

    Attributes:
        free: norm of the residual of the unknowns that are not held, E mm².
        forces: norm of all nodal forces, E mm².
        reaction: norm of the forces on held nodes, E mm²: what the gel bears, wherever the indenter is by now.
        smallest_jacobian: smallest det F; where it is not positive all else is meaningless.
        deepest_mm: largest penetration.
        moved_mm: farthest that a node is from where it was in the snapshot before a pass.
        error: of a trial with viscosity, what is left of the residual beyond the linear prediction, relative to it.
    """

    free: float
    forces: float
    reaction: float
    smallest_jacobian: float
    deepest_mm: float
    moved_mm: float = 0.0
    error: float = 0.0

    @property
    def relative(self) -> float:
        """The free residual over all nodal forces, which count as FORCE_FLOOR at least."""
        return self.free / max(self.forces, FORCE_FLOOR)


class Do(Enum):
    """Requests that need no number. All are answered by None but REPEAT and FORCE."""

    TAKE = "make the trial the iterate"
    KEEP_STEP = "take a snapshot of the iterate, what contact remembers and its stiffness, at the end of a load step"
    RESTORE_STEP = "go back to it, whatever was done to record the state"
    KEEP_PASS = "take a snapshot before a pass"
    RESTORE_PASS = "go back to it"
    REPEAT = "go back to its iterate, but not to its multipliers; answered by the Evaluation"
    ANCHOR = "anchor points that have come to touch, by the iterate, as if the step were accepted"
    FORCE = "answered by the indenter's force on the gel along the press in the iterate, E mm²: a float"
    ACCEPT = "make the iterate the last state of the path and let contact's history follow"


@dataclass(frozen=True)
class Begin:
    """Move the indenter to a path length, and evaluate the last state plus ratio times its change in the step before.

    With `rigid` it is the rigid-motion predictor's state instead. Answered by the Evaluation of that iterate.
    """

    at_mm: float
    ratio: float = 0.0
    rigid: bool = False


@dataclass(frozen=True)
class Solve:
    """Find the Newton direction at the iterate; answered by whether it is finite.

    The iterate's relative residual, the one that is wanted, and the iterations so far tell how exact it must be.
    `viscosity` is relaxation's θ, None for Newton's method; `max_turn` is `contact_stiffness`'s.
    """

    relative: float
    tolerance: float
    iteration: int
    viscosity: float | None = None
    max_turn: float = inf


@dataclass(frozen=True)
class Try:
    """The Evaluation of a trial: the iterate moved by a share of the direction; with relaxation's θ also its error."""

    share: float
    viscosity: float | None = None


@dataclass(frozen=True)
class Augment:
    """Add a share of the iterate's tractions to the multipliers, with so many times the body's own stiffness.

    Answered by the iterate's new Evaluation.
    """

    share: float
    stiffening: float


@dataclass(frozen=True)
class Record:
    """Write the iterate down as the state at a path length, with what was seen of it."""

    at_mm: float
    iterations: int
    evaluation: Evaluation


Request = Begin | Solve | Try | Augment | Record | Do
T = TypeVar("T")
Asking = Generator[Request, Any, T]
"""A part of the policy, which ends with a T."""
