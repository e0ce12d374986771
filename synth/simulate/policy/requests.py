"""What the step policy asks of a back end, and what it is answered.

A back end holds a press: its last two accepted states, the iterate of the present solve, a trial beside it, a Newton
direction, what contact remembers, and snapshots of all that. Requests without a stated answer are answered by None.
"""

from collections.abc import Generator
from dataclasses import dataclass
from enum import Enum
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


class Snapshot(Enum):
    """What a snapshot is for: the end of a load step that is recorded, or the solution before a pass."""

    STEP = "step"
    PASS = "pass"


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
    `viscosity` is relaxation's θ, None for Newton's method.
    """

    relative: float
    tolerance: float
    iteration: int
    viscosity: float | None = None


@dataclass(frozen=True)
class Try:
    """The Evaluation of a trial: the iterate moved by a share of the direction; with relaxation's θ also its error."""

    share: float
    viscosity: float | None = None


@dataclass(frozen=True)
class Take:
    """Make the trial the iterate."""


@dataclass(frozen=True)
class Keep:
    """Take a snapshot of the iterate, what contact remembers and its stiffness."""

    snapshot: Snapshot


@dataclass(frozen=True)
class Restore:
    """Go back to a snapshot."""

    snapshot: Snapshot


@dataclass(frozen=True)
class Repeat:
    """Go back to the iterate before a pass, but not to its multipliers; answered by its Evaluation."""


@dataclass(frozen=True)
class Anchor:
    """Anchor points that have come to touch, by the iterate, as if the step were accepted."""


@dataclass(frozen=True)
class Augment:
    """Add a share of the iterate's tractions to the multipliers, with so many times the body's own stiffness.

    Answered by the iterate's new Evaluation.
    """

    share: float
    stiffening: float


@dataclass(frozen=True)
class Force:
    """The indenter's force on the gel along the press, E mm², in the iterate: a float."""


@dataclass(frozen=True)
class Record:
    """Write the iterate down as the state at a path length, with what was seen of it."""

    at_mm: float
    iterations: int
    evaluation: Evaluation


@dataclass(frozen=True)
class Accept:
    """Make the iterate the last state of the path and let contact's history follow."""


Request = Begin | Solve | Try | Take | Keep | Restore | Repeat | Anchor | Augment | Force | Record | Accept
T = TypeVar("T")
Asking = Generator[Request, Any, T]
"""A part of the policy, which ends with a T."""
